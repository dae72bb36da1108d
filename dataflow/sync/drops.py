"""What the aligner dropped, counted and one by one."""

from __future__ import annotations

from dataflow.sync.entries import TICK, Drop, DropReason, Entry
from dataflow.sync.lanes import Lane


class DropLog:
    """Counts drops by input and reason, and keeps each until it is taken."""

    def __init__(self) -> None:
        self.counts: dict[tuple[str, str], int] = {}
        self._events: list[Drop] = []

    def entry(self, lane: Lane, entry: Entry, reason: DropReason, because: str = "") -> None:
        """A message is dropped on its way into one input."""
        self._add(Drop(lane.input, lane.state.name, entry.stamp, entry.seq, entry.incarnation, reason, because))

    def tick(self, stamp: int, reason: DropReason, because: str) -> None:
        """A tick is dropped."""
        self._add(Drop(TICK, "", stamp, 0, 0, reason, because))

    def take(self) -> list[Drop]:
        """The drops since this was last asked."""
        events, self._events = self._events, []
        return events

    def _add(self, drop: Drop) -> None:
        key = (drop.input, drop.reason)
        self.counts[key] = self.counts.get(key, 0) + 1
        self._events.append(drop)
