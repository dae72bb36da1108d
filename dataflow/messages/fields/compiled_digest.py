"""The text of a message class's digest function, and the bytes that it digests (`compiled` calls it)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import xxhash

from dataflow.messages.fields.declared import ArrayField, ScalarField

ONE_UPDATE = 1 << 14
"""Bytes of an array up to which it is copied into the buffer that is digested, instead of being digested in place."""
CACHED_TEXT = 64
"""Characters of a text up to which its canonical bytes are kept: names of frames, models and classes come again."""


def digest_text(
    names: dict[str, Any], schema: str, scalars: tuple[ScalarField, ...], arrays: tuple[ArrayField, ...]
) -> list[str]:
    """One buffer for all that is small; arrays that are large are digested where they lie, in order."""
    names |= NAMES
    encoded = schema.encode()
    names["_prefix"] = struct.pack("<I", len(encoded)) + encoded
    names["_stamp_bytes"] = struct.Struct("<q").pack
    names["_int_bytes"], names["_float_bytes"] = struct.Struct("<cq").pack, struct.Struct("<cd").pack
    head = ["_prefix", "_stamp_bytes(_self.stamp)"]
    later = []
    for spec in scalars:
        value = value_text(spec)
        canonical = {
            "bool": f"(b'T' if {value} else b'F')",
            "int": f"_int_bytes(b'i', {value})",
            "float": f"_float_bytes(b'f', {value})",
            "str": f"(_text({value}) if _len({value}) <= _short else _long_text({value}))",
            "strs": f"(_words({value}) if {value} else _no_words)",
        }[spec.kind]
        if spec.added:
            later.append(f"(b'' if {value} is None else {spec.name.encode()!r} + {canonical})")
            continue
        head.append(f"(b'n' if {value} is None else {canonical})" if spec.optional else canonical)
    head += later
    text = ["def _digest(_self):", "    _state = _self.__dict__"]
    if not arrays:
        return [*text, f"    return _digest_of(_join(({', '.join(head)})))"]
    text.append(f"    _parts = [{', '.join(head)}]")
    text.append("    _hash = None")
    for k, held in enumerate(arrays):
        text += [
            f"    _a = _state[{held.name!r}]",
            "    if _a is None:",
            "        _parts.append(b'\\x00')" if not held.added else "        pass",
            "    else:",
            *([f"        _parts.append({held.name.encode()!r})"] if held.added else []),
            f"        _parts += ({_by_dtype(names, k, held, '_a', _dtype_bytes, '_dtype({})')}, _shape(_a.shape))",
            "        if _a.nbytes <= _small:",
            "            _parts.append(_a.tobytes())",
            "        else:",
            "            _hash = _hasher(_join(_parts)) if _hash is None else _updated(_hash, _join(_parts))",
            "            _hash.update(_a.data.cast('B'))",
            "            _parts.clear()",
        ]
    text += [
        "    if _hash is None:",
        "        return _digest_of(_join(_parts))",
        "    _hash.update(_join(_parts))",
        "    return _hash.digest()",
    ]
    return text


def value_text(spec: ScalarField) -> str:
    """An expression for the value of a field; one that was not given raises the `MessageError` that names it."""
    return f"_self.{spec.name}" if spec.anchored else f"_state[{spec.name!r}]"


def content_text(names: dict[str, Any], scalars: tuple[ScalarField, ...], arrays: tuple[ArrayField, ...]) -> list[str]:
    """The fields in order: (schema, scalars, (dtype, shape) of each array), and the arrays."""
    described = []
    for k, spec in enumerate(arrays):
        array = f"({_by_dtype(names, k, spec, f'_a{k}', _dtype_name, '{}.str')}, _a{k}.shape)"
        described.append(f"None if _a{k} is None else {array}, " if spec.optional else f"{array}, ")
    return [
        "def _content(_self):",
        "    _state = _self.__dict__",
        *(f"    _a{k} = _state[{spec.name!r}]" for k, spec in enumerate(arrays)),
        f"    _scalars = ({''.join(f'{value_text(f)}, ' for f in scalars)})",
        f"    return (_schema, _scalars, ({''.join(described)})), ({''.join(f'_a{k}, ' for k in range(len(arrays)))})",
    ]


def _by_dtype(
    names: dict[str, Any], k: int, spec: ArrayField, array: str, made: Callable[[np.dtype[Any]], Any], other: str
) -> str:
    """An expression for what `made` gives for the array's dtype: made beforehand for the first that is declared, by
    the expression `other` of the dtype for any other."""
    dtype = np.dtype(spec.dtypes[0].str)  # the one object that numpy has for it
    names[f"_type{k}_0"] = dtype
    names[f"{made.__name__}{k}"] = made(dtype)
    return f"({made.__name__}{k} if {array}.dtype is _type{k}_0 else {other.format(f'{array}.dtype')})"


def _updated(hasher: Any, data: bytes) -> Any:
    hasher.update(data)
    return hasher


def _dtype_name(dtype: np.dtype[Any]) -> str:
    return dtype.str


@lru_cache(maxsize=64)
def _dtype_bytes(dtype: np.dtype[Any]) -> bytes:
    return b"\x01" + dtype.str.encode()


@lru_cache(maxsize=128)  # compressed images differ in length
def _shape_bytes(shape: tuple[int, ...]) -> bytes:
    return struct.pack(f"<B{len(shape)}q", len(shape), *shape)


def _text_bytes(text: str) -> bytes:
    encoded = text.encode()
    return b"s" + struct.pack("<I", len(encoded)) + encoded


_short_text_bytes = lru_cache(maxsize=1024)(_text_bytes)


def _words_bytes(words: tuple[str, ...]) -> bytes:
    """The bytes of a list of strings: their number, then each with its length."""
    encoded = [word.encode() for word in words]
    return b"l" + struct.pack("<I", len(words)) + b"".join(struct.pack("<I", len(w)) + w for w in encoded)


NAMES: Mapping[str, Any] = {
    "_digest_of": xxhash.xxh3_128_digest,
    "_dtype": _dtype_bytes,
    "_hasher": xxhash.xxh3_128,
    "_join": b"".join,
    "_shape": _shape_bytes,
    "_small": ONE_UPDATE,
    "_len": len,
    "_long_text": _text_bytes,
    "_no_words": _words_bytes(()),
    "_short": CACHED_TEXT,
    "_text": _short_text_bytes,
    "_updated": _updated,
    "_words": _words_bytes,
}
"""Names that the text of a digest refers to, besides those that belong to its class."""
