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
import inspect
import sys
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import numpy as np
import pydantic
from pydantic import BeforeValidator
from pydantic.fields import FieldInfo

from dataflow.messages.base import Message
from dataflow.sync.stamps import parse_duration

T = TypeVar("T")

InputKind = Literal["in", "sampled", "batch"]
Outputs = Message | Mapping[str, Message | None] | None
Duration = Annotated[int, BeforeValidator(parse_duration)]
"""A parameter type: nanoseconds, written as `"100ms"`, `"2s"` or an integer."""


class OperatorDefinitionError(TypeError):
    """An operator class that is declared wrongly: names the class, the attribute and what would be right."""


class ParameterError(ValueError):
    """A parameter value that is refused: names the operator, the parameter, the value and what would be right."""


class OutputError(ValueError):
    """`process()` returned something that its ports cannot emit: names the operator and the port."""


class In(Generic[T]):
    """An input that triggers firings. Several are joined by stamp, or merged when the class says `merge=True`.

    With `many=True` (merged, or the only trigger) the key expression may match several streams; `process()` gets a
    dict from stream name to message, in sorted order, of those present.
    """

    kind: ClassVar[InputKind] = "in"

    def __init__(self, *, many: bool = False, doc: str = "") -> None:
        self.many, self.doc = many, doc


class Sampled(Generic[T]):
    """An input that never triggers: the newest message with stamp ≤ the firing's.

    - `max_age`: an older message counts as absent.
    - `required=False`: `process()` gets None when there is none; otherwise the firing is dropped and counted.
    - `before=True`: strictly earlier than the firing; `before="50ms"`: at least that much earlier. Feedback needs it.
    - `many=True`: a dict from stream name to that stream's newest message.
    """

    kind: ClassVar[InputKind] = "sampled"

    def __init__(
        self,
        *,
        max_age: str | int | None = None,
        required: bool = True,
        before: bool | str | int = False,
        many: bool = False,
        doc: str = "",
    ) -> None:
        self.max_age = None if max_age is None else parse_duration(max_age)
        self.required = required
        if before is True:
            self.before = 1
        elif before is False:
            self.before = 0
        else:
            self.before = parse_duration(before)
        self.many, self.doc = many, doc


class Batch(Generic[T]):
    """An input that never triggers: every message since the last firing up to this one's stamp, as a tuple.

    `max` keeps the newest so many, `max_age` those no older than that; what is cut is counted.
    """

    kind: ClassVar[InputKind] = "batch"

    def __init__(
        self, *, max: int | None = None, max_age: str | int | None = None, many: bool = False, doc: str = ""
    ) -> None:
        self.max = max
        self.max_age = None if max_age is None else parse_duration(max_age)
        self.many, self.doc = many, doc


class Out(Generic[T]):
    """An output port.

    - `static=True`: one message, valid from −∞, returned by `static_outputs()` (camera info, fixed transforms).
    - `lag="1s"`: emitted stamps may lie up to that much before the firing's; the port's frontier trails by it.
    """

    def __init__(self, *, static: bool = False, lag: str | int = 0, doc: str = "") -> None:
        self.static, self.lag, self.doc = static, parse_duration(lag), doc


def Param(
    default: Any = ...,
    *,
    doc: str,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
    min_length: int | None = None,
    max_length: int | None = None,
    pattern: str | None = None,
    unit: str = "",
    live: bool = False,
) -> Any:
    """Declares a parameter with its default, bounds and documentation. Without a default it must be given.

    `live`: it may be changed while the graph runs (`dataflow param set`): `process()` reads `self.<name>` anew each
    time, or `on_parameter` does what else is needed.
    """
    info = pydantic.Field(
        default,
        description=doc,
        ge=ge,
        gt=gt,
        le=le,
        lt=lt,
        min_length=min_length,
        max_length=max_length,
        pattern=pattern,
        json_schema_extra={**({"unit": unit} if unit else {}), **({"live": True} if live else {})} or None,
    )
    assert isinstance(info, FieldInfo)
    return info


@dataclass(frozen=True, slots=True)
class InputPort:
    """A declared input. `types` are the accepted message classes; a subclass is accepted too."""

    name: str
    kind: InputKind
    types: tuple[type[Message], ...]
    many: bool
    doc: str
    max_age: int | None = None
    required: bool = True
    before: int = 0
    max: int | None = None

    def accepts(self, produced: Sequence[type[Message]]) -> bool:
        """True when every type the stream may carry is one of the accepted ones."""
        return all(issubclass(p, self.types) for p in produced)

    def type_text(self) -> str:
        return " | ".join(t.SCHEMA or "Message" for t in self.types)


