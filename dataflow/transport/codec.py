"""The wire form of envelopes: encode, decode, and nothing else (pure, no I/O).

An envelope is one byte string: a fixed prelude, a msgpack head (which stream, which number, which stamp), for messages
a msgpack body (schema, header fields, array descriptors), and the arrays' raw bytes, each aligned to 64 bytes. The
format is specified byte by byte in `docs/wire-format.md`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import msgpack
import numpy as np
import numpy.typing as npt

from dataflow.messages.base import ArrayField, Message, MessageError, message_type
from dataflow.messages.fields.compiled import Compiled
from dataflow.transport.body import Body, short, where
from dataflow.transport.envelope import (
    ALIGNMENT,
    DEFAULT_LIMITS,
    MAGIC,
    PRELUDE,
    VERSION,
    Buffer,
    DecodeError,
    Envelope,
    Head,
    Kind,
    Limits,
)

TypeOf = Callable[[str], type[Message]]
"""The message class of a schema name; raises `MessageError` for an unknown one."""

_INT64_MIN, _INT64_MAX = -(2**63), 2**63 - 1
_PADDING = bytes(ALIGNMENT)
_HEAD_FIELDS: Final = 6
_KINDS: Final = {int(kind): kind for kind in Kind}
_MESSAGE: Final = Kind.MESSAGE  # the member of an enumeration is looked up anew, every time
_REFERENCE: Final = Kind.REFERENCE
_SMALL_BODY: Final = 4096
_SMALL_ARRAY: Final = 64
"""Bytes of a head or body, and elements of an array in it, up to which it is decoded as a whole: then a hostile one,
whose arrays claim lengths that they do not have, costs less than a megabyte."""


def encode_head(envelope: Envelope) -> bytes:
    """Returns the msgpack head alone; raises `ValueError` when it is longer than the prelude can say."""
    head: bytes = _pack(
        (envelope.stream, envelope.incarnation, envelope.seq, envelope.stamp, envelope.wall, envelope.reason)
    )
    if len(head) > 0xFFFF:
        raise ValueError(f"envelope head of {len(head)} bytes on {envelope.stream[:80]!r}: at most 65535")
    return head


def encode_parts(envelope: Envelope) -> list[Buffer]:
    """Returns the envelope as consecutive buffers, arrays by reference: joined, they are the wire form. Raises
    `ValueError` when a head or body exceeds what the prelude can say, or `message` does not fit `kind`."""
    message = envelope.message
    kind = envelope.kind
    if (message is not None) != (kind is _MESSAGE) or kind is _REFERENCE:
        raise ValueError(f"envelope of kind {kind.name} on {envelope.stream!r}: message is {message!r}")
    head = encode_head(envelope)
    if message is None:
        return [PRELUDE.pack(MAGIC, VERSION, kind, len(head), 0) + head]
    if message.stamp != envelope.stamp:
        raise ValueError(f"envelope on {envelope.stream!r}: stamp {envelope.stamp}, but its message's {message.stamp}")
    content, arrays = (message._made or message.compiled()).content(message)
    body = _pack(content)
    offset = PRELUDE.size + len(head) + len(body)
    parts: list[Buffer] = [PRELUDE.pack(MAGIC, VERSION, kind, len(head), len(body)) + head + body]
    for data in arrays:
        if data is None or data.nbytes == 0:
            continue
        padding = -offset % ALIGNMENT
        if padding:
            parts.append(_PADDING[:padding])
        parts.append(data.data.cast("B"))
        offset += padding + data.nbytes
    return parts


def encode(envelope: Envelope) -> bytes:
    """Returns the wire form of `envelope`; copies its arrays once."""
    return b"".join(encode_parts(envelope))


def parts_size(parts: Sequence[Buffer]) -> int:
    """Returns the bytes of the wire form that `parts` make up."""
    return sum(len(p) for p in parts)


def decode_head(buffer: Buffer, limits: Limits = DEFAULT_LIMITS) -> Head:
    """Returns the head alone: stream, kind, stamp and number, without looking at the message. Raises `DecodeError`."""
    return _head(_bytes_view(buffer), limits)[0]


def decode(buffer: Buffer, limits: Limits = DEFAULT_LIMITS, types: TypeOf = message_type) -> Envelope:
    """Returns the envelope in `buffer`, which must hold exactly one. `types` gives the class of a schema name. The
    message's arrays are read-only views of `buffer`, which must not change afterwards. Raises only `DecodeError`."""
    if limits is DEFAULT_LIMITS and (found := _usual(buffer, types)) is not None:
        return found
    view = _bytes_view(buffer)
    head, body_start, body_bytes = _head(view, limits)
    body_end = body_start + body_bytes
    if head.kind is Kind.REFERENCE:
        raise DecodeError(f"{where(head)}: it lies in shared memory that could not be opened here")
    if head.kind is not Kind.MESSAGE:
        if body_bytes or len(view) != body_end:
            raise DecodeError(f"{where(head)}: {len(view) - body_start} bytes after the head, expected none")
        message = None
    else:
        message = _message(view, head, body_start, body_end, limits, types)
    return Envelope(head.kind, head.stream, head.incarnation, head.seq, head.stamp, message, head.reason, head.wall)


