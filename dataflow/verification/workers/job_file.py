"""Requests and answers between a process and its workers: plain values, in anonymous files.

A writer does not wait for a reader here, as with a socket: a worker that hangs delays no other process.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgpack


def write_job_file(descriptor: int, values: Mapping[str, Any]) -> None:
    """Puts plain values in place of what the file holds."""
    with open(descriptor, "r+b", closefd=False) as file:
        file.seek(0)
        file.truncate()
        msgpack.pack(values, file, use_bin_type=True)


def read_job_file(descriptor: int) -> dict[str, Any]:
    """The plain values that the file holds."""
    with open(descriptor, "rb", closefd=False) as file:
        file.seek(0)
        values: dict[str, Any] = msgpack.unpack(file, strict_map_key=False)
    return values
