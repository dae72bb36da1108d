"""A run beside a test."""

from __future__ import annotations

import threading
from typing import Any

from dataflow.graph import Graph
from dataflow.supervision.core.report import RunReport
from dataflow.supervision.run import run


class Background:
    """A run on a thread of its own, that tools can attach to."""

    def __init__(self, graph: Graph, **options: Any) -> None:
        self.report: RunReport | None = None
        self.thread = threading.Thread(target=self._run, args=(graph, options))
        self.thread.start()

    def _run(self, graph: Graph, options: dict[str, Any]) -> None:
        self.report = run(graph, **options)

    def end(self) -> RunReport:
        """Its report, when it has ended."""
        self.thread.join(60)
        assert self.report is not None
        return self.report
