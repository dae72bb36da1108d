"""State of operators as typed data: a snapshot and its restoration follow from the annotations.

    @dataclass
    class State:
        last: Pose | None = None
        tracks: dict[int, Track] = field(default_factory=dict)
        counts: Counter[str] = field(default_factory=Counter, metadata=KEPT)

    class Tracker(Operator):
        state: State

`plain` turns a value into numbers, strings, bytes, None, arrays, lists and mappings with string keys; `typed` turns
that back into a value of the annotated type. Two references to one object become two objects.
"""

from __future__ import annotations

import collections
import dataclasses
import enum
import functools
import itertools
import types
import typing
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, ClassVar

import numpy as np

from dataflow.messages.base import Message, MessageError, message_type

KEPT: Mapping[str, bool] = types.MappingProxyType({"kept": True})
"""Metadata of a dataclass field that a reset of the clock leaves as it is, such as counts for the summary."""

_SCALARS: dict[Any, tuple[type, ...]] = {
    int: (int,),
    float: (float, int),
    bool: (bool,),
    str: (str,),
    bytes: (bytes,),
    types.NoneType: (types.NoneType,),
}
_SEQUENCES = (list, collections.abc.Sequence)
_MAPPINGS = (dict, collections.abc.Mapping, collections.OrderedDict, Counter, defaultdict)


NewPart = Callable[[type[Any]], Any]


class StateError(ValueError):
    """A value that a snapshot cannot hold, or a snapshot that does not fit the state it is restored into."""


@dataclasses.dataclass
class Counts:
    """A state of counts, which a reset leaves alone and the summary shows; a base for states that have more."""

    counts: Counter[str] = dataclasses.field(default_factory=Counter, metadata=KEPT)


class Remembered:
    """A base for parts of a state that have settings besides: the annotated attributes of the class are the state.

        class Walls(Remembered):
            weight: float

            def __init__(self, settings: Settings) -> None:
                self._settings, self.weight = settings, 0.0

    Attributes without an annotation in the class body, and `ClassVar`s, are not part of it.
    """

    def prepare_snapshot(self) -> None:
        """Brings what is pending, or in memory kept for growth, into the attributes; called before a snapshot."""

    def new_part(self, kind: type[Any]) -> Any:
        """Returns a part that has `restore()` and is not there yet, with its settings; `kind()` by default."""
        return kind()

    def snapshot(self) -> Any:
        """Returns the annotated attributes as plain values. Raises `StateError` for a value of another type."""
        self.prepare_snapshot()
        place = type(self).__name__
        return {name: plain(getattr(self, name), f"{place}.{name}") for name in _hints(type(self))}

    def restore(self, state: Any) -> None:
        """Takes over the attributes that `snapshot` gave, then calls `restored`. Raises `StateError`."""
        take_over(self, _hints(type(self)), state, self.new_part)
        self.restored()

    def restored(self) -> None:
        """Derives what is not part of the state; called after the attributes were restored."""


class StateOf:
    """The attribute `state` of an operator class: made by `initial_state()` when it is first asked for."""

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is None:
            return self
        made = vars(instance)["state"] = instance.initial_state()
        return made


def fresh_state(cls: type, hint: Any) -> Any:
    """Returns a state of the annotated class `hint`, every field as by default. Raises `StateError`."""
    if not dataclasses.is_dataclass(hint):
        raise StateError(f"{cls.__name__}.state is annotated {hint!r}; a state is a dataclass")
    try:
        return hint()  # type: ignore[operator]
    except TypeError as error:
        raise StateError(
            f"{cls.__name__}.state: {error}; give every field a default, or define initial_state()"
        ) from error


def reset_state(old: Any, new: Any) -> None:
    """Hands the fields that a reset leaves alone on to the new state."""
    for each in dataclasses.fields(old):
        if each.metadata.get("kept"):
            setattr(new, each.name, getattr(old, each.name))


_AS_IS = frozenset({types.NoneType, bool, int, float, str, bytes, np.ndarray, np.float64, np.int64, np.bool_})
"""The types of most values, which are asked for first: a state may have thousands."""


