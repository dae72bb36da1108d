"""Drives the operators of a process on one thread: the loop of runs, live runs, replays, re-executions, sessions and
tests.

What differs between these lies in the parts: which feeds give messages (`Feeding`), which runners decide the firings
(`Runner`), what takes their output (`Emitter`), and what else the thread has to do between two turns.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Container, Sequence
from operator import attrgetter

from dataflow.execution.failure import OperatorFailure
from dataflow.execution.feeds.feeding import Feeding
from dataflow.execution.protocol import Runner
from dataflow.execution.source import SourceRunner
from dataflow.records.firing import FiringRecord
from dataflow.sync import Entry

_PLACE = attrgetter("place")


class Ready:
    """The runners of one process, in graph order. It asks those that woke, and those whose time has come, alone: an
    operator that is given nothing costs nothing.

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
            asked.sort(key=_PLACE, reverse=self._last_first)
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


Maker = SourceRunner | Runner
"""Drives an operator that emits."""


class Driver:
    """The sources and operators of one process, which of them take a stream, and the feeds. `arrived` returns whether
    something has come in that is to be taken before the feeds give more; `in_order` as for `Ready`."""

    def __init__(
        self, feeding: Feeding | None = None, arrived: Callable[[], bool] = lambda: False, *, in_order: bool = False
    ) -> None:
        self.feeding = feeding or Feeding()
        self._arrived = arrived
        self.sources: list[SourceRunner] = []
        self.operators: list[Runner] = []
        self.ready = Ready(in_order=in_order)
        """Those of the operators that have something to do."""
        self.consumers: dict[str, list[Runner]] = {}

    @property
    def all(self) -> list[Maker]:
        """Everything that emits, sources first."""
        return [*self.sources, *self.operators]

    def __getitem__(self, name: str) -> Maker:
        return next(maker for maker in self.all if maker.node.name == name)

    def add(self, runner: Runner) -> None:
        """Takes an operator in that has inputs."""
        self.operators.append(runner)
        self.ready.add(runner)
        for stream in runner.node.taken:
            self.consumers.setdefault(stream, []).append(runner)

    def taking(self, stream: str) -> Sequence[Runner]:
        """Returns the operators here that take a stream."""
        return self.consumers.get(stream, ())

    def set_up(self) -> None:
        """Sets every operator up, then gives the static streams of recordings. Raises `OperatorFailure`."""
        for maker in self.all:
            maker.setup()
        for log in self.feeding.logs:
            log.setup()

    def turn(self) -> bool:
        """Steps every operator that has something to do; where none has, gives the next step of the feeds. False where
        nothing is left to do before something arrives, or the clock goes on. Raises `OperatorFailure`."""
        if self.ready.step():
            return True
        feeding = self.feeding
        if not feeding.feeds or self._arrived():
            return False
        if feeding.admit():
            return True
        feeding.promise()
        return self.ready.step()

    def close(self, *, but: Container[str] = ()) -> list[OperatorFailure]:
        """Closes every operator but those named, and the recordings; returns what went wrong."""
        failures = []
        for maker in self.all:
            if maker.node.name in but:
                continue
            try:
                maker.close()
            except OperatorFailure as failure:
                failures.append(failure)
            except Exception as error:
                failures.append(OperatorFailure(maker.node.name, "close()", error))
        for log in self.feeding.logs:
            log.close()
        return failures


class LocalEmitter:
    """The emitter that hands what operators emit to those of the same process that take it, and to nothing else."""

    def __init__(self, driver: Driver) -> None:
        self._consumers = driver.consumers

    def message(self, stream: str, entry: Entry) -> None:
        for runner in self._consumers.get(stream, ()):
            runner.push(stream, entry)

    def frontier(self, stream: str, frontier: int) -> None:
        for runner in self._consumers.get(stream, ()):
            runner.advance(stream, frontier)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        for runner in self._consumers.get(stream, ()):
            runner.end(stream, final_stamp, reason)

    def record(self, record: FiringRecord) -> None:
        """Keeps none."""
