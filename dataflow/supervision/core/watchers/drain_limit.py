"""The bound on draining: a run that is to end does so, also when it always finds something more to do."""

from __future__ import annotations

from dataflow.supervision.core.closing import SHORTEST, bounded
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.core.run_state import Phase, RunState
from dataflow.supervision.core.watchers.watcher import Watcher
from dataflow.sync import FOREVER, NEVER


class DrainLimit(Watcher):
    """Ends a run that has not drained in time, and reports what it still owed."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._since: float | None = None

    def tick(self) -> None:
        if self.run.phase is not Phase.STOPPING:
            return
        if self._since is None:
            self._since = self.run.steady
        limit = SHORTEST if self._away() else bounded(self.run.plan.stall_timeout)
        if self.run.steady - self._since > limit:
            raise RunFailed(
                f"interrupted, and not everything was drained within {limit:g} s: {self._owed()}", interrupted=True
            )

    def _away(self) -> list[str]:
        """Returns the machines out of reach on which something would have to drain."""
        away = self.run.unreachable
        return sorted({away[p.label] for p in self.run.working() if p.report is None and p.label in away})

    def _owed(self) -> str:
        run = self.run
        reached = [run.status.operators[n].done for n, node in run.graph.nodes.items() if node.source]
        front = max((stamp for stamp in reached if stamp not in (NEVER, FOREVER)), default=None)
        upto = "" if front is None else f", sources had given up to {front}"
        left = [process for process in run.working() if process.report is None]
        silent = [f"machine {machine!r} is out of reach" for machine in self._away()]
        left = [process for process in left if process.label not in run.unreachable]
        silent += [f"{process.describe()} gives no sign of life" for process in left if process.silent]
        behind = [
            self._at(name)
            for process in left
            if not process.silent
            for name in run.consumers(process)
            if process.done.get(name) != FOREVER
        ]
        return ("; ".join(silent + behind) or "; ".join(process.describe() for process in left)) + upto

    def _at(self, name: str) -> str:
        counts = self.run.status.operators[name]
        stamp = "no stamp" if counts.done in (NEVER, FOREVER) else f"stamp {counts.done}"
        return f"{name} was at {stamp} after {counts.firings} firings"
