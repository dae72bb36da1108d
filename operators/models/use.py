"""Files of models for operators: a name of the registry, or a path, becomes a file and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataflow.operator import Operator
from operators.inference import ModelError
from operators.models.registry import Model, Registry


@dataclass(frozen=True)
class Used:
    """A file, and the row of the registry that it is; None for a file of no row."""

    file: Path
    model: Model | None

    def setting(self, operator: Operator, name: str) -> Any:
        """Returns a parameter of an operator; where it has its default, the registry's for this model, if there is
        one."""
        given = getattr(operator, name)
        default = type(operator).spec.parameters.model_fields[name].default
        return given if self.model is None or given != default else self.model.params.get(name, given)


def use_model(operator: Operator, given: str) -> Used:
    """Returns the file of a model for an operator, and notes its digest under the name or path that was given.

    A file of a row is known by its digest, wherever it lies. Raises FileNotFoundError for a missing file, with how to
    get it, and ModelError for a name of no row, or a file in the cache that is not its row's.
    """
    registry = Registry.load()
    if not names_a_model(given):
        file = operator.use_file(given)
        return Used(file, registry.with_digest(operator.files[given]))
    model = registry[given]
    if not model.file.is_file():
        raise FileNotFoundError(missing(model))
    file = operator.use_file(model.file, name=given)
    if not model.accepts(operator.files[given]):
        found = operator.files[given]
        raise ModelError(f"{file} is not the file of {given}: its sha256 is {found}, expected {model.sha256}")
    return Used(file, model)


def names_a_model(given: str) -> bool:
    """Returns whether a text names a row of the registry rather than a file."""
    return Path(given).name == given and not Path(given).suffix and not Path(given).is_file()


def missing(model: Model) -> str:
    """Returns what to do about a model whose file is not there."""
    if model.source.export is not None:
        return (
            f"{model.name} is not on this machine, and its file is not distributed. Export it ({model.source.export}), "
            f"then: dataflow models get {model.name} --from FILE (looked for {model.file})"
        )
    return (
        f"{model.name} is not on this machine (looked for {model.file}). With a network: dataflow models get "
        f"{model.name}; without: put the file there, from {model.source}"
    )