def _bytes_view(buffer: Buffer) -> memoryview:
    try:
        return memoryview(buffer).cast("B").toreadonly()
    except TypeError:
        raise DecodeError(f"an envelope is contiguous bytes, got {type(buffer).__name__}") from None


def _unpacking(**limits: int) -> Callable[[Any], Any]:
    """A decoder of msgpack without maps, extensions and binary data."""
    return partial(msgpack.unpackb, raw=False, use_list=False, max_map_len=0, max_ext_len=0, max_bin_len=0, **limits)


_pack: Final = msgpack.Packer(autoreset=True).pack
_unpack_small = _unpacking(max_array_len=_SMALL_ARRAY, max_str_len=DEFAULT_LIMITS.string_bytes)
_ArrayDescribed = tuple[np.dtype[Any], tuple[int, ...], int]
_Described = tuple[type[Message], Compiled, tuple[Any, ...], tuple[_ArrayDescribed | None, ...]]
"""The class of a message with its functions, its scalars, and the dtype, shape and bytes of each of its arrays."""
_bodies: dict[bytes, _Described] = {}
_MOST_BODIES: Final = 64
_head_unpackers: dict[int, Callable[[Any], Any]] = {}


def _usual(buffer: Buffer, types: TypeOf) -> Envelope | None:
    """The envelope of a message with a small head and body, in one go; None where anything is rare, or wrong. This is
    what nearly every envelope is, so no function is called here that need not be."""
    try:
        magic, version, kind, head_bytes, body_bytes = PRELUDE.unpack_from(buffer)
        if kind != 1 or magic != MAGIC or version != VERSION or head_bytes > _SMALL_BODY or body_bytes > _SMALL_BODY:
            return None
        view = memoryview(buffer)
        if not view.readonly:
            view = view.toreadonly()
        start = PRELUDE.size + head_bytes
        offset = end = start + body_bytes
        stream, incarnation, seq, stamp, wall, reason = _unpack_small(view[PRELUDE.size : start])
        if (
            not (stream.__class__ is reason.__class__ is str and stream)
            or not (incarnation.__class__ is seq.__class__ is stamp.__class__ is wall.__class__ is int)
            or not (0 <= incarnation <= _INT64_MAX and 0 <= seq <= _INT64_MAX)
            or not (_INT64_MIN <= stamp <= _INT64_MAX and _INT64_MIN <= wall <= _INT64_MAX)
        ):
            return None
        data = view[start:end].tobytes()
        known = _bodies.get(data)
        if known is None or types(known[0].SCHEMA) is not known[0]:
            known = _described(data, types)
        cls, made, header, described = known
        arrays: list[npt.NDArray[Any] | None] = []
        for each in described:
            if each is None:
                arrays.append(None)
                continue
            dtype, shape, size = each
            offset += -offset % ALIGNMENT
            arrays.append(np.ndarray(shape, dtype, view, offset))  # raises where it does not fit
            offset += size
        if offset != len(view) or offset - end > DEFAULT_LIMITS.payload_bytes:
            return None
        message = cls.__new__(cls)
        if not made.adopt(message, stamp, header, arrays):
            return None
        return Envelope(_MESSAGE, stream, incarnation, seq, stamp, message, reason, wall)
    except Exception:  # the general decoder names the fault and its place
        return None


