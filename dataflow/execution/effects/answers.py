"""The entry of a call in the journal: its key, and its answer or error in a form that a recording holds."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import xxhash

from dataflow.execution.effects.captured_values import surroundings
from dataflow.execution.failure import text_of
from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages.base import Message
from dataflow.state import StateError, plain

Call = Callable[..., Any]
DEPTH = 3
"""Errors within errors that are recorded."""


class EffectError(ValueError):
    """Raised for a call that cannot be journaled; the message has the call and the reason."""


class EffectMiss(BaseException):
    """Raised in a re-execution for a call whose answer is not recorded. Not an `Exception`: an operator that goes on
    without a service must not take a miss for a failure of the service."""


@dataclass(frozen=True, slots=True)
class Key:
    """The key of a call: its `module:name`, and the digest (16 bytes) of each argument by its position or name, and of
    what it sees besides by a place with a dot, such as `self.prompt`."""

    function: str
    arguments: Mapping[str, bytes]

    @property
    def name(self) -> str:
        """The name without the module."""
        return self.function.rpartition(":")[2]

    @staticmethod
    def of(call: Call, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Key:
        """Raises `EffectError` for a call without a name, or an argument that has no digest."""
        name = getattr(call, "__qualname__", "<lambda>")
        if name.endswith("<lambda>"):
            raise EffectError(f"effect({call!r}): a call is known by its name: give it a function or method with `def`")
        given = {**{str(k): value for k, value in enumerate(args)}, **kwargs}
        digests = {place: _digest(value, f"{name}({place})") for place, value in given.items()}
        return Key(f"{getattr(call, '__module__', None)}:{name}", {**digests, **_seen(call)})

    def without(self, places: Collection[str]) -> Key:
        """Returns the key without some places."""
        return Key(self.function, {place: d for place, d in self.arguments.items() if place not in places})

    def moved(self, call: Call) -> set[str]:
        """Returns the places that the call itself has changed, such as a count in its object."""
        after = _seen(call)
        before = {place for place in self.arguments if "." in place}
        return {place for place in before | after.keys() if self.arguments.get(place) != after.get(place)}

    def missing(self, recorded: Key) -> list[str]:
        """Returns the places in which a call is not the `recorded` one. Besides arguments, only places count that were
        recorded: others were changed by calls, or belonged to a library then."""
        mine, its = self.arguments, recorded.arguments
        roots = {place.partition(".")[0] for place in mine if "." in place}
        places = [p for p in {**mine, **its} if "." not in p or (p in its and p.partition(".")[0] in roots)]
        return [place for place in places if mine.get(place) != its.get(place)]

    def differing(self, others: Sequence[Key]) -> str:
        """Returns in words how a call differs from the recorded ones that were not asked for."""
        alike = [other for other in others if other.function == self.function]
        if not alike:
            return f"recorded there: {', '.join(other.function for other in others) or 'no further call'}"
        places = [place if "." in place else f"argument {place}" for place in self.missing(alike[0])]
        return f"{', '.join(places)} differs from the recorded call"


@dataclass(frozen=True, slots=True)
class Answer:
    """The outcome of a call, packed: what it returned, or the error that it raised."""

    raised: bool
    data: bytes

    @staticmethod
    def of(name: str, call: Call, args: Sequence[Any], kwargs: Mapping[str, Any], most: int) -> Answer:
        """Makes the call. An answer of another type, or of more than `most` bytes, becomes an `EffectError`."""
        try:
            answer = Answer(False, _packed(call(*args, **kwargs), f"answer of {name}"))
        except (KeyboardInterrupt, EffectMiss):
            raise
        except BaseException as error:
            answer = Answer(True, _packed_error(error))
        if len(answer.data) > most:
            problem = f"answer of {name}: {len(answer.data):,} bytes; a firing records {most:,} more: return less"
            answer = Answer(True, _packed_error(EffectError(problem)))
        return answer

    def error(self) -> BaseException:
        """The error, of the recorded class, or of the nearest base of it that can be made again."""
        return _remade(*unpack_state(self.data)[""])

    def value(self) -> Any:
        """Returns the answer as a new object. Raises the error that the call raised."""
        if self.raised:
            raise self.error()
        return unpack_state(self.data)[""]


def _packed(value: Any, place: str) -> bytes:
    try:
        return pack_state({"": value})
    except StateError as error:
        raise EffectError(str(error).replace("state.", place, 1)) from None
    except (ValueError, OverflowError) as error:
        raise EffectError(f"{place}: {error}") from None


def _packed_error(error: BaseException) -> bytes:
    return pack_state({"": _described(error, DEPTH)})


def _described(error: BaseException, depth: int) -> list[Any]:
    """Its class and the bases of that, text, arguments, attributes, and attributes that are errors, `depth` deep."""
    kinds = [[kind.__module__, kind.__qualname__] for kind in type(error).__mro__ if issubclass(kind, BaseException)]
    text, args = text_of(error), list(error.args)
    if isinstance(error, OSError) and type(error).__module__ == "builtins" and error.filename is not None:
        args += [error.filename, None, error.filename2]
    held = {name: value for name, value in vars(error).items() if _is_plain(name)}
    attributes = {name: value for name, value in held.items() if _is_plain(value)}
    errors = {name: value for name, value in held.items() if depth and isinstance(value, BaseException)}
    inner = {name: _described(value, depth - 1) for name, value in errors.items()}
    return [kinds, text, args if _is_plain(args) else [text], attributes, inner]


def _is_plain(value: Any) -> bool:
    try:
        pack_state({"": value})
    except (ValueError, OverflowError, RecursionError):
        return False
    return True


def _remade(
    kinds: Sequence[Sequence[str]],
    text: str,
    args: Sequence[Any],
    attributes: Mapping[str, Any],
    inner: Mapping[str, Sequence[Any]],
) -> BaseException:
    attributes = {**attributes, **{name: _remade(*described) for name, described in inner.items()}}
    for given in (args, [text]):
        for module, name in kinds:
            try:
                if (error := _of_kind(module, name, given, attributes)) is not None and str(error) == text:
                    return error
            except Exception:
                continue
    return Exception(text)


def _of_kind(module: str, name: str, args: Sequence[Any], attributes: Mapping[str, Any]) -> BaseException | None:
    """None where there is no such class of errors. Imports no package that is not loaded already."""
    if module.partition(".")[0] not in sys.modules:
        return None
    kind: Any = import_module(module)
    for part in name.split("."):
        kind = getattr(kind, part)
    if not (isinstance(kind, type) and issubclass(kind, BaseException)) or kind in (KeyboardInterrupt, EffectMiss):
        return None
    if kind.__module__ == "builtins":
        error: BaseException = kind(*args)
    else:
        error = kind.__new__(kind, *args)
        error.args = tuple(args)
    if type(error) is not kind:
        return None
    vars(error).update(attributes)
    return error


def _seen(call: Call) -> dict[str, bytes]:
    """Returns the digests of what a call sees besides its arguments, as far as that has any."""
    found: dict[str, bytes] = {}
    for place, value in surroundings(call).items():
        try:
            found[place] = _digest(value, place)
        except (EffectError, RecursionError):
            continue
    return found


def _digest(value: Any, place: str) -> bytes:
    if isinstance(value, Message):
        return value.digest()
    if isinstance(value, np.ndarray) and value.dtype != object:
        made = xxhash.xxh3_128(f"{value.dtype.str}{value.shape}".encode())
        made.update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
        return made.digest()
    try:
        return xxhash.xxh3_128_digest(pack_state({"": plain(value, place)}))
    except (ValueError, OverflowError) as error:
        raise EffectError(f"effect: {error}") from None
