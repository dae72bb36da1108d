"""Feeds: what puts messages into a graph. A window keeps them from running ahead of what the graph has done."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from dataflow.sync import FOREVER


class Feed(Protocol):
    """A source, or a log that stands in for sources: read one stamp at a time, in stamp order."""

    firings: int
    ended: bool
    last: int
    """The stamp of the step that was given last; `NEVER` before the first."""

    def look_ahead(self) -> int | None:
        """The stamp of the next step, None at the end."""

    def admit(self) -> tuple[int, int]:
        """Emits the next step; returns how many messages and bytes it was."""

    def promise(self) -> None:
        """Sends the frontiers that are due on streams which had no message of late."""

    def finish(self, reason: str) -> None:
        """Ends all streams of the feed."""


class Window:
    """Messages and bytes that a feed has admitted and the graph has not yet done with."""

    def __init__(self, messages: int, nbytes: int) -> None:
        self.messages, self.nbytes = messages, nbytes
        self._outstanding: deque[tuple[int, int, int]] = deque()
        self._open = False
        self.count = self.size = 0
        self.full = False

    def add(self, stamp: int, messages: int, nbytes: int) -> None:
        if self._open:
            return
        self._outstanding.append((stamp, messages, nbytes))
        self.count += messages
        self.size += nbytes
        self.full = self.count >= self.messages or self.size >= self.nbytes

    def cover(self, frontier: int) -> None:
        """Everything with a stamp ≤ `frontier` is done by every operator; with `FOREVER` there is none to wait for."""
        self._open = frontier == FOREVER
        while self._outstanding and self._outstanding[0][0] <= frontier:
            _, messages, nbytes = self._outstanding.popleft()
            self.count -= messages
            self.size -= nbytes
        self._look()

    def _look(self) -> None:
        self.full = bool(self._outstanding) and (self.count >= self.messages or self.size >= self.nbytes)

    def clear(self) -> None:
        """Forgets what is outstanding: the stamps to come are earlier."""
        self._outstanding.clear()
        self.count = self.size = 0
        self.full = False

    def grow(self) -> None:
        """Doubles the window: for graphs that must look further ahead than it allows."""
        self.messages *= 2
        self.nbytes *= 2
        self._look()


class TransferCounters:
    """Messages and bytes that one thread has put and another has not taken yet; every number has one writer."""

    def __init__(self) -> None:
        self._put = [0, 0]
        self._taken = [0, 0]

    @property
    def count(self) -> int:
        return self._put[0] - self._taken[0]

    @property
    def size(self) -> int:
        return self._put[1] - self._taken[1]

    def put(self, messages: int, nbytes: int) -> None:
        self._put[0] += messages
        self._put[1] += nbytes

    def take(self, messages: int, nbytes: int) -> None:
        self._taken[0] += messages
        self._taken[1] += nbytes
