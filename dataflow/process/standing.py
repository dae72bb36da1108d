"""Tells the supervisor where a process of operators stands: when it is asked, and when all its operators have ended."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dataflow.process.operator_process import OperatorProcess


class Standing:
    """Knows whether one process has ended, and whether anything is still to come there without news from outside."""

    def __init__(self, process: OperatorProcess) -> None:
        self._process = process
        self._ended = False

    def end_if_done(self) -> None:
        """Sends what came of everything, once, when all feeds, sources and operators have ended."""
        process = self._process
        if self._ended or not (process.feeding.ended and process.live.ended):
            return
        if all(runner.ended for runner in process.runners.operators):
            self._ended = True
            process.outlet.flush_all()
            process.progress.report(idle=True)
            process.channel.send("ended", report=process.progress.final_report(self._moved()))

    def answer(self, *, idle: bool) -> None:
        """Answers the supervisor's poll, if there is one. `idle`: a look at everything has just found nothing to do."""
        process = self._process
        if process.orders.asked is None:
            return
        asked, process.orders.asked = process.orders.asked, None
        process.outlet.flush_all()
        process.channel.send(
            "state",
            round=asked,
            idle=idle and process.inbox.empty() and not self._waits_for_clock() and process.live.ended,
            sent=process.outlet.sent,
            received=process.inlet.received,
            full=process.feeding.full,
            waiting=process.progress.waiting(),
            due=process.feeding.next_due(),
            **({"paused": process.feeding.playback.paused} if process.feeding.feeds else {}),
        )

    def _waits_for_clock(self) -> bool:
        process = self._process
        return (
            (process.feeding.playback.holds and not process.feeding.ended)
            or process.next_feeding() is not None
            or any(runner.next_due() is not None for runner in process.runners.operators)
        )

    def _moved(self) -> dict[str, int]:
        """Counts what has passed between this process and others."""
        process = self._process
        refused = {"malformed": process.inlet.malformed, "misplaced": process.inlet.misplaced}
        return process.outlet.counters() | process.inbox.counters() | process.bus.counters() | refused
