"""Letters between a process and its workers: plain values and firing records, in anonymous files.

A writer does not wait for a reader here, as with a socket: a worker that hangs delays no other process.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import msgpack

from dataflow.records.reading import FiringLog


def write_letter(descriptor: int, values: Mapping[str, Any]) -> None:
    """Puts plain values in place of what the file holds."""
    data = memoryview(msgpack.packb(values, use_bin_type=True))
    os.ftruncate(descriptor, 0)
    _write(descriptor, data, 0)


def read_letter(descriptor: int) -> dict[str, Any]:
    """The plain values that the file holds."""
    values: dict[str, Any] = msgpack.unpackb(_read(descriptor, 0, os.fstat(descriptor).st_size), strict_map_key=False)
    return values


Records = str
"""The path of the file with the firing records, for processes of this user."""
Batches = Mapping[str, list[tuple[int, int]]]
"""Operator → (offset, length) of its batches in the file."""


@contextmanager
def shared_records(log: FiringLog) -> Iterator[tuple[Records, Batches]]:
    """An anonymous file with the firing records of a recording, which workers open: (its path, what is where)."""
    descriptor = os.memfd_create("firing records")
    try:
        batches: dict[str, list[tuple[int, int]]] = {}
        end = 0
        for operator in log.operators:
            for payload in log.batches(operator):
                _write(descriptor, memoryview(payload), end)
                batches.setdefault(operator, []).append((end, len(payload)))
                end += len(payload)
        yield f"/proc/{os.getpid()}/fd/{descriptor}", batches
    finally:
        os.close(descriptor)


def records_of(records: Records, batches: Batches, operators: Collection[str], origin: str) -> FiringLog:
    """The firing records of some operators, out of the file that `shared_records` made. `origin`: the recording."""
    descriptor = os.open(records, os.O_RDONLY | os.O_CLOEXEC)
    try:
        found = {name: [_read(descriptor, at, size) for at, size in batches.get(name, ())] for name in operators}
    finally:
        os.close(descriptor)
    return FiringLog(found, origin)


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
