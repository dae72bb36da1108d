"""Reads the body of a message envelope value by value, whatever it claims to hold."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np

from dataflow.messages.base import ArrayField, ScalarField
from dataflow.transport.envelope import DecodeError, Head, Limits

_NIL = 0xC0


class Body:
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
            raise self._error(f"{name}: expected an array: {short(error)}") from None
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
            raise self._error(f"{name}: {short(error)}") from None

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
            raise self._error(f"{spec.name}: dtype must be {known}, got {short(code)}")
        shape = tuple([self.value(spec.name) for _ in range(self.array(spec.name, None, self._limits.dimensions))])
        for extent in shape:
            if type(extent) is not int or not 0 <= extent <= self._limits.payload_bytes:
                raise self._error(f"{spec.name}: shape {short(shape)} is not one of integers from 0")
        return dtype, shape

    def finish(self) -> None:
        rest = len(self._data) - self._unpacker.tell()
        if rest:
            raise self._error(f"body: {rest} bytes after the array descriptors, expected none")

    def _nil(self) -> bool:
        position = self._unpacker.tell()
        return bool(position < len(self._data) and self._data[position] == _NIL)

    def _error(self, text: str) -> DecodeError:
        return DecodeError(f"{where(self._head)}: {text}")


def where(head: Head) -> str:
    """Names an envelope for an error."""
    return f"{head.kind.name} {head.seq} of {head.stream[:80]!r}"


def short(value: object) -> str:
    """Returns a value, or an error's text, cut to a length that fits into an error."""
    text = str(value) if isinstance(value, Exception) else repr(value)
    text = text or type(value).__name__
    return text if len(text) <= 200 else text[:200] + "…"
