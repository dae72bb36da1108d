"""Letters between a process and its workers: plain values, in anonymous files.

A writer does not wait for a reader here, as with a socket: a worker that hangs delays no other process.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import msgpack


def write_letter(descriptor: int, values: Mapping[str, Any]) -> None:
    """Puts plain values in place of what the file holds."""
    data = memoryview(msgpack.packb(values, use_bin_type=True))
    os.ftruncate(descriptor, 0)
    _write(descriptor, data, 0)


def read_letter(descriptor: int) -> dict[str, Any]:
    """The plain values that the file holds."""
    values: dict[str, Any] = msgpack.unpackb(_read(descriptor, 0, os.fstat(descriptor).st_size), strict_map_key=False)
    return values


def _write(descriptor: int, data: memoryview, offset: int) -> None:
    while data:
        written = os.pwrite(descriptor, data, offset)
        data, offset = data[written:], offset + written


def _read(descriptor: int, offset: int, size: int) -> bytes:
    parts = []
    while size and (part := os.pread(descriptor, size, offset)):
        parts.append(part)
        offset, size = offset + len(part), size - len(part)
    return b"".join(parts)