@dataclass(frozen=True, slots=True)
class OutputPort:
    """A declared output."""

    name: str
    types: tuple[type[Message], ...]
    static: bool
    lag: int
    doc: str

    def type_text(self) -> str:
        return " | ".join(t.SCHEMA or "Message" for t in self.types)


@dataclass(frozen=True, slots=True)
class OperatorSpec:
    """All that an operator class declares; everything else (checks, docs, viewer) reads it from here.

    `every` and `tolerance` are nanoseconds; `parameters` is a pydantic model of the parameters.
    """

    name: str
    doc: str
    inputs: Mapping[str, InputPort]
    outputs: Mapping[str, OutputPort]
    parameters: type[pydantic.BaseModel]
    merge: bool
    tolerance: int
    every: int | None
    process_takes: tuple[str, ...]

    @property
    def triggers(self) -> tuple[InputPort, ...]:
        return tuple(p for p in self.inputs.values() if p.kind == "in")


@dataclass(frozen=True, slots=True)
class Context:
    """What a firing is besides its messages: given to `process()` when it has a parameter named `context`.

    `stale` names the inputs whose message is marked stale, `late` those that hold a message that arrived late (live
    runs only), `tick` says that the timer fired.
    """

    stamp: int
    tick: bool = False
    stale: frozenset[str] = frozenset()
    late: frozenset[str] = frozenset()


_PORTS: tuple[type, ...] = (In, Sampled, Batch, Out)


