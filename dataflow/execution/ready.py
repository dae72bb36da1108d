"""Keeps the operators of a process that have something to do: those that woke, and those whose time has come.

A process asks no others, so that an operator which is given nothing costs nothing, however many there are.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable

from dataflow.execution.protocol import Runner


class Ready:
    """The runners of one process, in graph order.

    The last of the graph are asked first, so that what is under way is done before more is begun; with `in_order`, the
    first ones.
    """

    def __init__(self, clock: Callable[[], float] | None = None, *, in_order: bool = False) -> None:
        self._clock, self._last_first = clock or time.monotonic, not in_order
        self.woken: list[Runner] = []
        """Those that are to be asked next."""
        self._runners: list[Runner] = []
        self._due: dict[int, float] = {}
        """When a runner is to be asked again though it was given nothing, by its place."""
        self._soonest: list[tuple[float, int]] = []
        """The same as a heap; what `_due` does not confirm is outdated."""

    def add(self, runner: Runner) -> None:
        """Takes a runner in; it is asked at once."""
        runner.place = len(self._runners)
        self._runners.append(runner)
        runner.wakes_in, runner.awake = self.woken, False
        runner.wake()

    def wake_all(self) -> None:
        """Has every runner asked."""
        for runner in self._runners:
            runner.wake()

    def step(self) -> bool:
        """Makes one step of every runner that has something to do. False when there was nothing to do, and nothing has
        come of asking."""
        if self._soonest:
            self._wake_due()
        if not self.woken:
            return False
        asked = self.woken.copy()
        self.woken.clear()
        if len(asked) > 1:
            asked.sort(key=_place, reverse=self._last_first)
        worked = False
        for runner in asked:
            runner.awake = False
            if runner.step():
                worked = True
            elif runner.keeps_time:
                self._note(runner)
        return worked or bool(self.woken)  # a promise alone may decide something further down

    def next_due(self) -> float | None:
        """Seconds until a runner is to be asked though nothing arrives; None when none is."""
        while self._soonest:
            when, place = self._soonest[0]
            if self._due.get(place) == when:
                return max(0.0, when - self._clock())
            heapq.heappop(self._soonest)
        return None

    def _note(self, runner: Runner) -> None:
        seconds = runner.next_due()
        if seconds is None:
            self._due.pop(runner.place, None)
            return
        when = self._clock() + seconds
        self._due[runner.place] = when
        heapq.heappush(self._soonest, (when, runner.place))

    def _wake_due(self) -> None:
        now = self._clock()
        while self._soonest and self._soonest[0][0] <= now:
            when, place = heapq.heappop(self._soonest)
            if self._due.get(place) == when:
                del self._due[place]
                self._runners[place].wake()


def _place(runner: Runner) -> int:
    return runner.place