def plain(value: Any, place: str = "state") -> Any:
    """Returns a value as a snapshot holds it. Raises `StateError` for one of another type, with its place."""
    match value:
        case enum.Enum():
            return value.name
        case None | bool() | int() | float() | str() | bytes() | np.ndarray() | np.generic():
            return value
        case complex():
            return [value.real, value.imag]
        case Message():
            names = [each.name for each in type(value).FIELDS]
            return {"schema": value.SCHEMA, "stamp": value.stamp, **_plain_attributes(value, names, place)}
        case _ if hasattr(value, "snapshot"):
            return value.snapshot()
        case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return _plain_attributes(value, _field_names(type(value)), place)
        case deque():
            return [value.maxlen, _plain_items(value, place)]
        case Mapping():
            return [[plain(key, place), plain(item, f"{place}[{key!r}]")] for key, item in value.items()]
        case set() | frozenset():
            items = [plain(item, place) for item in value]
            try:
                return sorted(items)
            except TypeError:
                raise StateError(f"{place} is a set of values that have no order; use a dict or a list") from None
        case list() | tuple():
            return _plain_items(value, place)
        case _:
            raise StateError(
                f"{place} is a {type(value).__name__}; a state holds numbers, strings, bytes, None, numpy arrays, "
                "enums, messages, dataclasses, objects with snapshot() and restore(), and collections of these"
            )


def _plain_attributes(value: Any, names: Iterable[str], place: str) -> dict[str, Any]:
    return {
        name: own if type(own := getattr(value, name)) in _AS_IS else plain(own, f"{place}.{name}") for name in names
    }


def _plain_items(value: Iterable[Any], place: str) -> list[Any]:
    return [item if type(item) in _AS_IS else plain(item, f"{place}[{k}]") for k, item in enumerate(value)]


@functools.cache
def _field_names(kind: Any) -> tuple[str, ...]:
    return tuple(each.name for each in dataclasses.fields(kind))


def typed(hint: Any, value: Any, place: str = "state", current: Any = None, new_part: NewPart | None = None) -> Any:
    """Returns the value of type `hint` that `plain` turned into `value`. Raises `StateError` where it does not fit.

    Objects with `restore()` are those of `current` at the same place, restored; `new_part` makes others.
    """
    return _Typing(new_part or (lambda kind: kind())).typed(hint, value, place, current)


def take_over(target: Any, hints: Mapping[str, Any], state: Any, new_part: NewPart) -> None:
    """Sets the attributes `hints` of `target` as `state` holds them, parts with `restore()` as `typed` does.

    Raises `StateError` where `state` lacks one or has others.
    """
    name = type(target).__name__
    for attribute in _names_to_take(name, [*hints], state, [each for each in hints if hasattr(target, each)]):
        hint = hints[attribute]
        current = getattr(target, attribute, None)
        setattr(target, attribute, typed(hint, state[attribute], f"{name}.{attribute}", current, new_part))


