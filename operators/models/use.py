"""Files of models for operators: a name of the registry, or a path, becomes a file and what is known of it."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataflow.operator import Operator
from operators.inference import ModelError
from operators.models.registry import Model, PartName, Registry

_OPERATOR = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


@dataclass(frozen=True)
class Used:
    """A file, and the row of the registry that it is; None for a file of no row."""

    file: Path
    model: Model | None

    def default(self, name: str, default: Any) -> Any:
        """Returns the registry's value of a parameter for this model; `default` where there is none."""
        return default if self.model is None else self.model.params.get(name, default)

    def setting(self, operator: Operator, name: str, default: Any) -> Any:
        """Returns a parameter of an operator; where it is None, its `default`."""
        given = getattr(operator, name)
        return self.default(name, default) if given is None else given


def use_model(operator: Operator, given: str, kind: str | None = None) -> Used:
    """Returns the file of a model for an operator, and notes its digest under the name or path that was given.

    A file of a row is known by its digest, wherever it lies; the digest of the row's parameters and classes is noted
    beside it, under `NAME (row)`. A row is for operators of this class, or of the one named `kind`. Raises
    FileNotFoundError for a missing file, with how to get it, and ModelError for a name of no row, a row that is for
    another operator, or a file in the cache that is not its row's.
    """
    registry = Registry.load()
    if not names_a_model(given):
        if _OPERATOR.fullmatch(given) and not Path(given).exists():
            raise ModelError(
                f"{given} is an operator, but {type(operator).__name__}.model takes a name of `dataflow models list`, "
                f"or an ONNX file (in graphs/core/perception.yaml `detector_operator` takes an operator)"
            )
        file = operator.use_file(given)
        model = registry.with_digest(operator.files[given])
    else:
        model = registry[given]
        if not model.file.is_file():
            raise FileNotFoundError(missing(model))
        file = _right_file(operator, model)
    if model is not None:
        _check_row(operator, model, kind or type(operator).__name__)
        row = json.dumps({"params": model.params, "classes": model.classes}, sort_keys=True, default=str)
        operator.files[f"{given} (row)"] = hashlib.sha256(row.encode()).hexdigest()
    return Used(file, model)


def use_part(operator: Operator, model: Model, name: PartName) -> Path:
    """Returns the file of a part of a model for an operator, and notes its digest under the part's name.

    Raises ModelError where the row has no such part or the file is another, FileNotFoundError with how to get it.
    """
    part = model.part(name)
    if not part.file.is_file():
        raise FileNotFoundError(missing(part))
    return _right_file(operator, part)


def _right_file(operator: Operator, model: Model) -> Path:
    file = operator.use_file(model.file, name=model.name)
    if not model.accepts(operator.files[model.name]):
        raise ModelError(
            f"{file} is not the file of {model.name}: its sha256 is {operator.files[model.name]}, expected "
            f"{model.sha256}. `dataflow models get {model.name}` brings the right one"
        )
    return file


def _check_row(operator: Operator, model: Model, kind: str) -> None:
    if not model.operator.endswith(f":{kind}"):
        raise ModelError(f"{model.name} is run by {model.operator}, not by {kind}")
    takes = [name for name, field in type(operator).spec.parameters.model_fields.items() if field.default is None]
    if unknown := model.params.keys() - takes:
        raise ModelError(
            f"the registry's row {model.name} sets {', '.join(sorted(unknown))}, but {kind} takes only "
            f"{', '.join(takes)} from it"
        )


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
