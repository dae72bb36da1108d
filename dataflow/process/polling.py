"""Waits for descriptors, of any number, where select(2) accepts those below 1,024 only, and reads from sockets."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterable
from typing import Protocol, TypeVar


class HasDescriptor(Protocol):
    def fileno(self) -> int: ...


Waited = TypeVar("Waited", bound=int | HasDescriptor)


def received(connection: socket.socket, nbytes: int, descriptors: int) -> tuple[bytes, list[int]]:
    """Returns what is read from a Unix socket, and the descriptors with it; nothing where the other end is gone. One
    that closes it, or is killed, with unread data in it resets it. Raises `OSError`."""
    try:
        data, given, _, _ = socket.recv_fds(connection, nbytes, descriptors)
    except ConnectionResetError:
        return b"", []
    return data, list(given)


def readable(waited: Iterable[Waited], timeout: float | None) -> list[Waited]:
    """Returns those that have something to read, or have ended, after at most `timeout` seconds (None: no limit)."""
    by_descriptor = {each if isinstance(each, int) else each.fileno(): each for each in waited}
    poll = select.poll()
    for descriptor in by_descriptor:
        poll.register(descriptor, select.POLLIN)
    found = poll.poll(None if timeout is None else max(0.0, timeout) * 1000)
    return [by_descriptor[descriptor] for descriptor, _ in found]
