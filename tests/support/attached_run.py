"""Runs that commands attach to."""

from __future__ import annotations

import threading

from dataflow.client.attach import find_running
from dataflow.supervision.core.report import RunReport
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.supervisor import Supervisor


class AttachedRun:
    """A run on a separate thread, until it is told to stop."""

    def __init__(self, plan: RunPlan) -> None:
        self.supervisor = Supervisor(plan)
        self.reports: list[RunReport] = []
        self.thread = threading.Thread(target=lambda: self.reports.append(self.supervisor.run()))
        self.thread.start()
        find_running(plan.graph.name, wait=30)

    def end(self) -> RunReport:
        """Stops it, if it still runs; returns its report."""
        self.supervisor.stop()
        self.thread.join(60)
        (report,) = self.reports
        return report
