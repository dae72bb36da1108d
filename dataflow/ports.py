"""Ports and parameters of an operator: how a class writes them down, and what a declaration comes to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import pydantic
from pydantic import BeforeValidator
from pydantic.fields import FieldInfo

from dataflow.messages.base import Message
from dataflow.sync.stamps import parse_duration

T = TypeVar("T")

InputKind = Literal["in", "sampled", "batch"]
Outputs = Message | Mapping[str, object] | None
"""Result of `process()`: a message, a mapping from port to message or None, or None. A `TypedDict` is a mapping, too,
which type checkers compare with what is returned, port by port."""
Duration = Annotated[int, BeforeValidator(parse_duration)]
"""A parameter type: nanoseconds, written as `"100ms"`, `"2s"` or an integer."""


class OperatorDefinitionError(TypeError):
    """An operator class that is declared wrongly: names the class, the attribute and what would be right."""


class ParameterError(ValueError):
    """A parameter value that is refused: names the operator, the parameter, the value and what would be right."""


class SourceError(ValueError):
    """A file, folder or device that a source is to read, and cannot: names it, what is wrong and what would be right.

    A command prints the message alone, without a traceback.
    """


class OutputError(ValueError):
    """`process()` returned something that its ports cannot emit: names the operator and the port."""

    tells_all = True


class In(Generic[T]):
    """An input that triggers firings. Several are joined by stamp, or merged with `merge=True`.

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
    tunable: bool = False,
) -> Any:
    """Declares a parameter with its default, bounds and documentation. Without a default it must be given.

    `tunable`: it may be changed while the graph runs (`dataflow param set`): `process()` reads `self.<name>` anew each
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
        json_schema_extra={**({"unit": unit} if unit else {}), **({"tunable": True} if tunable else {})} or None,
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


@dataclass(frozen=True)
class OperatorSpec:
    """All that an operator class declares; everything else (checks, docs, viewer) reads it from here.

    `every` and `tolerance` are nanoseconds; `parameters` is a pydantic model of the parameters; `state` is the
    dataclass of the state, or None.
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
    state: Any = None
    absent: Mapping[str, tuple[()] | None] = field(init=False, repr=False, compare=False)
    """The arguments of `process()` for inputs that take no part in a firing."""
    takes_context: bool = field(init=False, repr=False, compare=False)
    """True when `process()` has a parameter named `context`."""
    only_output: OutputPort | None = field(init=False, repr=False, compare=False)
    """The one output that is not static, where there is exactly one."""

    def __post_init__(self) -> None:
        """Derives what every firing asks for: a plain attribute costs a tenth of a cached property."""
        dynamic = [port for port in self.outputs.values() if not port.static]
        absent = {name: () if port.kind == "batch" else None for name, port in self.inputs.items()}
        object.__setattr__(self, "absent", absent)
        object.__setattr__(self, "takes_context", "context" in self.process_takes)
        object.__setattr__(self, "only_output", dynamic[0] if len(dynamic) == 1 else None)

    @property
    def triggers(self) -> tuple[InputPort, ...]:
        return tuple(p for p in self.inputs.values() if p.kind == "in")


@dataclass(frozen=True, slots=True)
class Context:
    """Holds what a firing is besides its messages: given to `process()` when it has a parameter named `context`.

    `stale` names the inputs whose message is marked stale, `late` those that hold a message that arrived late (live
    runs only), `tick` is True where the timer fired.
    """

    stamp: int
    tick: bool = False
    stale: frozenset[str] = frozenset()
    late: frozenset[str] = frozenset()


def is_tunable(field: FieldInfo) -> bool:
    """Returns whether a parameter may be changed while the graph runs."""
    return isinstance(field.json_schema_extra, dict) and bool(field.json_schema_extra.get("tunable"))
