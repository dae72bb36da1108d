"""Makes the test operators importable, here and in processes, and watches for leftovers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from orphans import end_orphans

from dataflow.graph import Graph, load_graph

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE))


@pytest.fixture(autouse=True)
def _no_orphans() -> Iterator[None]:
    """Fails a test after which a child process is left."""
    yield
    assert not end_orphans()


@pytest.fixture
def mixed() -> Graph:
    """Every kind of input; small."""
    return load_graph(HERE / "mixed.yaml")
