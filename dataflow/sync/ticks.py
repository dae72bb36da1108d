"""Ticks: firings on a grid of event time, from where the inputs begin to where they end."""

from __future__ import annotations

from collections.abc import Sequence

from dataflow.sync.lanes import Lane
from dataflow.sync.stamps import FOREVER, NEVER


class Ticks:
    """Grid points k * period from the smallest first to the largest final stamp of the bounding streams. A final stamp
    is never below a frontier promised before it, so one frontier at g proves that a tick at g exists."""

    def __init__(self, period: int, lanes: Sequence[Lane]) -> None:
        self._period = period
        self._lanes = tuple(lanes)
        self._next = NEVER
        self.started = False
        """True when `stamp` is on the grid for certain, False when it is only a lower bound of the first tick."""
        self.latest_start: int | None = None
        """A grid point at or after the first tick; None while no stream has had a message."""
        self.stamp = NEVER
        """The next tick, or a stamp before which there is none; FOREVER once ticks are over."""
        self.confirmed = False
        """True when there is a tick at `stamp`."""
        self.reach = NEVER
        """The farthest that any bounding stream is known to go, which ticks do not exceed."""

    def settle(self, decided: int) -> None:
        """Finds the next tick above `decided`, the last stamp decided."""
        reach, open_ended = NEVER, False
        for lane in self._lanes:
            if (far := lane.reach) > reach:
                reach = far
            open_ended = open_ended or not lane.state.ended
        self.reach = reach
        if not self.started:
            self._find_start()
        if self._next <= decided:
            self._next = (decided // self._period + 1) * self._period
        self.stamp = self._next if open_ended or self._next <= reach else FOREVER
        self.confirmed = self.started and self.stamp <= reach

    def begin_at(self, stamp: int) -> None:
        """Ticks went on before `stamp`; the next is the first grid point from there."""
        self._next = self.stamp = self._grid_from(stamp)
        self.started = True

    def owed(self, last: int) -> tuple[int, int, int]:
        """Of the ticks from the next one, which is confirmed, to `last`: how many, the first and the last."""
        number = (last - self.stamp) // self._period + 1
        return (number, self.stamp, self.stamp + (number - 1) * self._period) if number > 0 else (0, NEVER, NEVER)

    def skip(self, stamp: int) -> range:
        """Leaves out the ticks from the next one, which is confirmed, to `stamp`; they are what it returns."""
        skipped = range(self.stamp, min(stamp, self.reach + 1), self._period)
        self.begin_at(skipped.stop)
        return skipped

    def needs(self) -> dict[str, int]:
        """The frontiers with which `stamp` would be decided to be a tick, or not."""
        if self.confirmed:
            return {}
        return {lane.input: self.stamp for lane in self._lanes if lane.frontier < self.stamp}

    def needs_to_start(self, stamp: int) -> dict[str, int]:
        """The frontiers with which the first tick would be known, as far as `stamp`."""
        return {lane.input: stamp for lane in self._lanes if lane.state.first is None and lane.frontier < stamp}

    def _find_start(self) -> None:
        """The grid point at or after the first stamp of all; a silent stream may begin above its frontier."""
        begin = seen = FOREVER
        for lane in self._lanes:
            if lane.state.first is not None:
                seen = min(seen, lane.state.first)
            elif not lane.state.ended:
                begin = min(begin, lane.frontier + 1)
        begin = min(begin, seen)
        if begin == FOREVER:
            self._next = FOREVER
            return
        self._next = max(NEVER, self._grid_from(begin))
        self.latest_start = self._grid_from(seen) if seen != FOREVER else None
        self.started = seen <= self._next

    def _grid_from(self, stamp: int) -> int:
        return -(-stamp // self._period) * self._period
