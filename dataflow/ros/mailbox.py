"""Hands what Zenoh's threads receive over to the thread that reads a source."""

from __future__ import annotations

import queue
import threading
import time
from typing import Final, NamedTuple

from dataflow.ros.losses import Losses
from dataflow.ros.wire import Attachment, WireError

MOST: Final = 4096
MOST_BYTES: Final = 256 << 20


class Arrival(NamedTuple):
    """A message as it came.

    `seen`: its attachment, None where it had none; `missing`: messages lost directly before it; `lost`: those of the
    topic so far; `clock`: the time of /clock then; `time`: of its arrival, ns since the epoch.
    """

    data: bytes
    seen: Attachment | None
    missing: int
    lost: int
    clock: int
    time: int

    @property
    def gid(self) -> bytes:
        """The publisher; empty where it is unknown."""
        return b"" if self.seen is None else self.seen.gid


class TokenChange(NamedTuple):
    """A publisher's liveliness token that has appeared or gone."""

    token: str
    alive: bool


class Mailbox:
    """A queue in the order of arrival, bounded: messages for which there is no room are counted as `overflow`, changes
    of tokens as `unnamed`. `losses` counts a message before that, since it came. `clock`: the time of /clock, ns."""

    def __init__(self) -> None:
        self.losses = Losses()
        self.overflow = self.unnamed = self.clock = 0
        self.closed = False
        self._waiting: queue.SimpleQueue[Arrival | TokenChange | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._messages = self._bytes = self._tokens = 0
        """Amounts that wait."""

    def sample(self, data: bytes, attachment: bytes) -> None:
        """Takes a message."""
        seen = _seen(attachment)
        with self._lock:
            missing = 0 if seen is None else self.losses.take(seen)
            if self._messages >= MOST or self._bytes + len(data) > MOST_BYTES:
                self.overflow += 1
                return
            self._messages += 1
            self._bytes += len(data)
            self._waiting.put(Arrival(data, seen, missing, self.losses.lost, self.clock, time.time_ns()))

    def token(self, token: str, alive: bool) -> None:
        """Takes a change of the graph."""
        with self._lock:
            if self._tokens >= MOST:
                self.unnamed += 1
                return
            self._tokens += 1
            self._waiting.put(TokenChange(token, alive))

    def get(self, timeout: float | None) -> Arrival | TokenChange | None:
        """Returns the next of what came; None after `timeout` seconds, and when it is closed."""
        try:
            found = None if self.closed else self._waiting.get(timeout=timeout)
        except queue.Empty:
            return None
        with self._lock:
            if isinstance(found, Arrival):
                self._messages -= 1
                self._bytes -= len(found.data)
            elif found is not None:
                self._tokens -= 1
        return found

    def close(self) -> None:
        """Lets the reader return."""
        self.closed = True
        self._waiting.put(None)


def _seen(attachment: bytes) -> Attachment | None:
    try:
        return Attachment.decoded(attachment)
    except WireError:
        return None