class Operator:
    """The base of all operators. Class arguments: `merge=True`, `tolerance="20ms"`, `every="100ms"`.

    Life: `setup()`, then `process()` per firing, `finish()` once when the triggers ended (may still emit), `close()`.
    """

    spec: ClassVar[OperatorSpec]
    stateless: ClassVar[bool] = False
    """What `process()` gives depends on its inputs alone, so re-execution may begin anywhere."""
    external: ClassVar[bool] = False
    """Touches the world (an actuator, a network service): always recorded, never re-executed."""
    __generator: np.random.Generator | None = None
    __seed: int = 0

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
            cls.spec = _declare(cls, merge, tolerance, every, sys._getframe(1).f_locals)

    def __init__(self, **params: Any) -> None:
        """Raises `ParameterError` when a parameter is unknown, missing or out of its bounds."""
        if "spec" not in vars(type(self)):
            raise TypeError(f"{type(self).__name__} is abstract: it declares no ports of its own")
        self.params: pydantic.BaseModel = validate_parameters(type(self), params)
        for name in type(self.params).model_fields:
            setattr(self, name, getattr(self.params, name))
        self.files: dict[str, str] = {}

    @property
    def rng(self) -> np.random.Generator:
        """The operator's own random generator: seeded anew before every call, made when it is first asked for."""
        if self.__generator is None:
            self.__generator = np.random.Generator(np.random.PCG64(self.__seed))
        return self.__generator

    def seed_rng(self, seed: int) -> None:
        """Gives `rng` a new seed; the runtime does so before every call."""
        self.__generator, self.__seed = None, seed

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

    def on_reset(self, input: str) -> None:
        """The clock behind `input` jumped back: the stamps to come are earlier than those before."""

    def on_parameter(self, name: str) -> None:
        """A `live` parameter was changed between two firings; `self.<name>` holds the new value."""

    def snapshot(self) -> Mapping[str, Any] | None:
        """The state, such that `restore` of it in a fresh operator goes on alike; None where there is no such thing.

        Values: numbers, strings, bytes, None, numpy arrays, and lists and mappings (with string keys) of these. Called
        between firings of a recorded run whose graph asks for snapshots.
        """
        return None

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes over a state that `snapshot` gave. Called once, after `setup()`."""
        raise NotImplementedError(f"{type(self).__name__} gives snapshots but cannot restore them")

    def set_parameter(self, name: str, value: Any) -> Any:
        """Changes a `live` parameter; returns the value as validated. Raises `ParameterError`."""
        cls = type(self)
        fields = cls.spec.parameters.model_fields
        able = [n for n, field in fields.items() if is_live(field)]
        which = f"; those that can: {', '.join(able)}" if able else "; none of its parameters can"
        if name in fields and name not in able:
            raise ParameterError(f"{cls.__name__}.{name} cannot change while the graph runs{which}")
        if name not in fields:
            raise ParameterError(f"{cls.__name__} has no parameter {name!r}{which.replace('can', 'can change', 1)}")
        self.params = validate_parameters(cls, {**self.params.model_dump(), name: value})
        setattr(self, name, getattr(self.params, name))
        self.on_parameter(name)
        return getattr(self, name)

    def summary(self) -> Mapping[str, float | int | str]:
        """Figures to show at the end of a run (metrics sinks); read after `finish()`."""
        return {}

    def use_file(self, path: str | Path) -> Path:
        """Notes the content hash of a file that the operator reads, for the firing record of `setup()`.

        Raises FileNotFoundError that names the parameter's operator and the place looked at.
        """
        file = Path(path).expanduser()
        if not file.is_file():
            raise FileNotFoundError(f"{type(self).__name__}: no file {str(path)!r} (looked for {file.absolute()})")
        with file.open("rb") as handle:
            self.files[str(path)] = hashlib.file_digest(handle, "sha256").hexdigest()
        return file


class Source(Operator, abstract=True):
    """An operator without inputs: a device, a dataset folder, a simulator, a log.

    `live=False` (a dataset, a log) means that it can wait: it is read as fast as the graph takes it and loses nothing.
    `live=True` (a device, a simulator in real time) means that time passes whether the graph keeps up or not.
    """

    live: ClassVar[bool] = False

    def stream(self) -> Iterator[Mapping[str, Message]]:
        """Yields what is emitted at one stamp: a mapping from port to message. Stamps strictly increase."""
        raise TypeError(f"{type(self).__name__} is a source without stream()")

    def length(self) -> int | None:
        """How many times `stream()` will yield, if known: for progress bars."""
        return None


def is_live(field: FieldInfo) -> bool:
    """Whether a parameter may be changed while the graph runs."""
    return isinstance(field.json_schema_extra, dict) and bool(field.json_schema_extra.get("live"))


def is_source(cls: type[Operator]) -> bool:
    return issubclass(cls, Source)


def validate_parameters(cls: type[Operator], params: Mapping[str, Any]) -> pydantic.BaseModel:
    """The parameters as a validated model; raises `ParameterError` with one line per fault."""
    try:
        return cls.spec.parameters(**params)
    except pydantic.ValidationError as error:
        raise ParameterError("\n".join(_explain(cls, fault) for fault in error.errors())) from None


def outputs_of(operator: Operator, returned: Outputs) -> dict[str, Message]:
    """What `process()` returned, as port → message; checked against the declared ports. Raises `OutputError`."""
    spec = operator.spec
    dynamic = [p for p in spec.outputs.values() if not p.static]
    if returned is None:
        return {}
    if isinstance(returned, Message):
        if len(dynamic) != 1:
            raise OutputError(
                f"{spec.name} returned one {returned.SCHEMA}, but has {len(dynamic)} outputs "
                f"({', '.join(p.name for p in dynamic) or 'none'}): return a mapping from port to message"
            )
        returned = {dynamic[0].name: returned}
    if not isinstance(returned, Mapping):
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
    return {name: emitted[name] for name in spec.outputs if name in emitted}


def _declare(
    cls: type[Operator],
    merge: bool | None,
    tolerance: str | int | None,
    every: str | int | None,
    local: Mapping[str, Any],
) -> OperatorSpec:
    def fault(attribute: str, text: str) -> OperatorDefinitionError:
        return OperatorDefinitionError(f"{cls.__module__}.{cls.__qualname__}.{attribute}: {text}")

    hints: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        if base in (Operator, Source, object):
            continue
        namespace = vars(sys.modules[base.__module__]) if base.__module__ in sys.modules else {}
        try:
            hints |= {
                name: typing._eval_type(  # type: ignore[attr-defined]
                    typing.ForwardRef(a, is_class=True) if isinstance(a, str) else a, namespace, dict(local)
                )
                for name, a in inspect.get_annotations(base).items()
            }
        except NameError as error:
            raise fault("(annotations)", f"{error}; port types must be importable where the class is made") from None

    inputs: dict[str, InputPort] = {}
    outputs: dict[str, OutputPort] = {}
    parameters: dict[str, Any] = {}
    for name, hint in hints.items():
        origin = typing.get_origin(hint) or hint
        value = getattr(cls, name, None)
        if origin is ClassVar:
            continue
        if origin not in _PORTS:
            if isinstance(value, (In, Sampled, Batch, Out)):
                raise fault(name, f"is a {type(value).__name__} port and must be annotated {type(value).__name__}[...]")
            if isinstance(value, FieldInfo):
                if hasattr(Operator, name) or hasattr(Source, name):
                    raise fault(name, "is a name that Operator uses; choose another for the parameter")
                parameters[name] = (hint, value)
            continue
        if name in ("context",) or hasattr(Operator, name) or hasattr(Source, name):
            raise fault(name, "is a name that Operator uses; choose another for the port")
        if value is not None and not isinstance(value, origin):
            raise fault(name, f"is annotated {origin.__name__}[...] but set to a {type(value).__name__}")
        port = origin() if value is None else value
        message_types = _port_types(hint)
        if not message_types:
            raise fault(name, f"needs a message type: {origin.__name__}[Image], or a union of message types")
        if isinstance(port, Out):
            outputs[name] = OutputPort(name, message_types, port.static, port.lag, port.doc)
        else:
            inputs[name] = _input_port(name, port, message_types)
    for name in dir(cls):
        value = inspect.getattr_static(cls, name, None)
        if isinstance(value, FieldInfo) and name not in parameters:
            raise fault(name, "is a parameter without a type: write `name: int = Param(...)`")
        if isinstance(value, (In, Sampled, Batch, Out)) and name not in inputs and name not in outputs:
            raise fault(name, f"is a port without a type: write `{name}: {type(value).__name__}[Image]`")

    triggers = [p for p in inputs.values() if p.kind == "in"]
    period = None if every is None else parse_duration(every)
    window = 0 if tolerance is None else parse_duration(tolerance)
    merge = bool(merge)
    if period is not None and period <= 0:
        raise fault("every", f"must be positive, got {every!r}")
    if merge and window:
        raise fault("tolerance", "has no meaning with merge=True: every message fires")
    if not merge and len(triggers) > 1:
        many = [p.name for p in triggers if p.many]
        if many:
            raise fault(many[0], "many=True on one of several joined inputs: use merge=True, or one stream an input")
    if issubclass(cls, Source):
        if inputs:
            raise fault(next(iter(inputs)), "a source has no inputs; derive from Operator instead")
        if not outputs:
            raise fault("(outputs)", "a source needs at least one Out[...]")
        takes: tuple[str, ...] = ()
    else:
        if not triggers and period is None:
            raise fault("(inputs)", 'nothing makes it fire: declare an In[...] or give every="100ms"')
        takes = _process_takes(cls, inputs, fault)
    model = pydantic.create_model(
        f"{cls.__name__}Parameters",
        __config__=pydantic.ConfigDict(extra="forbid", frozen=True, validate_default=True),
        **parameters,
    )
    return OperatorSpec(
        cls.__name__, inspect.cleandoc(cls.__doc__ or ""), inputs, outputs, model, merge, window, period, takes
    )


def _port_types(hint: Any) -> tuple[type[Message], ...]:
    found: list[type[Message]] = []
    for argument in typing.get_args(hint):
        members = (
            typing.get_args(argument) if typing.get_origin(argument) in (typing.Union, types.UnionType) else (argument,)
        )
        for member in members:
            if not (isinstance(member, type) and issubclass(member, Message)):
                return ()
            found.append(member)
    return tuple(found)


def _input_port(name: str, port: In[Any] | Sampled[Any] | Batch[Any], accepted: tuple[type[Message], ...]) -> InputPort:
    if isinstance(port, Sampled):
        return InputPort(name, "sampled", accepted, port.many, port.doc, port.max_age, port.required, port.before)
    if isinstance(port, Batch):
        return InputPort(name, "batch", accepted, port.many, port.doc, max_age=port.max_age, max=port.max)
    return InputPort(name, "in", accepted, port.many, port.doc)


def _process_takes(cls: type[Operator], inputs: Mapping[str, InputPort], fault: Any) -> tuple[str, ...]:
    if cls.process is Operator.process:
        raise fault("process", "is missing: define process(self, " + ", ".join(inputs) + ")")
    parameters = list(inspect.signature(cls.process).parameters.values())[1:]
    names = [p.name for p in parameters]
    for parameter in parameters:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise fault("process", f"must name its inputs ({', '.join(inputs)}) instead of *{parameter.name}")
        if parameter.name not in inputs and parameter.name != "context":
            raise fault("process", f"takes {parameter.name!r}, which is no input; inputs: {', '.join(inputs)}")
    missing = [name for name in inputs if name not in names]
    if missing:
        raise fault("process", f"does not take the input {missing[0]!r}")
    return tuple(names)


def _explain(cls: type[Operator], fault: Any) -> str:
    name = ".".join(str(part) for part in fault["loc"])
    fields = cls.spec.parameters.model_fields
    if fault["type"] == "extra_forbidden":
        known = ", ".join(fields) or "none"
        return f"{cls.__name__} has no parameter {name!r}; its parameters: {known}"
    if fault["type"] == "missing":
        return f"{cls.__name__}.{name} must be given: {fields[name].description}"
    return f"{cls.__name__}.{name}: {fault['msg']}, got {fault['input']!r}"
