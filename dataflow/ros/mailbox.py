"""Hands what Zenoh's threads receive over to the thread that reads a source."""

from __future__ import annotations

import threading
import time
from collections import deque
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
    """A queue in the order of arrival. Bounded: the oldest messages go first, and are counted as `overflow`."""

    def __init__(self) -> None:
        self.overflow = 0
        self._waiting: deque[Arrival | TokenChange] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._closed = False

    def sample(self, data: bytes, attachment: bytes) -> None:
        """Takes a message."""
        with self._changed:
            self._waiting.append(Arrival(data, attachment, time.time_ns()))
            self._bytes += len(data)
            while len(self._waiting) > MOST or self._bytes > MOST_BYTES:
                oldest = self._waiting.popleft()
                if isinstance(oldest, Arrival):
                    self._bytes -= len(oldest.data)
                    self.overflow += 1
            self._changed.notify()

    def token(self, token: str, alive: bool) -> None:
        """Takes a change of the graph."""
        with self._changed:
            self._waiting.append(TokenChange(token, alive))
            self._changed.notify()

    def get(self, timeout: float | None) -> Arrival | TokenChange | None:
        """Returns the next of what came; None after `timeout` seconds, and when it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._waiting) or self._closed, timeout)
            if self._closed or not self._waiting:
                return None
            found = self._waiting.popleft()
            if isinstance(found, Arrival):
                self._bytes -= len(found.data)
            return found

    @property
    def closed(self) -> bool:
        """True when nothing more is to be read."""
        return self._closed

    def close(self) -> None:
        """Lets whoever waits return."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
