"""Makes the test operators importable, here and in workers, and watches for processes that are left over."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from orphans import end_orphans

from dataflow.graph import Graph
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import recorded_graph

HERE = Path(__file__).resolve().parent
KEPT = HERE.parent / "recordings_of"
sys.path += [str(HERE), str(KEPT), str(HERE.parent / "runtime")]


@pytest.fixture(autouse=True)
def _no_orphans() -> Iterator[None]:
    """Fails a test after which a child process is left."""
    yield
    assert not end_orphans()


@pytest.fixture
def kept() -> Path:
    """A small recording of a run, whole and identical: see `recordings_of`."""
    return KEPT / "run.mcap"


@pytest.fixture
def with_class(kept: Path) -> Callable[[str, str], Graph]:
    """Returns the graph of that recording, in which an operator has a class of `watched_operators`."""

    def changed(operator: str, use: str) -> Graph:
        with Recording(kept) as recording:
            graph = recorded_graph(recording)
        node = replace(graph.nodes[operator], use=f"watched_operators:{use}")
        return replace(graph, nodes={**graph.nodes, operator: node})

    return changed
