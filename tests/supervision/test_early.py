"""A nursery that is started before the graph is known: what it becomes, and that nothing of it is left."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import pytest

from dataflow.execution.threads import environment
from dataflow.graph import load_text
from dataflow.supervision import supervisor
from dataflow.supervision.early_nursery import EarlyNursery, early_nursery
from dataflow.supervision.nursery import Nursery
from dataflow.supervision.run import run

GRAPH = """\
graph: early
namespace: test
operators:
  left: {use: "runtime_operators:Counter", params: {count: 5}}
  sum: {use: "own_sum:OwnSum", inputs: {x: left/fast}}
"""

OWN = """\
import os
import sys
from runtime_operators import Sum

LOADED = "scipy.spatial" in sys.modules

class OwnSum(Sum):
    def summary(self):
        return {"word": os.environ["A_WORD"], "parent": os.getppid(), "loaded": LOADED}
"""


def nursery_of(early: EarlyNursery) -> int:
    assert early._nursery is not None
    return early._nursery._process.pid


def runs(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def test_early_nursery_processes_see_later_modules_and_variables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_sum.py").write_text(OWN)
    importlib.import_module("scipy.spatial")  # as operators of the graph do
    with early_nursery() as early:
        pid = nursery_of(early)
        monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
        monkeypatch.setenv("A_WORD", "said later")
        report = run(load_text(GRAPH), early=early)

    assert report.summaries["sum"] == {"word": "said later", "parent": pid, "loaded": True}
    assert not runs(pid)


@pytest.mark.long
def test_graph_with_another_thread_count_gets_a_separate_nursery(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[str] = []
    real = supervisor.Nursery
    monkeypatch.setattr(supervisor, "Nursery", lambda given: started.append(given["OMP_NUM_THREADS"]) or real(given))
    with early_nursery() as early:
        run(load_text(GRAPH.replace("own_sum:OwnSum", "runtime_operators:Sum") + "threads: 2\n"), early=early)

    assert started == ["2"]


def test_unused_early_nursery_is_ended_at_once() -> None:
    with early_nursery() as early:
        pid = nursery_of(early)
        assert runs(pid)

    assert not runs(pid)


def test_dead_early_nursery_is_replaced() -> None:
    with early_nursery() as early:
        assert early._nursery is not None
        early._nursery._process.kill()
        early._nursery._process.wait()
        report = run(load_text(GRAPH.replace("own_sum:OwnSum", "runtime_operators:Sum")), early=early)

    assert report.summaries["sum"]["count"] == 5


def test_early_nursery_has_the_default_thread_count() -> None:
    with early_nursery() as early:
        taken = early.take(1)

    assert taken is not None
    assert taken.environment == environment(1)
    taken.close()
    assert os.environ.get("DATAFLOW_THREADS") is None


def test_a_process_that_is_only_asked_for_leaves_when_its_nursery_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.supervision.nursery.LEAVE_WITHIN", 9.0)  # before a nursery kills what stays: then -9
    nursery = Nursery(environment(1))
    child = nursery.spawn()
    nursery.close()
    child.close()
    assert nursery._process.returncode == 0