def seen(kind: type | None, state: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a state that `plain` made, for inspection: dicts, sets, tuples and queues as the fields of the
    dataclass `kind` declare them; dataclasses and messages stay mappings, enums names.

    What is declared nowhere, or does not fit, is as `plain` made it.
    """
    hints, seeing = {} if kind is None else state_hints(kind), _Seeing(lambda part: part())
    found = dict(state)
    for name in hints.keys() & found.keys():
        with suppress(StateError):
            found[name] = seeing.typed(hints[name], found[name], name, None)
    return found


_HINTS: dict[type, dict[str, Any]] = {}


def _hints(cls: type) -> dict[str, Any]:
    hints = _HINTS.get(cls)
    if hints is None:
        found = typing.get_type_hints(cls)
        hints = _HINTS[cls] = {name: hint for name, hint in found.items() if typing.get_origin(hint) is not ClassVar}
    return hints


def state_hints(state: Any) -> dict[str, Any]:
    """Returns the fields of a dataclass, or of an object of it, and their types."""
    hints = _hints(state if isinstance(state, type) else type(state))
    return {each.name: hints[each.name] for each in dataclasses.fields(state)}


def _with_arguments(hint: Any, bound: Mapping[Any, Any]) -> Any:
    """Returns a type with the arguments of a generic class put in for its type variables."""
    if isinstance(hint, typing.TypeVar):
        return bound.get(hint, hint)
    open_ = () if isinstance(hint, type) else getattr(hint, "__parameters__", ())
    return hint[tuple(bound.get(each, each) for each in open_)] if open_ else hint


def _bound_hints(kind: Any, arguments: Sequence[Any]) -> dict[str, Any]:
    """Returns the fields of a class, generic or not, and their types."""
    bound = dict(zip(getattr(kind, "__parameters__", ()), arguments, strict=False))
    return {name: _with_arguments(hint, bound) for name, hint in _hints(kind).items()}


_OF_ANOTHER_VERSION: ContextVar[bool] = ContextVar("_OF_ANOTHER_VERSION", default=False)


@contextmanager
def of_another_version() -> Iterator[None]:
    """Inside, a state of a former version of its class is taken over, where there is no better one: fields that it
    lacks are as by default, and those that the class has no more are left out."""
    token = _OF_ANOTHER_VERSION.set(True)
    try:
        yield
    finally:
        _OF_ANOTHER_VERSION.reset(token)


def _names_to_take(name: str, names: Sequence[str], state: Any, with_default: Collection[str]) -> list[str]:
    """Returns the fields that are taken from `state`. Raises `StateError` where it has others."""
    if not isinstance(state, Mapping):
        raise StateError(f"{name} is a {type(state).__name__}, expected its fields")
    lenient = _OF_ANOTHER_VERSION.get()
    new = [each for each in sorted(names) if each not in state and not (lenient and each in with_default)]
    gone = [] if lenient else sorted(set(state) - set(names))
    if new or gone:
        what = [f"has no {', '.join(new)}, which the class has now"] if new else []
        what += [f"has {', '.join(gone)}, which the class has no more"] if gone else []
        raise StateError(f"the state of {name} {'; it '.join(what)}")
    return [each for each in names if each in state]


def _listed(value: Any, place: str, length: int | None = None) -> Any:
    if not isinstance(value, list) or (length is not None and len(value) != length):
        what = "items" if length is None else f"{length} items"
        raise StateError(f"{place}: expected a list of {what}, got {value!r:.60}")
    return value


def _scalar(kind: type, value: Any, place: str) -> Any:
    if isinstance(value, np.ndarray) and value.shape == ():
        value = value.item()
    if not isinstance(value, _SCALARS[kind]):
        raise StateError(f"{place}: expected a {kind.__name__}, got a {type(value).__name__}")
    return value if value is None or isinstance(value, bool) else kind(value)  # Python counts with bools, too


def _message(value: Any, place: str) -> Message:
    if not isinstance(value, Mapping) or "schema" not in value:
        raise StateError(f"{place}: expected a message, got a {type(value).__name__}")
    content = {key: item for key, item in value.items() if key != "schema"}
    try:
        return message_type(value["schema"])(**content)
    except (MessageError, TypeError) as error:
        raise StateError(f"{place}: {error}") from error


@dataclasses.dataclass(frozen=True)
class _Typing:
    """Values of annotated types, made of plain ones; `new_part` makes the objects with `restore()` that are new."""

    new_part: NewPart

    def typed(self, hint: Any, value: Any, place: str, current: Any) -> Any:
        origin, arguments = typing.get_origin(hint) or hint or types.NoneType, typing.get_args(hint)
        if origin in _SCALARS:
            return _scalar(origin, value, place)
        if origin in (typing.Union, types.UnionType):
            return self._one_of(arguments, value, place, current)
        if origin is typing.Annotated:
            return self.typed(arguments[0], value, place, current)
        if isinstance(origin, typing.TypeVar):
            return self.typed(origin.__bound__ or Any, value, place, current)
        if origin in (Any, object, typing.Literal):
            return value
        if origin in (set, frozenset):
            kind = arguments[0] if arguments else Any
            return origin(self._hashed(kind, item, place) for item in _listed(value, place))
        if origin in _SEQUENCES:
            return self._items(arguments[:1], value, place, current)
        if origin is tuple:
            return self._tuple(arguments, value, place, current)
        if origin is deque:
            longest, items = _listed(value, place, 2)
            return deque(self._items(arguments, items, place, current), maxlen=longest)
        if origin in _MAPPINGS:
            return self._mapping(origin, arguments, value, place, current)
        if origin is complex:
            return complex(*_listed(value, place, 2))
        if isinstance(origin, type):
            return self._object(origin, arguments, value, place, current)
        raise StateError(f"{place}: a {hint!r} cannot be restored")

    def _one_of(self, members: Sequence[Any], value: Any, place: str, current: Any) -> Any:
        faults = []
        for member in members:
            try:
                return self.typed(member, value, place, current)
            except StateError as error:
                faults.append(str(error))
        raise StateError(faults[0] if len(faults) == 1 else f"{place}: fits none of its types ({'; '.join(faults)})")

    def _items(self, arguments: Sequence[Any], value: Any, place: str, current: Any) -> list[Any]:
        kind = arguments[0] if arguments else Any
        there = current if isinstance(current, list | tuple | deque) else ()
        pairs = itertools.zip_longest(_listed(value, place), itertools.islice(there, len(value)))
        return [self.typed(kind, item, f"{place}[{k}]", old) for k, (item, old) in enumerate(pairs)]

    def _tuple(self, arguments: Sequence[Any], value: Any, place: str, current: Any) -> tuple[Any, ...]:
        if not arguments or arguments[-1] is Ellipsis:
            return tuple(self._items(arguments[:1], value, place, current))
        items = _listed(value, place, len(arguments))
        there = current if isinstance(current, tuple) and len(current) == len(items) else (None,) * len(items)
        each = zip(arguments, items, there, strict=True)
        return tuple(self.typed(kind, item, place, old) for kind, item, old in each)

    def _hashed(self, hint: Any, value: Any, place: str) -> Any:
        """A key of a dict, or a member of a set."""
        return self.typed(hint, value, place, None)

    def _mapping(self, origin: Any, arguments: Sequence[Any], value: Any, place: str, current: Any) -> Any:
        of_key, of_item = (arguments[0] if arguments else Any), (arguments[1] if len(arguments) > 1 else int)
        pairs = [_listed(pair, place, 2) for pair in _listed(value, place)]
        made: Any = Counter() if origin is Counter else {}
        if origin is defaultdict:
            made = defaultdict(typing.get_origin(of_item) or of_item)
        there = current if isinstance(current, Mapping) else {}
        for plain_key, item in pairs:
            key = self._hashed(of_key, plain_key, place)
            made[key] = self.typed(of_item, item, f"{place}[{plain_key!r}]", there.get(key))
        return made

    def _object(self, kind: type, arguments: Sequence[Any], value: Any, place: str, current: Any) -> Any:
        """An array, number of numpy, enum, message, dataclass or object with `restore()`."""
        if issubclass(kind, np.ndarray | np.generic):
            if not isinstance(value, np.ndarray | np.generic):
                raise StateError(f"{place}: expected an array, got a {type(value).__name__}")
            return np.array(value) if issubclass(kind, np.ndarray) else value.dtype.type(value.item())
        if issubclass(kind, enum.Enum):
            if value not in kind.__members__:
                raise StateError(f"{place}: {value!r} is none of {', '.join(kind.__members__)}")
            return kind[value]
        if issubclass(kind, Message):
            return _message(value, place)
        if issubclass(kind, tuple) and hasattr(kind, "_fields"):
            hints = _hints(kind)
            return kind(*self._tuple([hints[name] for name in kind._fields], value, place, current))
        if hasattr(kind, "restore"):
            if value is None:  # of a part that may be missing
                raise StateError(f"{place}: expected a {kind.__name__}, got none")
            made: Any = current if isinstance(current, kind) else self.new_part(kind)
            made.restore(value)
            return made
        if dataclasses.is_dataclass(kind):
            return self._dataclass(kind, arguments, value, place, current)
        raise StateError(f"{place}: a {kind.__name__} cannot be restored")

    def _dataclass(self, kind: Any, arguments: Sequence[Any], value: Any, place: str, current: Any) -> Any:
        hints = _bound_hints(kind, arguments)
        fields = dataclasses.fields(kind)
        missing = dataclasses.MISSING
        able = [f.name for f in fields if not f.init or (f.default, f.default_factory) != (missing, missing)]
        names = _names_to_take(f"{place} ({kind.__name__})", [each.name for each in fields], value, able)
        restored = {
            name: self.typed(hints[name], value[name], f"{place}.{name}", getattr(current, name, None))
            for name in names
        }
        made = kind(**{each.name: restored[each.name] for each in fields if each.init and each.name in restored})
        for each in fields:
            if not each.init and each.name in restored:
                object.__setattr__(made, each.name, restored[each.name])
        return made


class _Seeing(_Typing):
    """Values as `seen` gives them."""

    def _hashed(self, hint: Any, value: Any, place: str) -> Any:
        made = typed(hint, value, place)
        return made.name if isinstance(made, enum.Enum) else made

    def _object(self, kind: type, arguments: Sequence[Any], value: Any, place: str, current: Any) -> Any:
        if issubclass(kind, np.ndarray | np.generic | tuple):
            return super()._object(kind, arguments, value, place, current)
        fields = dataclasses.is_dataclass(kind) and not issubclass(kind, Message) and not hasattr(kind, "restore")
        if not fields and not issubclass(kind, Remembered):
            if value is None:
                raise StateError(f"{place}: expected a {kind.__name__}, got none")
            return value
        hints = _bound_hints(kind, arguments)
        if not isinstance(value, Mapping) or value.keys() != hints.keys():
            raise StateError(f"{place}: expected the fields of a {kind.__name__}, got {value!r:.60}")
        return {name: self.typed(hints[name], value[name], f"{place}.{name}", None) for name in value}
