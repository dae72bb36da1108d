"""The watch over single processes of a live run: their signs of life, deadlines, memory, and hanging calls.

Who breaks a rule is killed, and started again by its restart policy. Without a policy a process that gives no sign of
life is no longer waited for: the graph goes on without it until it reports again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.supervision.core.life import WORKS, Life
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.flow_control import LiveFlowControl
from dataflow.supervision.core.watchers.restarts import RestartPolicy
from dataflow.supervision.core.watchers.watcher import Watcher

BEAT_WITHIN = 3.0
HUNG_AFTER = 5.0
"""Seconds that a firing may take, at least, when sources drop because of it."""


class Heartbeats(Watcher):
    """Takes in what the watchdogs of the processes say."""

    def __init__(self, run: RunState, cover: LiveFlowControl, restarts: RestartPolicy) -> None:
        super().__init__(run)
        self._cover, self._restarts = cover, restarts
        self._beats: dict[str, float] = {}

    def away(self, process: Supervised) -> None:
        self._beats.pop(process.label, None)

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        if not self.run.under_way or process.life not in WORKS:
            return
        match kind:
            case "beat":
                self._beat(process, fields)
            case "overdue":
                self._overdue(process, fields["operator"], fields["stamp"], fields["seconds"])
            case "backlog":
                self._look_for_hang(fields["messages"], fields["bytes"])

    def not_reading(self, process: Supervised, seconds: float, *, overflowed: bool) -> None:
        """Treats a process that reads nothing like one that sends nothing."""
        late = seconds > BEAT_WITHIN and not process.is_sink  # a recorder may wait for its disk
        if self.run.under_way and process.life is Life.RUNNING and (late or overflowed):
            self._miss(process, f"has read nothing for {seconds:.1f} s")

    def tick(self) -> None:
        for process in self.run.processes.values():
            if process.label in self.run.unreachable:
                self._wait_for_link(process)
            beat = self._beats.get(process.label)
            if beat is not None and process.life is Life.RUNNING and self.run.steady - beat > BEAT_WITHIN:
                self._miss(process, f"gave no sign of life for {self.run.steady - beat:.1f} s")

    def _wait_for_link(self, process: Supervised) -> None:
        """Goes on without a process that is out of reach, from now on; when it is back, it has the usual time."""
        self._beats[process.label] = self.run.steady
        if process.life is Life.RUNNING and not process.silent:
            process.silent = True
            self._cover.cover()

    def _miss(self, process: Supervised, cause: str) -> None:
        if self._restarts.may_restart(process):
            self.run.kill(process, cause)
        elif not process.silent and not process.is_sink:
            process.silent = True
            text = f"{process.describe()} {cause}; it is no longer waited for"
            self.run.event("silent", text, operators=list(process.nodes))
            self._cover.cover()

    def _beat(self, process: Supervised, fields: Mapping[str, Any]) -> None:
        self._beats[process.label] = self.run.steady
        process.work = None if fields["work"] is None else tuple(fields["work"])
        if process.silent:
            process.silent = False
            self.run.event("heard", f"{process.describe()} reports again", operators=list(process.nodes))
            self._cover.heard_again(process)
        self._check_memory(process, fields["memory"])

    def _check_memory(self, process: Supervised, taken: int) -> None:
        limits = [m for n in process.nodes if (m := self.run.graph.nodes[n].live.memory) is not None]
        if limits and taken > min(limits):
            cause = f"took {taken / 1e6:.0f} MB of memory (limit {min(limits) / 1e6:.0f} MB)"
            if not self._restarts.may_restart(process):
                raise RunFailed(f"{process.describe()} {cause}", self.run.last_words(), process.nodes[0])
            self.run.kill(process, cause)

    def _overdue(self, process: Supervised, operator: str, stamp: int, seconds: float) -> None:
        deadline = self.run.graph.nodes[operator].live.deadline or 0
        what = f"its firing at stamp {stamp} has taken {seconds:.2f} s (deadline {deadline * 1e-9:g} s)"
        self._end_hang(process, operator, f"missed the deadline of {operator!r}: {what}")

    def _look_for_hang(self, messages: int, nbytes: int) -> None:
        """Where the backlog is full and sources drop, checks whether an operator hangs."""
        lags = {name: self._cover.lags(process, name)[1] for process, name in self._cover.counted()}
        for process in self.run.processes.values():
            if process.work is None or process.life is not Life.RUNNING:
                continue
            operator, stamp, seconds = process.work
            late = 2 * lags.get(operator, 0) >= max(lags.values(), default=0)  # not just another one that is slow
            if seconds > HUNG_AFTER and late and self.run.graph.nodes[operator].live.queue != "block":
                cause = (
                    f"hangs in {operator!r}: its firing at stamp {stamp} has taken {seconds:.1f} s, "
                    f"and {messages} messages ({nbytes / 1e6:.1f} MB) wait"
                )
                self._end_hang(process, operator, cause, advice=": give it a `deadline` or a restart policy")
                return

    def _end_hang(self, process: Supervised, operator: str, cause: str, *, advice: str = "") -> None:
        if not self._restarts.may_restart(process):
            words = self.run.last_words()
            self.run.kill(process)
            raise RunFailed(f"{process.describe()} {cause}{advice}", words, operator)
        self.run.kill(process, cause)
