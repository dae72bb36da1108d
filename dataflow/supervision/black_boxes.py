"""The black boxes of a live run: what each operator process writes its firing records to, and leaves behind."""

from __future__ import annotations

import os
from collections.abc import Mapping

from dataflow.graph.model import Graph
from dataflow.records.black_box import RecoveredRecords, make_black_box, read_black_box
from dataflow.supervision.plan import ProcessPlan


class Boxes:
    """Holds a descriptor for each operator process of a live run whose place another process may take."""

    def __init__(self, graph: Graph, processes: Mapping[str, ProcessPlan], *, live: bool) -> None:
        self._graph, self._processes, self._live = graph, processes, live
        self._boxes: dict[str, int] = {}

    def make(self, label: str) -> tuple[int, ...]:
        """Makes the box of a process that is about to start; nothing for one that needs none."""
        process = self._processes.get(label)  # None: the link
        if not self._live or process is None or process.sink is not None:
            return ()
        self._boxes[label] = make_black_box()
        return (self._boxes[label],)

    def read(self, label: str) -> RecoveredRecords | None:
        """Reads the firing records that a process which ended has left, once; None where it had no box."""
        box = self._boxes.pop(label, None)
        if box is None:
            return None
        try:
            nodes = self._graph.nodes
            return read_black_box(box, {name: tuple(nodes[name].outputs) for name in self._processes[label].nodes})
        finally:
            os.close(box)

    def close(self) -> None:
        """Releases the boxes that have not been read."""
        for box in self._boxes.values():
            os.close(box)
        self._boxes.clear()
