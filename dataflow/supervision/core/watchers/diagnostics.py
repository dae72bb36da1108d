"""Diagnostics of a live run: how every operator fares, once a second, for the status and the recording."""

from __future__ import annotations

from dataflow.supervision.core.health import HealthMonitor, diagnostics_fields
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.watcher import Watcher

DIAGNOSE_EVERY = 1.0


class DiagnosticsWatcher(Watcher):
    """Turns counts into health."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._monitor = HealthMonitor()
        self._away: dict[str, str] = {}
        self._due = 0.0

    def released(self) -> None:
        self._due = self.run.steady

    def away(self, process: Supervised) -> None:
        self._away |= dict.fromkeys(process.nodes, process.cause)

    def back(self, process: Supervised) -> None:
        for name in process.nodes:
            self._away.pop(name, None)

    def tick(self) -> None:
        run = self.run
        if run.steady < self._due:
            return
        self._due = run.steady + DIAGNOSE_EVERY
        counts = {
            name: (c.firings, c.emitted, c.dropped, c.cpu_ns, c.done, c.wall_ns)
            for name, c in run.status.operators.items()
            if not name.startswith("@")
        }
        ended = frozenset(n for p in run.processes.values() if p.report is not None for n in p.nodes)
        run.status.health = self._monitor.update(
            counts,
            run.steady,
            away=self._away,
            ended=ended,
            restarts=run.status.restarts,
            drops=run.status.drops,
            waits=run.status.waits,
        )
        run.tell_recorder("diagnostics", **diagnostics_fields(run.status.health, run.event_time()))