def _described(data: bytes, types: TypeOf) -> _Described:
    """Reads a small body. Raises for anything that is rare, or wrong. Most bodies of a stream are equal: what
    they say is kept."""
    schema, header, arrays = _unpack_small(data)
    cls = types(schema)
    made = cls._made or cls.compiled()
    described: list[_ArrayDescribed | None] = []
    for dtypes, array in zip(made.dtypes, arrays, strict=True):
        if array is None:
            described.append(None)
            continue
        code, shape = array
        dtype = dtypes[code]
        size = dtype.itemsize
        for extent in shape:
            if extent.__class__ is not int or extent <= 0:
                raise ValueError("an extent that is no positive number")
            size *= extent
        if dtype.kind == "b" or len(shape) > DEFAULT_LIMITS.dimensions or shape.__class__ is not tuple:
            raise ValueError("an array of bool, or of many dimensions")
        described.append((dtype, shape, size))
    if header.__class__ is not tuple:
        raise ValueError("a header that is no list")
    found = cls, made, header, tuple(described)
    if len(_bodies) >= _MOST_BODIES:
        _bodies.clear()
    _bodies[data] = found
    return found


def _head(view: memoryview, limits: Limits) -> tuple[Head, int, int]:
    """The head, where the body starts and how long it is."""
    if len(view) < PRELUDE.size:
        raise DecodeError(f"prelude: {len(view)} bytes, expected at least {PRELUDE.size}")
    magic, version, kind, head_bytes, body_bytes = PRELUDE.unpack_from(view)
    if magic != MAGIC:
        raise DecodeError(f"prelude: magic {magic.hex()}, expected {MAGIC.hex()}")
    if version != VERSION:
        raise DecodeError(f"prelude: version {version}, this decoder reads {VERSION}")
    if kind not in _KINDS:
        raise DecodeError(f"prelude: kind {kind}, known are {', '.join(f'{k.value} ({k.name})' for k in Kind)}")
    if head_bytes > limits.head_bytes or body_bytes > limits.body_bytes:
        for name, size, most in (("head", head_bytes, limits.head_bytes), ("body", body_bytes, limits.body_bytes)):
            if size > most:
                raise DecodeError(f"prelude: {name} of {size} bytes, at most {most} are accepted")
    body_start = PRELUDE.size + head_bytes
    if body_start + body_bytes > len(view):
        raise DecodeError(
            f"prelude: head and body of {head_bytes} + {body_bytes} bytes, but only {len(view) - PRELUDE.size} follow"
        )
    try:
        unpack = _head_unpackers.get(limits.string_bytes)
        if unpack is None:
            unpack = _unpacking(max_array_len=_HEAD_FIELDS, max_str_len=limits.string_bytes)
            _head_unpackers[limits.string_bytes] = unpack
        values = unpack(view[PRELUDE.size : body_start])
    except Exception as error:  # msgpack raises a dozen types for malformed input
        raise DecodeError(f"head: not msgpack as specified: {short(error)}") from None
    if type(values) is not tuple or len(values) != _HEAD_FIELDS:
        raise DecodeError(f"head: expected an array of {_HEAD_FIELDS}, got {short(values)}")
    stream, incarnation, seq, stamp, wall, reason = values
    if type(stream) is not str or type(reason) is not str or not stream:
        raise DecodeError("head: stream (not empty) and reason must be strings")
    if not (
        type(incarnation) is type(seq) is type(stamp) is type(wall) is int
        and 0 <= incarnation <= _INT64_MAX
        and 0 <= seq <= _INT64_MAX
        and _INT64_MIN <= stamp <= _INT64_MAX
        and _INT64_MIN <= wall <= _INT64_MAX
    ):
        raise _out_of_range(
            incarnation=(incarnation, 0), seq=(seq, 0), stamp=(stamp, _INT64_MIN), wall=(wall, _INT64_MIN)
        )
    return Head(_KINDS[kind], stream, incarnation, seq, stamp, wall, reason), body_start, body_bytes


