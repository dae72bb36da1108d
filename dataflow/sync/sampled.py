"""Sampled input: the newest message at or before the firing."""

from __future__ import annotations

from collections.abc import Sequence

from dataflow.sync.entries import DropReason, Entry, InputValue
from dataflow.sync.lanes import Lane
from dataflow.sync.spec import SampledSpec
from dataflow.sync.stamps import FOREVER, NEVER


class Sampled:
    """One Sampled input. Its cut for a firing at t is t - delay; a static stream lies before every cut."""

    def __init__(self, spec: SampledSpec, lanes: Sequence[Lane]) -> None:
        self.name = spec.name
        self.many = spec.many
        self.required = spec.required
        self.stale = False
        """True when the last choice withheld a message as older than `max_age`."""
        self.late = False
        """True when the last choice holds a message that an earlier firing should have had."""
        self._delay = spec.before or 0
        self._max_age = spec.max_age
        self._lanes = tuple(lanes)

    def knows(self, stamp: int) -> bool:
        """Returns whether the value at `stamp` can no longer change."""
        cut = stamp - self._delay
        return all(lane.frontier >= cut for lane in self._lanes)

    def needs(self, stamp: int) -> int | None:
        """The frontier with which the value at `stamp` would be known, or None if it is."""
        lagging = [lane for lane in self._lanes if lane.frontier < stamp - self._delay]
        if not lagging:
            return None
        return FOREVER if any(lane.state.static for lane in lagging) else stamp - self._delay

    def choose(self, stamp: int) -> InputValue:
        """The value at `stamp`; notes in `stale` and `late` how it came about."""
        self.stale = self.late = False
        if not self.many:
            return self._newest(self._lanes[0], stamp)
        found = ((lane.state.name, self._newest(lane, stamp)) for lane in self._lanes)
        return {stream: entry for stream, entry in found if entry is not None}

    def why_absent(self) -> DropReason:
        """The reason for which a required input without a value drops the triggers."""
        return "stale" if self.stale else "no_sample"

    def prune(self, lane: Lane, bound: int) -> None:
        """Forgets what a firing above `bound` cannot choose."""
        if not lane.state.static:
            self._forget_older(lane, bound + 1 - self._delay)

    def _newest(self, lane: Lane, stamp: int) -> Entry | None:
        entries = lane.entries
        if lane.state.static:
            return entries[-1] if entries else None
        cut = stamp - self._delay
        self._forget_older(lane, cut)
        if not entries or entries[0].stamp > cut:
            return None
        entry = entries[0]
        if self._max_age is not None and stamp - entry.stamp > self._max_age:
            self.stale = True
            return None
        if entry.stamp == lane.late and entry.stamp != NEVER:
            self.late = True
        return entry

    @staticmethod
    def _forget_older(lane: Lane, cut: int) -> None:
        """Leaves of the entries at or before `cut` only the newest."""
        entries = lane.entries
        while len(entries) > 1 and entries[1].stamp <= cut:
            entries.popleft()
