"""Merge: every trigger message fires, those of one stamp together. One trigger is the simplest merge."""

from __future__ import annotations

from collections.abc import Sequence

from dataflow.sync.entries import DropReason, Entry, InputValue
from dataflow.sync.lanes import DropEntry, Lane
from dataflow.sync.spec import TriggerSpec
from dataflow.sync.stamps import FOREVER, NEVER


class Merge:
    """The next stamp is the smallest at the head of a lane, decided once every frontier has reached it."""

    def __init__(self, triggers: Sequence[TriggerSpec], lanes: Sequence[Lane], drop: DropEntry) -> None:
        self._lanes = tuple(lanes)
        self._only = lanes[0] if len(lanes) == 1 else None
        self._many = frozenset(trigger.name for trigger in triggers if trigger.many)
        self._names = tuple(trigger.name for trigger in triggers)
        self._drop = drop
        self.stamp: int | None = None
        """The first undecided trigger stamp, or None."""
        self.ready = False
        """True when all that belongs to `stamp` is known."""
        self.bound = NEVER
        """The minimum of the trigger frontiers: no message is still to come at or below it."""
        self.decided = NEVER
        """The last trigger stamp decided."""

    def settle(self) -> None:
        lane = self._only
        if lane is not None:
            self.bound = lane.frontier
            self.stamp = lane.entries[0].stamp if lane.entries else None
            self.ready = self.stamp is not None and self.stamp <= self.bound
            return
        stamp = bound = FOREVER
        for lane in self._lanes:
            if lane.entries and (head := lane.entries[0].stamp) < stamp:
                stamp = head
            if lane.frontier < bound:
                bound = lane.frontier
        self.stamp = stamp if stamp != FOREVER else None
        self.ready = stamp <= bound and stamp != FOREVER
        self.bound = bound

    def take(self) -> dict[str, InputValue]:
        """The values of the triggers at `stamp`, which is thereby decided."""
        lane = self._only
        if lane is not None:
            entry = lane.entries.popleft()
            self.decided = entry.stamp
            return {lane.input: {lane.state.name: entry} if self._many else entry}
        values = self.absent()
        for lane, entry in self._pop():
            present = values[lane.input]
            if isinstance(present, dict):
                present[lane.state.name] = entry
            else:
                values[lane.input] = entry
        return values

    def reject(self, reason: DropReason, because: str) -> None:
        """Decides `stamp` without a firing."""
        for lane, entry in self._pop():
            self._drop(lane, entry, reason, because)

    def absent(self) -> dict[str, InputValue]:
        """The values of the triggers where none has a message."""
        return {name: {} if name in self._many else None for name in self._names}

    def needs(self) -> dict[str, int]:
        """The frontier each lagging trigger must reach for `stamp` to be decided."""
        if self.stamp is None:
            return {}
        return {lane.input: self.stamp for lane in self._lanes if lane.frontier < self.stamp}

    def oldest_wait(self) -> tuple[int, dict[str, int]] | None:
        """A merge never holds a message that is not itself a candidate."""
        return None

    def _pop(self) -> list[tuple[Lane, Entry]]:
        stamp = self.stamp
        assert stamp is not None
        popped = [
            (lane, lane.entries.popleft()) for lane in self._lanes if lane.entries and lane.entries[0].stamp == stamp
        ]
        self.decided = stamp
        return popped
