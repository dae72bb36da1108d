"""Reports to the supervisor how far the operators of a process are, and at the end what came of them."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from dataflow.execution.calls import summary_of
from dataflow.execution.driver import Driver
from dataflow.execution.feeds.log import LogFeed
from dataflow.execution.protocol import Runner
from dataflow.execution.source import SourceRunner
from dataflow.process.channel import Channel
from dataflow.process.live_sources import LiveSources
from dataflow.sync import MISSES

REPORT_EVERY = 0.02
REPORT_IDLE = 0.01
"""Seconds between two reports of a process that has nothing more to do: others may be waiting for this one."""
REPORT_LIVE = 0.05
"""The same in a live run, where sources do not wait: every report wakes the supervisor, and that the sources."""
COUNT_EVERY = 0.05
"""Seconds between two counts of what operators have done, while there is more to do. Flow control needs none."""


class Progress:
    """Reports what has changed: not too often, and as soon as there is nothing else to do."""

    def __init__(
        self,
        channel: Channel,
        driver: Driver,
        live: LiveSources,
        clock: Callable[[], float] | None = None,
        *,
        paced: bool = False,
    ) -> None:
        """`paced`: the run is live."""
        self._every, self._idle = (REPORT_LIVE, REPORT_LIVE) if paced else (REPORT_EVERY, REPORT_IDLE)
        self._channel, self._driver, self._live = channel, driver, live
        self._clock = clock or time.monotonic
        self.counted: dict[str, list[int]] = {}
        """The counts that were last reported, of all operators."""
        self.waited: dict[str, list[list[Any]]] = {}
        """The waits that were last reported."""
        self.behind: dict[str, list[float]] = {}
        """By how much sources were last reported to be behind the clock (s): when read, and when sent."""
        self.found: dict[str, str] = {}
        """The findings of operators when their counts were last reported."""
        self._fired_at: dict[str, float] = {}
        self._dropped: dict[str, list[list[Any]]] = {}
        self._counted: dict[str, tuple[int, int]] = {}
        self._count_due = -COUNT_EVERY
        self._uncounted = False
        self._done: dict[str, int] = {}
        self._firings = 0
        self._reported = -REPORT_EVERY
        self._owed = False

    def report(self, *, idle: bool, at_once: bool = False) -> None:
        """Sends what has changed, if it is time to, or `at_once`."""
        now = self._clock()
        if not at_once and now < self._reported + (self._idle if idle else self._every):
            self._owed = self._owed or idle
            return
        self._owed = False
        done = {r.node.name: r.done for r in self._driver.operators if self._done.get(r.node.name) != r.done}
        firings = self._made()
        counts_due = idle or now >= self._count_due
        if not done and firings == self._firings and not (self._uncounted and counts_due):
            return
        self._reported = now
        self._done.update(done)
        self._firings = firings
        changed: list[Runner] = []
        self._uncounted = not counts_due
        if counts_due:
            self._count_due = now + COUNT_EVERY
            for runner in self._driver.operators:
                reached = runner.firings, runner.done
                if self._counted.get(runner.node.name) != reached:
                    self._counted[runner.node.name] = reached
                    changed.append(runner)
        counts = counts_of(self._driver, changed)
        self._fired_at |= {n: now for n, row in counts.items() if row[0] != self.counted.get(n, (0,))[0]}
        self.counted |= counts
        dropped = _drops_of(self._driver, changed)
        drops = {name: found for name, found in dropped.items() if found != self._dropped.get(name)}
        self._dropped |= drops
        waits = {name: found for name, found in _waits_of(changed).items() if found != self.waited.get(name)}
        self.waited |= waits
        fired: list[SourceRunner | Runner] = [*self._driver.sources, *changed]
        for each in fired:
            self._find(each.node.name, each.operator.finding())
        self.behind = self._live.behind()
        news = {"done": done, "counts": counts, "drops": drops, "waits": waits, "behind": self.behind}
        self._channel.send("progress", **news, first=_first(self._driver))

    def _find(self, operator: str, text: str) -> None:
        """Keeps an operator's finding, and logs it where there was none: viewers show the log."""
        if text and not self.found.get(operator):
            logging.getLogger(__name__).warning(text, extra={"operator": operator})
        self.found[operator] = text

    def silences(self) -> dict[str, float]:
        """Returns the seconds since operators last fired, as far as was reported, or began their first call; on any
        thread."""
        now = self._clock()
        at_first = {r.node.name: since for r in self._driver.operators if (since := r.working_since) is not None}
        return {name: max(0.0, now - since) for name, since in (at_first | self._fired_at.copy()).items()}

    def next_due(self) -> float | None:
        """Seconds until what has changed is to be reported; None when nothing has."""
        return max(0.0, self._reported + self._idle - self._clock()) if self._owed else None

    def _made(self) -> int:
        return sum(maker.firings for maker in (*self._driver.all, *self._driver.feeding.logs))

    def waiting(self) -> dict[str, list[Any]]:
        """Per operator that is not done: the stamp it cannot decide, and the inputs (with frontiers) that hold it."""
        return {r.node.name: list(r.waiting()) for r in self._driver.operators if not r.ended}


