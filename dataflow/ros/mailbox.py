"""Hands what Zenoh's threads receive over to the thread that reads a source."""

from __future__ import annotations

import queue
import time
from typing import Final, NamedTuple

MOST: Final = 4096
MOST_BYTES: Final = 256 << 20


class Arrival(NamedTuple):
    """A message as it came. `time`: of its arrival, ns since the epoch; `attachment` is empty where it had none."""

    data: bytes
    attachment: bytes
    time: int


class TokenChange(NamedTuple):
    """A publisher's liveliness token that has appeared or gone."""

    token: str
    alive: bool


class Mailbox:
    """A queue in the order of arrival. Bounded: a message for which there is no room is counted as `overflow`."""

    def __init__(self) -> None:
        self.overflow = 0
        self.closed = False
        self._waiting: queue.SimpleQueue[Arrival | TokenChange | None] = queue.SimpleQueue()
        self._put = self._taken = 0
        """Bytes, each counted by one thread."""

    def sample(self, data: bytes, attachment: bytes) -> None:
        """Takes a message."""
        if self._waiting.qsize() >= MOST or self._put - self._taken + len(data) > MOST_BYTES:
            self.overflow += 1
            return
        self._put += len(data)
        self._waiting.put(Arrival(data, attachment, time.time_ns()))

    def token(self, token: str, alive: bool) -> None:
        """Takes a change of the graph."""
        self._waiting.put(TokenChange(token, alive))

    def get(self, timeout: float | None) -> Arrival | TokenChange | None:
        """Returns the next of what came; None after `timeout` seconds, and when it is closed."""
        try:
            found = None if self.closed else self._waiting.get(timeout=timeout)
        except queue.Empty:
            return None
        if isinstance(found, Arrival):
            self._taken += len(found.data)
        return found

    def close(self) -> None:
        """Lets the reader return."""
        self.closed = True
        self._waiting.put(None)
