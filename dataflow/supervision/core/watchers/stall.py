"""The watch over runs in which nothing happens: what holds them up is named, and the run ends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.supervision.core.life import WORKS
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.core.run_state import RunState, StackTraceRequests, notice
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.lateness import how_long
from dataflow.supervision.core.watchers.quiescence import Quiescence
from dataflow.supervision.core.watchers.watcher import Watcher

PING_AFTER = 1.0
"""Seconds after which a process that sends nothing is asked for a sign of life."""
NO_ROUND = 0
"""The number of a question that is no round of the proof of quiescence."""


class StallWatch(Watcher):
    """Ends a run in which no process has made progress for `stall_timeout` seconds."""

    def __init__(self, run: RunState, quiescence: Quiescence) -> None:
        super().__init__(run)
        self.quiescence = quiescence
        self._heard = 0.0
        self._asking = StackTraceRequests(run)

    def released(self) -> None:
        self._heard = self.run.steady

    def back(self, process: Supervised) -> None:
        self._heard = self.run.steady

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        if kind in ("progress", "ended") or fields.get("paused"):
            self._heard = self.run.steady
        if "paused" in fields:
            self.run.status.paused = fields["paused"]
        if kind == "playback":
            self.run.status.speed = fields["speed"]

    def tick(self) -> None:
        timeout = self.run.plan.stall_timeout
        for process in self._stuck(timeout - notice(timeout)):
            self._asking.ask([process], self._stuck_since(process))
        if self.run.steady - self._heard <= timeout:
            return
        stuck = self._stuck(timeout)
        if not stuck:
            return
        names = "; ".join(p.at_work() for p in stuck) + self._waits_for_clock()
        words = self.run.last_words(stuck)
        for process in self.quiescence.unanswered():  # they could not leave in order
            self.run.kill(process)
        raise RunFailed(f"no progress for {timeout:g} s; still busy: {names}", words)

    def not_reading(self, process: Supervised, seconds: float, *, overflowed: bool) -> None:
        """One that takes nothing any more has lost what it needs to go on."""
        if overflowed and process.life in WORKS:
            words = self.run.last_words()
            self.run.kill(process)
            raise RunFailed(f"{process.describe()} has read nothing for {seconds:.0f} s", words)

    def _stuck(self, seconds: float) -> list[Supervised]:
        """Returns those that hold up the run for so long: which do not answer, else which have not ended."""
        if self.run.steady - self._heard <= seconds:
            return []
        return self.quiescence.unanswered() or [p for p in self.run.working() if p.report is None]

    def _stuck_since(self, process: Supervised) -> object:
        """Returns what changes when a process goes on."""
        return self._heard

    def _waits_for_clock(self) -> str:
        """Names a source that has nothing to do for long because its next message is due late."""
        dues = [(due, label) for label, a in self.quiescence.latest.items() if (due := a.get("due")) is not None]
        due, label = max(dues, default=(0.0, ""))
        if due <= self.run.plan.stall_timeout:
            return ""
        rate = 1.0 if self.run.plan.rate is None else self.run.plan.rate
        return f"; the next message of process {label!r} is due in {how_long(due)} at rate {rate:g}"


class LiveStallWatch(StallWatch):
    """As `StallWatch`, for a live run, where a robot at which nothing happens is as it should be: only one whose call
    does not end holds it up. A process that gives no sign of life for so long ends the run, whatever others do."""

    def __init__(self, run: RunState, quiescence: Quiescence) -> None:
        super().__init__(run, quiescence)
        self._signs: dict[str, float] = {}
        self._asking_silent = StackTraceRequests(run)
        graph = run.graph
        self._flowing = {s for node in graph.sources() for s in node.outputs.values() if not graph.streams[s].static}
        """The streams of sources that have not ended."""

    def released(self) -> None:
        super().released()
        self._signs = dict.fromkeys(self.run.processes, self.run.steady)

    def back(self, process: Supervised) -> None:
        super().back(process)
        self._signs[process.label] = self.run.steady

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        super().said(process, kind, fields)
        self._signs[process.label] = self.run.steady
        if kind == "stream_ended":
            self._flowing.discard(fields["stream"])

    def _stuck(self, seconds: float) -> list[Supervised]:
        """Returns those that are at one call for so long."""
        return [p for p in self.run.working() if p.work is not None and p.work[2] >= seconds]

    def _stuck_since(self, process: Supervised) -> object:
        return None if process.work is None else process.work[:2]

    def tick(self) -> None:
        super().tick()
        now, timeout = self.run.steady, self.run.plan.stall_timeout
        if not self._flowing and (stuck := self._stuck(timeout)):  # however busy a timer is
            names = "; ".join(p.at_work() for p in stuck)
            raise RunFailed(f"all sources have ended, and a call does not: {names}", self.run.last_words(stuck))
        for process in list(self.run.working()):
            if process.label in self.run.unreachable:
                self._signs[process.label] = now
            sign = self._signs.get(process.label, now)
            silence = now - sign
            if silence > timeout - notice(timeout):
                self._asking_silent.ask([process], sign)
            if silence > timeout:
                words = self.run.last_words([process])
                self.run.kill(process)
                raise RunFailed(f"{process.describe()} gave no sign of life for {silence:.0f} s", words)
            if process.is_sink and silence > PING_AFTER and not self.quiescence.asked:  # operators' processes give one
                self.run.send(process, "poll", replaces=True, round=NO_ROUND)