def _out_of_range(**numbers: tuple[Any, int]) -> DecodeError:
    """The error for the first of some numbers, each with its least value, that is no such number."""
    for name, (value, least) in numbers.items():
        if type(value) is not int or not least <= value <= _INT64_MAX:
            return DecodeError(f"head: {name} must be an integer from {least} to {_INT64_MAX}, got {short(value)}")
    raise AssertionError(f"all of {numbers} are in range")


def _message(view: memoryview, head: Head, start: int, end: int, limits: Limits, types: TypeOf) -> Message:
    body = Body(view[start:end], head, limits)
    body.array("body", 3)
    schema = body.value("schema")
    if type(schema) is not str:
        raise DecodeError(f"{where(head)}: schema must be a string, got {short(schema)}")
    try:
        cls = types(schema)
    except MessageError as error:
        raise DecodeError(f"{where(head)}: {short(error)}") from None
    body.array("header", len(cls.SCALARS))
    scalars = [body.scalar(spec) for spec in cls.SCALARS]
    body.array("array descriptors", len(cls.ARRAYS))
    arrays: list[npt.NDArray[Any] | None] = []
    offset = end
    for spec in cls.ARRAYS:
        described = body.descriptor(spec)
        if described is None:
            arrays.append(None)
            continue
        dtype, shape = described
        size = dtype.itemsize * math.prod(shape)
        if size:
            offset += -offset % ALIGNMENT
        if offset - end + size > limits.payload_bytes:
            raise DecodeError(f"{where(head)}: {spec.name} ends past {limits.payload_bytes} payload bytes, the limit")
        if offset + size > len(view):
            raise DecodeError(
                f"{where(head)}: {spec.name} {dtype.name}{list(shape)} needs {size} bytes at {offset}, "
                f"but the envelope has {len(view)}"
            )
        arrays.append(_array(view, head, spec, dtype, shape, offset, size))
        offset += size
    body.finish()
    if offset != len(view):
        raise DecodeError(f"{where(head)}: {len(view) - offset} bytes after the last array, expected none")
    try:
        return cls.from_parts(head.stamp, scalars, arrays)
    except Exception as error:  # MessageError, and anything that a type's checks raise for unforeseen values
        raise DecodeError(f"{where(head)}: {type(error).__name__}: {short(error)}") from None


def _array(
    view: memoryview, head: Head, spec: ArrayField, dtype: np.dtype[Any], shape: tuple[int, ...], offset: int, size: int
) -> npt.NDArray[Any]:
    try:
        data: npt.NDArray[Any] = np.ndarray(shape, dtype, view, offset) if size else np.empty(shape, dtype)
    except ValueError as error:
        raise DecodeError(f"{where(head)}: {spec.name} {dtype.name}{list(shape)}: {short(error)}") from None
    data.flags.writeable = False
    if dtype.kind == "b" and size and int(data.view(np.uint8).max()) > 1:
        raise DecodeError(f"{where(head)}: {spec.name} holds a bool that is neither 0 nor 1")
    return data
