"""Makes the operators of the runtime's tests importable, here and in workers; a run and its recording."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dataflow.graph import load_graph
from dataflow.supervision.run import run

TESTS = Path(__file__).resolve().parent.parent
KEPT = TESTS / "recordings_of"
sys.path += [str(TESTS / "runtime"), str(TESTS / "verification"), str(KEPT)]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a second with a state every 200 ms of the operators that give one."""
    path = tmp_path_factory.mktemp("editing") / "run.mcap"
    run(load_graph(TESTS / "runtime" / "chaos.yaml", settings=["count=120"]), placement="one_process", record=path)
    return path


STATEFUL = """
graph: stateful
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 120, period: 8000000}}
  first: {use: runtime_operators:Tuned, inputs: {x: left/fast}}
  second: {use: runtime_operators:Tuned, inputs: {x: first/y}, params: {factor: 0.5}}
record: {snapshots: 200ms}
"""


@pytest.fixture(scope="session")
def stateful(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a second in which every operator gives its state every 200 ms."""
    folder = tmp_path_factory.mktemp("editing")
    (folder / "stateful.yaml").write_text(STATEFUL)
    run(load_graph(folder / "stateful.yaml"), placement="one_process", record=folder / "run.mcap")
    return folder / "run.mcap"


@pytest.fixture
def kept() -> Path:
    """A small recording of a run, whole and identical."""
    return KEPT / "run.mcap"


@pytest.fixture
def live() -> Path:
    """A small recording of a live run with drops, restarts and a clock that jumped."""
    return KEPT / "live.mcap"
