"""Messages that the aligner dropped: counted, and the last ones one by one."""

from __future__ import annotations

from collections import Counter, deque

from dataflow.sync.entries import TICK, Drop, DropReason, Entry
from dataflow.sync.lanes import Lane

KEPT = 4096
"""Drops that are kept one by one until they are taken. Of more, the oldest are only counted: an operator that
never fires must not fill the memory with what it has not used."""


class DropLog:
    """Counts drops by input and reason, and keeps the last `KEPT` of them until they are taken."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self.late: Counter[str] = Counter()
        """Messages that came after what needed them was decided, by input, dropped or not."""
        self.pending: deque[Drop] = deque()
        """The last drops that were not taken."""
        self._unlisted: Counter[tuple[str, str]] = Counter()

    def entry(self, lane: Lane, entry: Entry, reason: DropReason, because: str = "") -> None:
        """Notes that a message is dropped on its way into one input."""
        if reason == "late":
            self.came_late(lane)
        self.add(Drop(lane.input, lane.state.name, entry.stamp, entry.seq, entry.incarnation, reason, because))

    def tick(self, stamp: int, reason: DropReason, because: str) -> None:
        """Notes that a tick is dropped."""
        self.add(Drop(TICK, "", stamp, 0, 0, reason, because))

    def ticks(self, stamps: range, reason: DropReason) -> None:
        """Notes that ticks are dropped, however many they are."""
        number = -((stamps.start - stamps.stop) // stamps.step) if stamps else 0
        unlisted = max(0, number - KEPT)
        if unlisted:
            self.counts[TICK, reason] += unlisted
            self._unlisted[TICK, reason] += unlisted
        for stamp in range(stamps.start + unlisted * stamps.step, stamps.stop, stamps.step):
            self.tick(stamp, reason, "")

    def came_late(self, lane: Lane) -> None:
        """Notes that a message came after what needed it was decided."""
        self.late[lane.input] += 1

    def add(self, drop: Drop) -> None:
        """Notes one drop."""
        self.counts[drop.input, drop.reason] += 1
        self.pending.append(drop)
        if len(self.pending) > KEPT:
            oldest = self.pending.popleft()
            self._unlisted[oldest.input, oldest.reason] += 1

    def take(self) -> list[Drop]:
        """The drops since this was last asked, but for those that were too many."""
        events = list(self.pending)
        self.pending.clear()
        return events

    def take_unlisted(self) -> dict[tuple[str, str], int]:
        """Returns how many drops since this was last asked were too many to be kept, by (input, reason)."""
        unlisted = dict(self._unlisted)
        self._unlisted.clear()
        return unlisted
