"""The wire format of protobuf, as far as ONNX files need it: fields of a message, read and written.

https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

_VARINT, _LENGTH_DELIMITED = 0, 2
_FIXED = {1: 8, 5: 4}


@dataclass(frozen=True)
class Field:
    """A field of a message: its number, its content where that is a string, bytes or a message (else empty), and its
    bytes as they stand in the message."""

    number: int
    content: bytes
    serialized: bytes


def fields(message: bytes) -> Iterator[Field]:
    """Reads the fields of a message, in order. Raises ValueError for what is no message."""
    at = 0
    while at < len(message):
        start = at
        key, at = _read_varint(message, at)
        number, kind = key >> 3, key & 7
        content = b""
        if kind == _LENGTH_DELIMITED:
            size, at = _read_varint(message, at)
            content = message[at : at + size]
            at += size
        elif kind == _VARINT:
            _, at = _read_varint(message, at)
        elif kind in _FIXED:
            at += _FIXED[kind]
        else:
            raise ValueError(f"byte {start} begins no field of a protobuf message: its kind is {kind}")
        if at > len(message):
            raise ValueError(f"the field {number} at byte {start} ends after the message of {len(message)} bytes")
        yield Field(number, content, message[start:at])


def field(number: int, content: bytes) -> bytes:
    """Writes a field whose content is a string, bytes or a message."""
    return varint(number << 3 | _LENGTH_DELIMITED) + varint(len(content)) + content


def number_field(number: int, value: int) -> bytes:
    """Writes a field that is a whole number, not below 0."""
    return varint(number << 3 | _VARINT) + varint(value)


def varint(value: int) -> bytes:
    """Writes a whole number, not below 0."""
    written = bytearray()
    while value > 127:
        written.append(value & 127 | 128)
        value >>= 7
    return bytes([*written, value])


def _read_varint(message: bytes, at: int) -> tuple[int, int]:
    value = 0
    for k in range(10):
        if at + k >= len(message):
            break
        byte = message[at + k]
        value |= (byte & 127) << 7 * k
        if byte < 128:
            return value, at + k + 1
    raise ValueError(f"byte {at} begins no number of a protobuf message of {len(message)} bytes")
