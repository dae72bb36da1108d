"""The control channel between the supervisor and one process: small msgpack messages over a socket pair.

It is a pipe rather than a Zenoh key because its end is the news: when either process dies, however it dies, the other
one reads end-of-file at once.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterable
from multiprocessing import connection
from typing import Any

import msgpack


class ChannelClosed(ConnectionError):
    """The process at the other end is gone, or has closed its end."""


class Channel:
    """One end of the control channel. Sending is thread-safe; one thread receives."""

    def __init__(self, descriptor: int) -> None:
        self._connection = connection.Connection(descriptor)
        self._sending = threading.Lock()

    @staticmethod
    def pair() -> tuple[Channel, int]:
        """A channel for this process, and the descriptor of the other end, to be inherited by a child process."""
        ours, theirs = socket.socketpair()
        theirs.set_inheritable(True)
        return Channel(ours.detach()), theirs.detach()

    def send(self, kind: str, /, **fields: Any) -> None:
        """Raises `ChannelClosed` when the other end is gone."""
        data = msgpack.packb([kind, fields], use_bin_type=True)
        try:
            with self._sending:
                self._connection.send_bytes(data)
        except (OSError, ValueError) as error:
            raise ChannelClosed(str(error)) from error

    def receive(self) -> tuple[str, dict[str, Any]]:
        """The next message; waits until there is one. Raises `ChannelClosed` at the end."""
        try:
            kind, fields = msgpack.unpackb(self._connection.recv_bytes(), raw=False, strict_map_key=False)
        except (EOFError, OSError, ValueError) as error:
            raise ChannelClosed(str(error)) from error
        return kind, fields

    def close(self) -> None:
        self._connection.close()

    def fileno(self) -> int:
        return self._connection.fileno()


def ready(channels: Iterable[Channel], timeout: float) -> list[Channel]:
    """Those channels from which `receive` will not wait."""
    by_connection = {c._connection: c for c in channels}
    return [by_connection[c] for c in connection.wait(list(by_connection), timeout)]  # type: ignore[index]
