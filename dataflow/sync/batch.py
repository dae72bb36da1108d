"""Batch input: every message since the last firing."""

from __future__ import annotations

from collections.abc import Sequence

from dataflow.sync.entries import Entry
from dataflow.sync.lanes import DropEntry, Lane
from dataflow.sync.spec import BatchSpec


class Batch:
    """One Batch input. What a forced decision left behind goes into the next batch: runs have no holes."""

    def __init__(self, spec: BatchSpec, lanes: Sequence[Lane], drop: DropEntry) -> None:
        self.name = spec.name
        self.late = False
        """True when the last batch holds a message that an earlier firing should have had."""
        self._max = spec.max
        self._max_age = spec.max_age
        self._lanes = tuple(lanes)
        self._drop = drop

    def knows(self, stamp: int) -> bool:
        """Returns whether the batch up to `stamp` is complete."""
        return all(lane.frontier >= stamp for lane in self._lanes)

    def needs(self, stamp: int) -> int | None:
        """The frontier with which the batch up to `stamp` would be complete, or None if it is."""
        lagging = [lane for lane in self._lanes if lane.frontier < stamp]
        if not lagging:
            return None
        return stamp

    def take(self, stamp: int, last_firing: int) -> tuple[Entry, ...]:
        """The messages up to `stamp` that no firing has had, within the bounds."""
        self._cut(stamp, stamp)
        taken: list[tuple[int, str, Entry]] = []
        for lane in self._lanes:
            entries, stream = lane.entries, lane.state.name
            while entries and entries[0].stamp <= stamp:
                entry = entries.popleft()
                taken.append((entry.stamp, stream, entry))
        if len(self._lanes) > 1:
            taken.sort(key=lambda item: item[:2])
        self.late = bool(taken) and taken[0][0] <= last_firing
        return tuple(entry for _, _, entry in taken)

    def prune(self, bound: int) -> None:
        """Drops what a firing above `bound` would cut off."""
        self._cut(bound + 1, bound + 1)

    def drop_rest(self) -> None:
        """Drops what came after the last firing."""
        for lane in self._lanes:
            while lane.entries:
                self._drop(lane, lane.entries.popleft(), "unused", "")

    def _cut(self, upto: int, now: int) -> None:
        """Drops what is older than `max_age` at `stamp`, and of the messages up to it all but `max`."""
        if self._max_age is not None:
            for lane in self._lanes:
                while lane.entries and now - lane.entries[0].stamp > self._max_age:
                    self._drop(lane, lane.entries.popleft(), "unused", "")
        if self._max is None:
            return
        if len(self._lanes) == 1:
            entries = self._lanes[0].entries
            while len(entries) > self._max and entries[self._max].stamp <= upto:
                self._drop(self._lanes[0], entries.popleft(), "unused", "")
            return
        held = [
            (entry.stamp, lane.state.name, lane)
            for lane in self._lanes
            for entry in lane.entries
            if entry.stamp <= upto
        ]
        held.sort(key=lambda item: item[:2])
        for _, _, lane in held[: max(0, len(held) - self._max)]:
            self._drop(lane, lane.entries.popleft(), "unused", "")