def counts_of(driver: Driver, operators: Iterable[Runner]) -> dict[str, list[int]]:
    """Returns for all sources and some operators: firings, messages emitted, messages dropped, CPU time (ns), last
    stamp, wall time (ns); for recordings under "@log"."""
    counts = {}
    for source in driver.sources:
        counts[source.node.name] = _row(source, source.ports.emitted, source.refused.total(), source.last)
    for runner in operators:
        drops = sum(n for (_, why), n in runner.drops.items() if why not in MISSES)
        counts[runner.node.name] = _row(runner, runner.ports.emitted, drops, runner.done)
    for log in driver.feeding.logs:
        counts["@log"] = _row(log, log.emitted, 0, log.last)
    return counts


def _drops_of(driver: Driver, operators: Iterable[Runner]) -> dict[str, list[list[Any]]]:
    """For all sources and some operators: input ("" for a source), reason and number of what they dropped."""
    return {r.node.name: [[i, why, n] for (i, why), n in sorted(r.drops.items())] for r in operators} | {
        s.node.name: [["", why, n] for why, n in sorted(s.refused.items())] for s in driver.sources
    }


def _waits_of(operators: Iterable[Runner]) -> dict[str, list[list[Any]]]:
    """For some operators: input, "timeout" or "late", and number: waits given up, and messages that came late."""
    return {
        r.node.name: [
            *([i, "timeout", n] for i, n in sorted(r.timeouts.items())),
            *([i, "late", n] for i, n in sorted(r.late.items())),
        ]
        for r in operators
    }


def final_report(driver: Driver, transport: Mapping[str, int]) -> dict[str, Any]:
    """Returns the result of everything that was driven; `transport`: what the process has moved."""
    streams: dict[str, list[Any]] = {}
    for maker in driver.all:
        for state in maker.ports.states.values():
            streams[state.stream] = [state.digest.count, state.digest.hexdigest()]
    for log in driver.feeding.logs:
        streams |= {name: [count, digest] for name, count, digest in log.counts()}
    runners = driver.operators
    everything: list[SourceRunner | Runner] = [*driver.sources, *runners]
    return {
        "streams": streams,
        "first": _first(driver),
        "counts": counts_of(driver, runners),
        "drops": _drops_of(driver, runners),
        "waits": _waits_of(runners),
        "summaries": {r.node.name: found for r in everything if (found := summary_of(r.operator, r.node.name))},
        "transport": dict(transport),
    }


def _first(driver: Driver) -> int | None:
    """The first stamp that a source has given."""
    return min((source.first for source in driver.sources if source.first is not None), default=None)


def _row(maker: SourceRunner | Runner | LogFeed, emitted: int, dropped: int, last: int) -> list[int]:
    return [maker.firings, emitted, dropped, maker.work.cpu_ns, last, maker.work.wall_ns]
