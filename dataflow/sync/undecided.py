"""The first stamp that an aligner has not decided, and what is needed to decide it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dataflow.sync.join import Join
from dataflow.sync.lanes import Lane
from dataflow.sync.merge import Merge
from dataflow.sync.stamps import FOREVER, NEVER
from dataflow.sync.ticks import Ticks


class Undecided:
    """Finds the first undecided stamp among those of triggers and of ticks. `stamp` to `ready` hold after `settle()`.
    Code that changes a lane of a trigger or a bounding stream, or decides, sets `settled` to False."""

    __slots__ = ("_lanes", "_ticks", "_triggers", "decided", "ready", "settled", "stamp", "ticked", "triggered")

    def __init__(self, triggers: Join | Merge, ticks: Ticks | None, lanes: Sequence[Lane]) -> None:
        self._triggers, self._ticks = triggers, ticks
        self._lanes = tuple(lanes)  # of the triggers
        self.stamp: int | None = None
        """The first undecided stamp, of a trigger or a tick."""
        self.triggered = False
        """True when a trigger candidate lies there."""
        self.ticked = False
        """True when a tick lies there."""
        self.ready = False
        """True when that is all known."""
        self.settled = False
        """True when nothing has changed since that was found."""
        self.decided = NEVER
        """Everything at or below is decided, or has been promised downstream."""

    def begin_at(self, stamp: int) -> None:
        """Everything before `stamp` was decided elsewhere, ticks included."""
        self.decided = stamp - 1
        self.settled = False
        if self._ticks is not None:
            self._ticks.begin_at(stamp)

    def settle(self) -> None:
        """Finds the first undecided stamp, and whether triggers and ticks there are known."""
        if self.settled:
            return
        triggers = self._triggers
        triggers.settle()
        candidate = triggers.stamp
        ticks = self._ticks
        if ticks is None:  # else what is known of ticks depends on what is decided, too
            self.settled = True
            self.stamp, self.triggered, self.ready = candidate, candidate is not None, triggers.ready
            return
        ticks.settle(self.decided)
        tick = ticks.stamp
        if candidate is not None and candidate <= tick:
            self.stamp, self.triggered, self.ticked = candidate, True, candidate == tick
            self.ready = triggers.ready and (candidate < tick or ticks.confirmed)
        else:
            self.stamp, self.triggered, self.ticked = (tick if tick != FOREVER else None), False, True
            self.ready = ticks.confirmed and triggers.bound >= tick

    def exhausted(self) -> bool:
        """Returns whether neither trigger nor tick is left."""
        over = self.stamp is None and self._triggers.bound == FOREVER
        return over and (self._ticks is None or self._ticks.stamp == FOREVER)

    def frontier(self) -> int:
        """No firing that is still to come, while any may, has a stamp at or below this."""
        frontier = self._triggers.bound
        if self.stamp is not None and self.stamp <= frontier:
            frontier = self.stamp - 1
        if self._ticks is not None:
            frontier = min(frontier, self._ticks.stamp - 1, self._ticks.reach)
        return frontier

    def first_possible(self) -> int | None:
        """The first undecided stamp, or, while ticks have no known start, the first that may be one."""
        ticks = self._ticks
        if ticks is None or ticks.started:
            return self.stamp
        return min((s for s in (self._triggers.stamp, ticks.latest_start) if s is not None), default=None)

    def needs(self, stamp: int) -> dict[str, int]:
        """The frontier that each trigger, and each input that bounds ticks, must reach to decide `first_possible()`."""
        needs: dict[str, int] = {}
        if self._triggers.stamp == stamp:
            needs.update(self._triggers.needs())
        elif self._triggers.bound < stamp:
            needs.update({lane.input: stamp for lane in self._lanes if lane.frontier < stamp})
        for name, frontier in self._ticks_need(stamp).items():
            needs[name] = max(frontier, needs.get(name, NEVER))
        return needs

    def owed_ticks(self, context: Iterable[Lane]) -> tuple[int, int, int]:
        """The ticks that are due, with nothing between them, as far as the lanes of `context` go: how many, the first
        and the last."""
        ticks = self._ticks
        if ticks is None:
            return 0, NEVER, NEVER
        self.settle()
        if not ticks.confirmed:
            return 0, NEVER, NEVER
        last = min(ticks.reach, self._triggers.bound, *(lane.frontier + lane.delay for lane in context))
        if self._triggers.stamp is not None:
            last = min(last, self._triggers.stamp)
        return ticks.owed(last)

    def skip_ticks(self, stamp: int) -> range:
        """Leaves out the ticks before `stamp`, which are what it returns."""
        ticks = self._ticks
        if ticks is None:
            return range(0)
        self.settle()
        return ticks.skip(stamp) if ticks.confirmed and ticks.stamp < stamp else range(0)

    def _ticks_need(self, stamp: int) -> dict[str, int]:
        if self._ticks is None:
            return {}
        if not self._ticks.started:
            return self._ticks.needs_to_start(stamp)
        return self._ticks.needs() if self._ticks.stamp == stamp else {}
