"""Injects the faults of a fault plan into processes, or commands them to inject these themselves."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING

from dataflow.supervision.core.life import Life
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.watcher import Watcher

if TYPE_CHECKING:
    from dataflow.chaos.plan import Fault


class PlannedFaults(Watcher):
    """Follows one plan from the release of the sources on."""

    def __init__(self, run: RunState, faults: Iterator[Fault]) -> None:
        super().__init__(run)
        self._faults = faults
        self._next = next(faults, None)
        self._thaws: dict[str, float] = {}

    def away(self, process: Supervised) -> None:
        self._thaws.pop(process.label, None)

    def tick(self) -> None:
        run = self.run
        assert run.release is not None
        since = run.steady - run.release.at.steady
        while self._next is not None and self._next.at <= since:
            fault, self._next = self._next, next(self._faults, None)
            self._do(fault)
        for label in [label for label, due in self._thaws.items() if run.steady >= due]:
            del self._thaws[label]
            run.signal(run.processes[label], signal.SIGCONT)

    def _do(self, fault: Fault) -> None:
        run = self.run
        process = next(p for p in run.processes.values() if fault.operator in p.nodes)
        if process.life is not Life.RUNNING:
            return  # it is away already, or has ended
        text = f"planned fault at {fault.at:.2f} s: {fault.kind} {fault.operator}"
        run.event("fault", text, kind=fault.kind, operator=fault.operator, fields=dict(fault.fields))
        match fault.kind:
            case "kill":
                run.signal(process, signal.SIGKILL)
            case "freeze":
                run.signal(process, signal.SIGSTOP)
                self._thaws[process.label] = run.steady + fault.fields["span"]
            case _:
                run.send(process, "fault", fault=fault.kind, operator=fault.operator, fields=dict(fault.fields))
