"""Operators: typed ports and parameters declared once on a class, checked when the class is made.

    class CloudBuilder(Operator):
        depth: In[DepthImage]
        camera: Sampled[CameraInfo]
        cloud: Out[PointCloud]
        stride: int = Param(2, ge=1, doc="keep every stride-th pixel in both directions")

        def process(self, depth, camera):
            return PointCloud(...)

An operator is a plain object: constructing it and calling `process()` needs no graph, session or mock.
"""

from __future__ import annotations

import hashlib
import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, SupportsInt

import numpy as np
import pydantic

from dataflow.declare import Declaration, process_takes
from dataflow.messages.base import Message
from dataflow.ports import (
    Batch,
    Context,
    Duration,
    In,
    InputKind,
    InputPort,
    OperatorDefinitionError,
    OperatorSpec,
    Out,
    OutputError,
    OutputPort,
    Outputs,
    Param,
    ParameterError,
    Sampled,
    SourceError,
    is_tunable,
)
from dataflow.state import (
    KEPT,
    Counts,
    Remembered,
    StateError,
    StateOf,
    fresh_state,
    plain,
    reset_state,
    state_hints,
    take_over,
)

__all__ = [
    "FINDING",
    "KEPT",
    "Batch",
    "Context",
    "Counts",
    "Duration",
    "In",
    "InputKind",
    "InputPort",
    "Operator",
    "OperatorDefinitionError",
    "OperatorSpec",
    "Out",
    "OutputError",
    "OutputPort",
    "Outputs",
    "Param",
    "ParameterError",
    "Remembered",
    "Sampled",
    "Source",
    "SourceError",
    "is_source",
    "is_tunable",
    "outputs_of",
    "state_hints",
    "validate_parameters",
]

Journaled = Callable[[Callable[..., Any], Sequence[Any], Mapping[str, Any]], Any]
"""Makes a call with positional and named arguments through a journal."""

FINDING = "finding"
"""Key of a report's summary for the operator's finding, which stands among the first lines at a run's end."""


