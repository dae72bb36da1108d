"""The start barrier: every process ready, and every edge proven by a probe that arrived, before sources start."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dataflow.supervision.core.life import ON_ITS_WAY, Life, Step
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.core.run_state import RunState, StackTraceRequests, notice
from dataflow.supervision.core.supervised import Supervised

HEARD_WITHIN = 30.0
"""Seconds for which a machine that is not heard is waited for during the start; so long its agent waits, too."""


class Barrier:
    """Starts all processes, then has them send probes until nothing is unseen."""

    def __init__(self, run: RunState) -> None:
        self.run = run
        self._deadline = 0.0
        self._probing = False
        self._asking = StackTraceRequests(run)

    def begin(self) -> None:
        run = self.run
        run.status.started = run.now.wall
        self._deadline = run.steady + run.plan.start_timeout
        for process in run.processes.values():
            run.spawn(process)

    def ready(self, process: Supervised, fields: Mapping[str, Any]) -> None:
        """Takes the report of a process that is ready: the first stamp of its sources, and how many steps they have, if
        known."""
        status = self.run.status
        first, steps = fields["first"], fields["steps"]
        if first is not None:
            status.first = first if status.first is None else min(first, status.first)
        if steps is not None:
            status.steps = max(steps, status.steps or 0)
        if self.run.release is None:  # others may be sending probes already, so it may see one before it is asked to
            process.unseen = self.run.takes(process)

    def tick(self) -> bool:
        """Goes on as far as possible; True when every edge is proven."""
        run = self.run
        processes = list(run.processes.values())
        if not self._probing and all(p.life is Life.READY for p in processes):
            self._probing = True
        if self._probing:
            for process in processes:
                self._probe(process)
            if not any(map(self._missing, processes)):
                run.status.waiting = ()
                return True
        run.status.waiting = tuple(p.label for p in processes if p.life is not Life.READY and self._missing(p))
        if run.steady > self._deadline - notice(run.plan.start_timeout):
            self._asking.ask(_late(processes), self._deadline)
        self._look_at_machines()
        if run.steady > self._deadline:
            self._fail(processes)
        return False

    def _look_at_machines(self) -> None:
        """Raises `RunFailed` where a machine has gone before its processes were ready: nothing runs yet that could go
        on without it."""
        for machine, since in self.run.unheard.items():
            if (silence := self.run.steady - since) > HEARD_WITHIN:
                raise RunFailed(
                    f"machine {machine!r} was not heard for {silence:.0f} s while its operators were to start: is it "
                    "up, and does `dataflow join` still run there?",
                    self.run.last_words(),
                )

    def _missing(self, process: Supervised) -> bool:
        """Returns whether a process is not ready, or does not see all of its edges."""
        return process.life is not Life.PROBING or bool(process.unseen)

    def _probe(self, process: Supervised) -> None:
        run = self.run
        if process.life is not Life.READY:
            return
        process.take(Step.PROBE, run.steady)
        if process.attempt:
            expect_probes(run, process)
        run.send(process, "probe")

    def _fail(self, processes: list[Supervised]) -> None:
        timeout = self.run.plan.start_timeout
        if late := _late(processes):
            names = "; ".join(p.describe() + (f", which {p.cause}" if p.cause else "") for p in late)
            raise RunFailed(f"not ready within {timeout:g} s: {names}", self.run.last_words(late))
        silent = [f"{key} → {p.label}" for p in processes for key in sorted(p.unseen)]
        raise RunFailed(f"no connection within {timeout:g} s on: {', '.join(silent)}")


def _late(processes: Iterable[Supervised]) -> list[Supervised]:
    """Returns those that are not ready."""
    return [p for p in processes if p.life is not Life.READY and p.life is not Life.PROBING]


def expect_probes(run: RunState, process: Supervised) -> None:
    """Notifies the consumers of a process that took another's place that its streams are to be proven again."""
    tell_consumers(run, process, absent=False)
    made = set(process.plan.publish)
    for other in run.processes.values():
        if other is not process and other.reachable and other.life not in ON_ITS_WAY - {Life.PROBING}:
            other.unseen |= made & run.takes(other)


def tell_consumers(run: RunState, process: Supervised, *, absent: bool) -> None:
    """Notifies the consumers of a process that it is away, or that it is back."""
    made = set(process.plan.publish)
    for other in run.processes.values():
        taken = made & run.takes(other)
        if other is process or not taken:
            continue
        if not other.is_sink:
            run.send(other, "absent", streams=sorted(taken), absent=absent)
        elif not absent:
            other.expect(run.steady)
            run.send(other, "expect", streams=sorted(taken), times=other.expected, begins=process.begins)
