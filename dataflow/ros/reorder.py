"""Puts the messages of several publishers of a topic in the order of their stamps, within a short wait. Pure."""

from __future__ import annotations

import heapq
from collections import deque
from itertools import count

from dataflow.interop.clocks import BACK, STAYS
from dataflow.interop.transform_sets import joined
from dataflow.messages import Message, Transforms
from dataflow.ros.losses import remember

Rank = tuple[int, int]
"""(how often a clock has gone back, stamp)"""


class Reorder:
    """Holds each message for `wait` seconds. Transforms of one stamp become one message.

    A message whose stamp is below that of the last one given is `late`, unless a clock was set: its publisher went back
    itself, or is new and behind by more than 5 s, or as far behind is the tenth late one in a row, in order: the last
    one was of a wrong clock. `behind`: how far (ns) a late one was behind at most; `repeated`: counts messages of one
    stamp that cannot be joined, after the first.
    """

    def __init__(self, wait: float) -> None:
        self._wait = wait
        self.late = self.behind = self.repeated = 0
        self._behind: list[int] = []
        """Stamps of the late ones in a row."""
        self._held: list[tuple[Rank, int, Message]] = []
        self._due: deque[tuple[float, Rank]] = deque()
        self._numbers = count()
        self._stamps: dict[bytes, int] = {}
        self._jumps = 0
        self._last: Rank = (0, -1)
        self._until: Rank = (0, -1)

    def put(self, message: Message, publisher: bytes, now: float) -> None:
        """Takes a message at a time (seconds, of a clock that never goes back)."""
        stamp = message.stamp
        before = self._stamps.get(publisher, self._last[1] - BACK)
        remember(self._stamps, publisher, stamp)
        if stamp < before or self._stay_behind(stamp):
            self._jumps += 1
        rank = (self._jumps, stamp)
        if rank == self._last and not isinstance(message, Transforms):
            self.repeated += 1
            return
        if rank <= self._last:
            self.late += 1
            self.behind = max(self.behind, self._last[1] - stamp)
            return
        heapq.heappush(self._held, (rank, next(self._numbers), message))
        self._due.append((now + self._wait, rank))

    def _stay_behind(self, stamp: int) -> bool:
        """Takes note of a stamp; True where so many in a row are late that the one before them was wrong."""
        if stamp >= self._last[1] - BACK or self._jumps != self._last[0]:
            self._behind.clear()
            return False
        if self._behind and stamp <= self._behind[-1]:
            self._behind.clear()
        self._behind.append(stamp)
        return len(self._behind) >= STAYS

    def take(self, now: float) -> Message | None:
        """Returns the next message that has waited long enough."""
        while self._due and self._due[0][0] <= now:
            self._until = max(self._until, self._due.popleft()[1])
        if not self._held or self._held[0][0] > self._until:
            return None
        rank, _, message = heapq.heappop(self._held)
        while self._held and self._held[0][0] == rank:
            other = heapq.heappop(self._held)[2]
            if isinstance(message, Transforms) and isinstance(other, Transforms):
                message = joined(message, other)
            else:
                self.repeated += 1
        self._last = rank
        return message

    def due_in(self, now: float) -> float | None:
        """Returns after how many seconds the next message may be given; None where none is held."""
        if self._held and self._held[0][0] <= self._until:
            return 0.0
        return max(0.0, self._due[0][0] - now) if self._due else None