class Operator:
    """The base of all operators. Class arguments: `merge=True`, `tolerance="20ms"`, `every="100ms"`.

    Life: `setup()`, then `process()` per firing, `finish()` once when the triggers ended (may still emit), `close()`.
    """

    spec: ClassVar[OperatorSpec]
    stateless: ClassVar[bool] = False
    """The outputs of `process()` depend on its inputs alone, so re-execution may begin anywhere."""
    external: ClassVar[bool] = False
    """Touches the world (an actuator, a network service): always recorded, never re-executed."""
    state: Any
    """The state, of the dataclass that a class annotates it with (`state: State`). None is annotated: no state."""
    __effects: Journaled | None = None
    __generator: np.random.Generator | None = None
    __seed: SupportsInt = 0

    def __init_subclass__(
        cls,
        *,
        merge: bool | None = None,
        tolerance: str | int | None = None,
        every: str | int | None = None,
        abstract: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init_subclass__(**kwargs)
        above: OperatorSpec | None = getattr(cls, "spec", None)
        if above is not None:  # what a subclass does not say itself, it inherits
            merge = above.merge if merge is None else merge
            tolerance = above.tolerance if tolerance is None else tolerance
            every = above.every if every is None else every
        if not abstract:
            declared = Declaration(cls, (Operator, Source), sys._getframe(1).f_locals)
            if declared.state is not None:
                cls.state = StateOf()
            cls.spec = declared.spec(
                merge,
                tolerance,
                every,
                source=issubclass(cls, Source),
                takes=lambda inputs, fault: process_takes(cls.process, cls.process is Operator.process, inputs, fault),
            )

    def __init__(self, **params: Any) -> None:
        """Raises `ParameterError` when a parameter is unknown, missing or out of its bounds."""
        if "spec" not in vars(type(self)):
            raise TypeError(f"{type(self).__name__} is abstract: it declares no ports")
        self.params: pydantic.BaseModel = validate_parameters(type(self), params)
        for name in type(self.params).model_fields:
            setattr(self, name, getattr(self.params, name))
        self.files: dict[str, str] = {}

    @property
    def rng(self) -> np.random.Generator:
        """The operator's own random generator: seeded anew before every call, made when it is first asked for."""
        if self.__generator is None:
            self.__generator = np.random.Generator(np.random.PCG64(int(self.__seed)))
        return self.__generator

    @property
    def log(self) -> logging.Logger:
        """The logger of its class. In a run, lines from level info on are shown, recorded and kept with the operator's
        name and the event time of the call; `dataflow logs` shows them. So is printed output."""
        return logging.getLogger(f"{type(self).__module__}.{type(self).__qualname__}")

    def seed_rng(self, seed: SupportsInt) -> None:
        """Gives `rng` a new seed; the runtime does so before every call."""
        self.__generator, self.__seed = None, seed

    def effect(self, call: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Returns the answer of a call that cannot repeat (a service, a cloud model, a network on a GPU), and records
        it; re-execution gives the recorded answer, without the call.

        For `process()` and `finish()`. An answer holds numbers, strings, bytes, None, arrays, and lists and mappings of
        these, at most 16 MiB a firing. The key is the name of `call`, the digest of each argument, and what it closes
        over or is bound to; `call` gets nothing else that varies, and changes nothing of the operator. Raises what
        `call` raises, recorded too; `EffectError` for what cannot be recorded; in a re-execution `EffectMiss` where no
        such call was recorded.
        """
        return call(*args, **kwargs) if self.__effects is None else self.__effects(call, args, kwargs)

    def journal_effects(self, journal: Journaled) -> None:
        """Has effects made through a journal; the runtime does so before `setup()`."""
        self.__effects = journal

    def setup(self) -> None:
        """Loads models and other resources. Runs once, on the thread that later runs `process()`."""

    def static_outputs(self) -> Mapping[str, Message]:
        """The messages of the static outputs, by port. Called once, after `setup()`."""
        return {}

    def process(self, *args: Any, **kwargs: Any) -> Outputs:
        """Works on one firing; arguments are named as the inputs (and `context`, when declared).

        Returns a message (one output port), a mapping from port to message or None, or None for nothing.
        """
        raise TypeError(f"{type(self).__name__} has inputs but no process()")

    def finish(self) -> Outputs:
        """Called once after the last firing, when the triggers ended; may emit a last message on each port."""
        return None

    def close(self) -> None:
        """Releases resources. Always called, also after a failure."""

    def initial_state(self) -> Any:
        """Returns the state to begin with: by default the annotated dataclass without arguments.

        Called when `state` is first asked for, and by `on_reset()`. Raises `StateError`.
        """
        return fresh_state(type(self), self.spec.state)

    def on_reset(self, input: str) -> None:
        """Begins anew with `initial_state()`, the fields declared `KEPT` aside.

        The clock behind `input` jumped back: the stamps to come are earlier than those before.
        """
        if self.spec.state is not None:
            old, self.state = self.state, self.initial_state()
            reset_state(old, self.state)

    def on_parameter(self, name: str) -> None:
        """A `tunable` parameter was changed between two firings; `self.<name>` holds the new value.

        Raises `ParameterError` for a value that cannot be taken over; then the one before stays.
        """

    def snapshot(self) -> Mapping[str, Any] | None:
        """Returns the state, such that `restore` of it in a fresh operator goes on alike: by default `state` or None.

        Values: numbers, strings, bytes, None, numpy arrays, and lists and mappings (with string keys) of these. Called
        between firings of a recorded run whose graph asks for snapshots. Raises `StateError` for other values.
        """
        if self.spec.state is None:
            return None
        snapshot: Mapping[str, Any] = plain(self.state)
        return snapshot

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes over a state that `snapshot` gave. Called once, after `setup()`. Raises `StateError`."""
        if self.spec.state is None:
            raise NotImplementedError(f"{type(self).__name__} gives snapshots but cannot restore them")
        try:
            take_over(self.state, state_hints(self.state), state, self.new_part)
        except StateError as error:
            raise StateError(f"snapshot of another version: {error}") from error

    def new_part(self, kind: type[Any]) -> Any:
        """Returns a part of the state that `restore` finds missing, such as a `Remembered` with settings."""
        return kind()

    def set_parameter(self, name: str, value: Any) -> Any:
        """Changes a `tunable` parameter; returns the value as validated. Raises `ParameterError`."""
        cls = type(self)
        fields = cls.spec.parameters.model_fields
        able = [n for n, field in fields.items() if is_tunable(field)]
        which = f"; those that can: {', '.join(able)}" if able else "; none of its parameters can"
        if name in fields and name not in able:
            raise ParameterError(f"{cls.__name__}.{name} cannot change while the graph runs{which}")
        if name not in fields:
            raise ParameterError(f"{cls.__name__} has no parameter {name!r}{which.replace('can', 'can change', 1)}")
        before, self.params = self.params, validate_parameters(cls, {**self.params.model_dump(), name: value})
        setattr(self, name, getattr(self.params, name))
        try:
            self.on_parameter(name)
        except ParameterError:
            self.params = before
            setattr(self, name, getattr(before, name))
            raise
        return getattr(self, name)

    def summary(self) -> Mapping[str, float | int | str]:
        """Returns figures to show at the end of a run, by default those of a state `Counts`; read after `finish()`."""
        return dict(self.state.counts) if issubclass(self.spec.state or object, Counts) else {}

    def finding(self) -> str:
        """Returns in a line what is wrong with what was given, "" for nothing: for `top`, the log and a run's end."""
        return ""

    @classmethod
    def trained_in_simulation(cls, params: Mapping[str, Any]) -> bool:
        """Returns whether the network that it uses with these parameters was trained on simulated data alone.

        A run warns where such an operator takes what follows from a source that is not `simulated`.
        """
        return False

    def use_file(self, path: str | Path, *, name: str | None = None) -> Path:
        """Notes the content hash of a file that the operator reads, for the firing record of `setup()`.

        It is noted under `name`, by default the path. Raises FileNotFoundError that names the operator and the place
        looked at.
        """
        file = Path(path).expanduser()
        if not file.is_file():
            raise FileNotFoundError(f"{type(self).__name__}: no file {str(path)!r} (looked for {file.absolute()})")
        with file.open("rb") as handle:
            self.files[name or str(path)] = hashlib.file_digest(handle, "sha256").hexdigest()
        return file


class Source(Operator, abstract=True):
    """An operator without inputs: a device, a dataset folder, a simulator, a log.

    `real_time = False` (a dataset, a log): it can wait, so that it is read as fast as the graph takes it, without loss.
    `real_time = True` (a camera, a simulator in real time): time passes whether the graph keeps up or not.
    """

    real_time: ClassVar[bool] = False
    simulated: ClassVar[bool] = False
    """Its messages are computed, not measured by a sensor."""

    def stream(self) -> Iterator[Mapping[str, Message]]:
        """Yields what is emitted at one stamp: a mapping from port to message. Stamps strictly increase."""
        raise TypeError(f"{type(self).__name__} is a source without stream()")

    def stop_reading(self) -> None:
        """Called on another thread when a live run ends: makes a `stream()` that waits for its device return."""

    def length(self) -> int | None:
        """Returns how many times `stream()` will yield, if known: for progress bars."""
        return None


def is_source(cls: type[Operator]) -> bool:
    return issubclass(cls, Source)


def validate_parameters(cls: type[Operator], params: Mapping[str, Any]) -> pydantic.BaseModel:
    """The parameters as a validated model; raises `ParameterError` with one line per fault."""
    try:
        return cls.spec.parameters(**params)
    except pydantic.ValidationError as error:
        raise ParameterError("\n".join(_explain(cls, fault) for fault in error.errors())) from None


def outputs_of(spec: OperatorSpec, returned: Outputs) -> dict[str, Message]:
    """Returns what `process()` returned as port → message, checked against the declared ports. Raises `OutputError`."""
    if returned is None:
        return {}
    only = spec.only_output
    if only is not None and isinstance(returned, only.types):
        return {only.name: returned}
    if isinstance(returned, Message):
        dynamic = [p for p in spec.outputs.values() if not p.static]
        if len(dynamic) != 1:
            raise OutputError(
                f"{spec.name} returned one {returned.SCHEMA}, but has {len(dynamic)} outputs "
                f"({', '.join(p.name for p in dynamic) or 'none'}): return a mapping from port to message"
            )
        returned = {dynamic[0].name: returned}
    if returned.__class__ is not dict and not isinstance(returned, Mapping):
        raise OutputError(f"{spec.name} returned a {type(returned).__name__}; return a message, a mapping or None")
    emitted: dict[str, Message] = {}
    for name, message in returned.items():
        port = spec.outputs.get(name)
        if port is None:
            raise OutputError(f"{spec.name} emitted on {name!r}; its outputs: {', '.join(spec.outputs) or 'none'}")
        if message is None:
            continue
        if not isinstance(message, port.types):
            raise OutputError(
                f"{spec.name}.{name} emits {port.type_text()}, got {getattr(message, 'SCHEMA', type(message).__name__)}"
            )
        emitted[name] = message
    if len(emitted) < 2:
        return emitted
    return {name: emitted[name] for name in spec.outputs if name in emitted}


def _explain(cls: type[Operator], fault: Any) -> str:
    name = ".".join(str(part) for part in fault["loc"])
    fields = cls.spec.parameters.model_fields
    of_parameter = len(fault["loc"]) == 1  # and not of a field within one
    if fault["type"] == "extra_forbidden" and of_parameter:
        known = ", ".join(fields) or "none"
        return f"{cls.__name__} has no parameter {name!r}; its parameters: {known}"
    if fault["type"] == "missing" and of_parameter:
        return f"{cls.__name__}.{name} must be given: {fields[name].description}"
    return f"{cls.__name__}.{name}: {fault['msg']}, got {fault['input']!r}"
