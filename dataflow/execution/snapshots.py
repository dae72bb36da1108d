"""Operator states as bytes: what `Operator.snapshot()` gives, in one form that equal states share."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any

import msgpack
import numpy as np

from dataflow.state import StateError

_ARRAY = 1
_LONGEST_HEADER = 1024
"""Bytes of the type and shape in front of an array's: at most 64 lengths of up to 9 bytes each."""
_AS_IS = frozenset({type(None), bool, int, float, str, bytes})


def pack_state(state: Mapping[str, Any]) -> bytes:
    """Raises `StateError` for values of other types, with the place in the state."""
    packed: bytes = msgpack.packb(_plain(state, "state"), use_bin_type=True)
    return packed


def unpack_state(data: bytes) -> Any:
    """Raises `StateError` for bytes that `pack_state` did not make."""
    try:
        return msgpack.unpackb(data, raw=False, ext_hook=_array, strict_map_key=True)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise StateError(f"not an operator's state: {error}") from error


def differing_fields(recorded: bytes, here: bytes) -> str:
    """Returns in words how two packed states differ, of which one may be empty. Raises `StateError` for other bytes."""
    if not (recorded and here):
        return "none is given now" if recorded else "none was recorded"
    before, now = unpack_state(recorded), unpack_state(here)
    if not (isinstance(before, Mapping) and isinstance(now, Mapping)):
        return "another kind of value"
    if (other := _other_version(before, now)) is not None:
        return f"of another version of the operator: {other}"
    return "in " + ", ".join(
        name for name in sorted(now) if pack_state({"": before[name]}) != pack_state({"": now[name]})
    )


def alike_but_for_fields(recorded: bytes, here: bytes) -> bool:
    """Returns whether two packed states hold the same in all fields that both have."""
    if not (recorded and here):
        return False
    return _alike(unpack_state(recorded), unpack_state(here))


def _alike(before: Any, now: Any) -> bool:
    if isinstance(before, Mapping) and isinstance(now, Mapping) and "schema" not in {*before, *now}:
        return all(_alike(before[name], now[name]) for name in before.keys() & now.keys())
    if isinstance(before, list) and isinstance(now, list):
        return len(before) == len(now) and all(map(_alike, before, now))
    return pack_state({"": before}) == pack_state({"": now})


def _other_version(before: Any, now: Any, place: str = "") -> str | None:
    """Returns in words where two states are of two versions: mappings, messages aside, have other keys."""
    if not (isinstance(before, Mapping) and isinstance(now, Mapping)):
        forms = {type(each) if isinstance(each, list | Mapping) else None for each in (before, now)}
        other = len(forms) > 1 and before is not None and now is not None
        return f"the recorded one holds {place} in another form" if other else None
    if "schema" in before or "schema" in now:
        return None
    if before.keys() != now.keys():
        lacks, more = (
            ", ".join(sorted(names)) or "none" for names in (now.keys() - before.keys(), before.keys() - now.keys())
        )
        return f"the recorded one lacks {lacks} and has {more} besides{f' in {place}' if place else ''}"
    found = (_other_version(before[name], now[name], f"{place}.{name}".lstrip(".")) for name in sorted(now))
    return next((each for each in found if each), None)


def changed_places(before: Any, after: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yields the places at which two unpacked states differ, as deep as mappings go: the names that lead there."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for name in sorted({*before, *after}):
            yield from changed_places(before.get(name), after.get(name), (*place, name))
    elif pack_state({"": before}) != pack_state({"": after}):
        yield place


def _plain(value: Any, place: str) -> Any:
    match value:
        case np.ndarray() if value.dtype != object:
            data = np.ascontiguousarray(value).reshape(-1).view(np.uint8).data if value.size else b""
            return msgpack.ExtType(_ARRAY, b"".join((_header(value.dtype.str, value.shape), data)))
        case np.generic():
            return _plain(np.asarray(value), place)
        case dict() | Mapping():
            for key in value:
                if not isinstance(key, str):
                    raise StateError(f"{place}: key {key!r} is no string")
            return {
                key: own if type(own := value[key]) in _AS_IS else _plain(own, f"{place}.{key}")
                for key in sorted(value)
            }
        case list() | tuple():
            return [item if type(item) in _AS_IS else _plain(item, f"{place}[{k}]") for k, item in enumerate(value)]
        case None | bool() | int() | float() | str() | bytes():
            return value
        case _:
            raise StateError(
                f"{place} is a {type(value).__name__}; recorded are numbers, strings, bytes, None, numpy arrays, lists "
                "and mappings"
            )


@functools.lru_cache(4096)
def _header(dtype: str, shape: tuple[int, ...]) -> bytes:
    packed: bytes = msgpack.packb([dtype, list(shape)])
    return packed


def _array(code: int, data: bytes) -> Any:
    if code != _ARRAY:
        raise StateError(f"a value of unknown kind {code}")
    unpacker = msgpack.Unpacker(raw=False)
    unpacker.feed(data[:_LONGEST_HEADER])
    dtype, shape = unpacker.unpack()
    return np.frombuffer(data, np.dtype(dtype), offset=unpacker.tell()).reshape(shape).copy()
