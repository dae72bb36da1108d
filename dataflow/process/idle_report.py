"""Reports the state of a process of operators to the supervisor: when asked, and when all its operators have ended."""

from __future__ import annotations

from collections.abc import Callable

from dataflow.execution.driver import Driver
from dataflow.process.channel import Channel
from dataflow.process.control import Control
from dataflow.process.live_sources import LiveSources
from dataflow.process.progress import Progress, final_report
from dataflow.process.streams.inbox import Inbox
from dataflow.process.streams.inlet import Inlet
from dataflow.process.streams.outlet import Outlet


class IdleReport:
    """Reports whether one process is finished or idle."""

    def __init__(
        self,
        channel: Channel,
        orders: Control,
        driver: Driver,
        live: LiveSources,
        inbox: Inbox,
        inlet: Inlet,
        outlet: Outlet,
        progress: Progress,
        outside: Callable[[], dict[str, int]],
    ) -> None:
        """`outside`: the counts of what has passed between this process and programs outside the run."""
        self._channel, self._orders, self._progress = channel, orders, progress
        self._driver, self._live = driver, live
        self._inbox, self._inlet, self._outlet, self._outside = inbox, inlet, outlet, outside
        self._ended = False

    def end_if_done(self) -> None:
        """Sends what came of everything, once, when all feeds, sources and operators have ended."""
        for runner in self._driver.operators:
            if not runner.ended:
                return
        if self._ended or not (self._driver.feeding.ended and self._live.ended):
            return
        self._ended = True
        self._outlet.flush_all()
        self._progress.report(idle=True)
        self._channel.send("ended", report=final_report(self._driver, self._moved()))

    def answer(self, *, idle: bool) -> None:
        """Answers the supervisor's poll. `idle`: a look at everything has just found nothing to do.

        What it was to be told anyway comes first: others may go on by it, and the answer is taken for a proof.
        """
        asked, self._orders.asked = self._orders.asked, None
        self._outlet.flush_all()
        self._progress.report(idle=idle, at_once=True)
        self._channel.send(
            "state",
            round=asked,
            idle=idle and self._inbox.empty() and not self._waits_for_clock() and self._live.ended,
            sent=self._outlet.sent,
            received=self._inlet.received,
            full=self._driver.feeding.full,
            waiting=self._progress.waiting(),
            due=self._driver.feeding.next_due(),
            **({"paused": self._driver.feeding.playback.paused} if self._driver.feeding.feeds else {}),
        )

    def _waits_for_clock(self) -> bool:
        return (
            (self._driver.feeding.playback.holds and not self._driver.feeding.ended)
            or (self._orders.released and self._driver.feeding.next_due() is not None)
            or any(runner.next_due() is not None for runner in self._driver.operators)
        )

    def _moved(self) -> dict[str, int]:
        """Counts what has passed between this process and others."""
        refused = {"malformed": self._inlet.malformed, "misplaced": self._inlet.misplaced}
        return self._outlet.counters() | self._inbox.counters() | self._outside() | refused
