"""The wire form of envelopes: encode, decode, and nothing else (pure, no I/O).

An envelope is one byte string: a fixed prelude, a msgpack head (which stream, which number, which stamp), for messages
a msgpack body (schema, header fields, array descriptors), and the arrays' raw bytes, each aligned to 64 bytes. The
format is specified byte by byte in `docs/wire-format.md`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import msgpack
import numpy as np
import numpy.typing as npt

from dataflow.messages.base import ArrayField, Message, MessageError, ScalarField, message_type
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
_NIL = 0xC0
_HEAD_FIELDS: Final = 6
_KINDS: Final = frozenset(Kind)


def encode_head(envelope: Envelope) -> bytes:
    """Returns the msgpack head alone; raises `ValueError` when it is longer than the prelude can say."""
    head: bytes = msgpack.packb(
        (envelope.stream, envelope.incarnation, envelope.seq, envelope.stamp, envelope.wall, envelope.reason)
    )
    if len(head) > 0xFFFF:
        raise ValueError(f"envelope head of {len(head)} bytes on {envelope.stream[:80]!r}: at most 65535")
    return head


def encode_parts(envelope: Envelope) -> list[Buffer]:
    """Returns the envelope as consecutive buffers, arrays by reference: joined, they are the wire form.

    Raises `ValueError` when a head or body exceeds what the prelude can say, or `message` does not fit `kind`.
    """
    message = envelope.message
    if (message is not None) != (envelope.kind is Kind.MESSAGE) or envelope.kind is Kind.REFERENCE:
        raise ValueError(f"envelope of kind {envelope.kind.name} on {envelope.stream!r}: message is {message!r}")
    head = encode_head(envelope)
    if message is None:
        return [PRELUDE.pack(MAGIC, VERSION, envelope.kind, len(head), 0) + head]
    if message.stamp != envelope.stamp:
        raise ValueError(f"envelope on {envelope.stream!r}: stamp {envelope.stamp}, but its message's {message.stamp}")
    arrays = message.arrays()
    described = [None if a is None else (a.dtype.str, a.shape) for a in arrays]
    body = msgpack.packb((message.SCHEMA, message.header(), described))
    offset = PRELUDE.size + len(head) + len(body)
    parts: list[Buffer] = [PRELUDE.pack(MAGIC, VERSION, envelope.kind, len(head), len(body)) + head + body]
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
    """Returns the envelope in `buffer`, which must hold exactly one. `types` gives the class of a schema name.

    The message's arrays are read-only views of `buffer`: nobody may write to it afterwards. Raises only `DecodeError`.
    """
    view = _bytes_view(buffer)
    head, body_start, body_bytes = _head(view, limits)
    body_end = body_start + body_bytes
    if head.kind is Kind.REFERENCE:
        raise DecodeError(f"{_where(head)}: it lies in shared memory that could not be opened here")
    if head.kind is not Kind.MESSAGE:
        if body_bytes or len(view) != body_end:
            raise DecodeError(f"{_where(head)}: {len(view) - body_start} bytes after the head, expected none")
        message = None
    else:
        message = _message(view, head, body_start, body_end, limits, types)
    return Envelope(head.kind, head.stream, head.incarnation, head.seq, head.stamp, message, head.reason, head.wall)


def _bytes_view(buffer: Buffer) -> memoryview:
    try:
        return memoryview(buffer).cast("B").toreadonly()
    except TypeError:
        raise DecodeError(f"an envelope is contiguous bytes, got {type(buffer).__name__}") from None


def _head(view: memoryview, limits: Limits) -> tuple[Head, int, int]:
    """The head, where the body starts and how long it is."""
    if len(view) < PRELUDE.size:
        raise DecodeError(f"prelude: {len(view)} bytes, expected at least {PRELUDE.size}")
    magic, version, kind, head_bytes, body_bytes = PRELUDE.unpack_from(view)
    if magic != MAGIC:
        raise DecodeError(f"prelude: magic {magic.hex()}, expected {MAGIC.hex()}")
    if version != VERSION:
        raise DecodeError(f"prelude: version {version}, this decoder knows {VERSION}")
    if kind not in _KINDS:
        raise DecodeError(f"prelude: kind {kind}, known are {', '.join(f'{k.value} ({k.name})' for k in Kind)}")
    for name, size, most in (("head", head_bytes, limits.head_bytes), ("body", body_bytes, limits.body_bytes)):
        if size > most:
            raise DecodeError(f"prelude: {name} of {size} bytes, at most {most} are accepted")
    body_start = PRELUDE.size + head_bytes
    if body_start + body_bytes > len(view):
        raise DecodeError(
            f"prelude: head and body of {head_bytes} + {body_bytes} bytes, but only {len(view) - PRELUDE.size} follow"
        )
    try:
        values = msgpack.unpackb(
            view[PRELUDE.size : body_start],
            raw=False,
            use_list=False,
            max_array_len=_HEAD_FIELDS,
            max_map_len=0,
            max_ext_len=0,
            max_bin_len=0,
            max_str_len=limits.string_bytes,
        )
    except Exception as error:  # msgpack raises a dozen types for malformed input
        raise DecodeError(f"head: not msgpack as specified: {_short(error)}") from None
    if type(values) is not tuple or len(values) != _HEAD_FIELDS:
        raise DecodeError(f"head: expected an array of {_HEAD_FIELDS}, got {_short(values)}")
    stream, incarnation, seq, stamp, wall, reason = values
    if type(stream) is not str or type(reason) is not str or not stream:
        raise DecodeError("head: stream (not empty) and reason must be strings")
    for name, value, least in (
        ("incarnation", incarnation, 0),
        ("seq", seq, 0),
        ("stamp", stamp, _INT64_MIN),
        ("wall", wall, _INT64_MIN),
    ):
        if type(value) is not int or not least <= value <= _INT64_MAX:
            raise DecodeError(f"head: {name} must be an integer from {least} to {_INT64_MAX}, got {_short(value)}")
    return Head(Kind(kind), stream, incarnation, seq, stamp, wall, reason), body_start, body_bytes


def _message(view: memoryview, head: Head, start: int, end: int, limits: Limits, types: TypeOf) -> Message:
    body = _Body(view[start:end], head, limits)
    body.array("body", 3)
    schema = body.value("schema")
    if type(schema) is not str:
        raise DecodeError(f"{_where(head)}: schema must be a string, got {_short(schema)}")
    try:
        cls = types(schema)
    except MessageError as error:
        raise DecodeError(f"{_where(head)}: {_short(error)}") from None
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
            raise DecodeError(f"{_where(head)}: {spec.name} ends past {limits.payload_bytes} payload bytes, the limit")
        if offset + size > len(view):
            raise DecodeError(
                f"{_where(head)}: {spec.name} {dtype.name}{list(shape)} needs {size} bytes at {offset}, "
                f"but the envelope has {len(view)}"
            )
        arrays.append(_array(view, head, spec, dtype, shape, offset, size))
        offset += size
    body.finish()
    if offset != len(view):
        raise DecodeError(f"{_where(head)}: {len(view) - offset} bytes after the last array, expected none")
    try:
        return cls.from_parts(head.stamp, scalars, arrays)
    except Exception as error:  # MessageError, and whatever a type's own checks meet in values nobody foresaw
        raise DecodeError(f"{_where(head)}: {type(error).__name__}: {_short(error)}") from None


def _array(
    view: memoryview,
    head: Head,
    spec: ArrayField,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    offset: int,
    size: int,
) -> npt.NDArray[Any]:
    try:
        data: npt.NDArray[Any] = np.ndarray(shape, dtype, view, offset) if size else np.empty(shape, dtype)
    except ValueError as error:
        raise DecodeError(f"{_where(head)}: {spec.name} {dtype.name}{list(shape)}: {_short(error)}") from None
    data.flags.writeable = False
    if dtype.kind == "b" and size and int(data.view(np.uint8).max()) > 1:
        raise DecodeError(f"{_where(head)}: {spec.name} holds a bool that is neither 0 nor 1")
    return data


class _Body:
    """Reads the body value by value, so that a hostile one cannot make the decoder nest or allocate.

    msgpack allocates an array for the length that its header claims; here only array headers are read, and the
    elements one by one, with nested arrays forbidden.
    """

    def __init__(self, data: memoryview, head: Head, limits: Limits) -> None:
        self._data = data
        self._head = head
        self._limits = limits
        self._unpacker = msgpack.Unpacker(
            raw=False,
            max_buffer_size=max(len(data), 1),
            read_size=max(len(data), 1),
            max_array_len=0,
            max_map_len=0,
            max_ext_len=0,
            max_bin_len=0,
            max_str_len=limits.string_bytes,
        )
        self._unpacker.feed(data)

    def array(self, name: str, expected: int | None, most: int = 0) -> int:
        """The length of the array that starts here; it must be `expected`, or, where that is None, at most `most`."""
        try:
            length: int = self._unpacker.read_array_header()
        except Exception as error:  # msgpack raises a dozen types for malformed input
            raise self._error(f"{name}: expected an array: {_short(error)}") from None
        if expected is not None and length != expected:
            raise self._error(f"{name}: expected {expected} elements, got {length}")
        if expected is None and length > most:
            raise self._error(f"{name}: {length} elements, at most {most} are accepted")
        return length

    def value(self, name: str) -> Any:
        """The next scalar (nil, bool, int, float or str)."""
        try:
            return self._unpacker.unpack()
        except Exception as error:  # msgpack raises a dozen types for malformed input
            raise self._error(f"{name}: {_short(error)}") from None

    def scalar(self, spec: ScalarField) -> Any:
        if spec.kind != "strs" or self._nil():
            return self.value(spec.name)
        return tuple([self.value(spec.name) for _ in range(self.array(spec.name, None, self._limits.strings))])

    def descriptor(self, spec: ArrayField) -> tuple[np.dtype[Any], tuple[int, ...]] | None:
        if self._nil():
            self.value(spec.name)
            return None
        self.array(spec.name, 2)
        code = self.value(spec.name)
        dtype = next((d for d in spec.dtypes if d.str == code), None)
        if dtype is None:
            known = " or ".join(repr(d.str) for d in spec.dtypes)
            raise self._error(f"{spec.name}: dtype must be {known}, got {_short(code)}")
        shape = tuple([self.value(spec.name) for _ in range(self.array(spec.name, None, self._limits.dimensions))])
        for extent in shape:
            if type(extent) is not int or not 0 <= extent <= self._limits.payload_bytes:
                raise self._error(f"{spec.name}: shape {_short(shape)} is not one of integers from 0")
        return dtype, shape

    def finish(self) -> None:
        rest = len(self._data) - self._unpacker.tell()
        if rest:
            raise self._error(f"body: {rest} bytes after the array descriptors, expected none")

    def _nil(self) -> bool:
        position = self._unpacker.tell()
        return bool(position < len(self._data) and self._data[position] == _NIL)

    def _error(self, text: str) -> DecodeError:
        return DecodeError(f"{_where(self._head)}: {text}")


def _where(head: Head) -> str:
    return f"{head.kind.name} {head.seq} of {head.stream[:80]!r}"


def _short(value: object) -> str:
    text = str(value) if isinstance(value, Exception) else repr(value)
    text = text or type(value).__name__
    return text if len(text) <= 200 else text[:200] + "…"
