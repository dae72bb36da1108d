"""New code of an operator in a live run: what goes on, what is refused, and how the run is re-executed."""

from __future__ import annotations

import itertools
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from runtime_operators import number
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.client.attach import find_running
from dataflow.client.processes import Processes, processes_of
from dataflow.graph import load_graph
from dataflow.graph.code import store
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.supervisor import Supervisor
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify

GRAPH = """\
graph: reloaded
namespace: test
operators:
  ticks: {use: runtime_operators:Counter, params: {count: 1000000}}
  sum: {use: offering_reloaded:Sum, inputs: {x: ticks/fast}, live: {queue: block}}
  after: {use: runtime_operators:Smooth, inputs: {x: sum/total}, live: {queue: block}}
"""
LAZY = """\
from dataflow.lazy import lazily

__getattr__, __dir__ = lazily(__name__, {"summing": ("Sum",)})
"""
HELPER = "def weighted(number):\n    return WEIGHT * number\n\n\nWEIGHT = 1\n"
CODE = """\
from dataclasses import dataclass

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out
from runtime_operators import number, value
from weights_reloaded import weighted


@dataclass
class State:
    total: float = 0.0


class Sum(Operator):
    x: In[FeatureVector]
    total: Out[FeatureVector]
    state: State

    def process(self, x):
        self.state.total += weighted(number(x) % 2)
        return value(x.stamp, self.state.total)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Holds the code, which processes import, and what reloads store."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "offering_reloaded").mkdir()
    (tmp_path / "offering_reloaded" / "__init__.py").write_text(LAZY)
    (tmp_path / "offering_reloaded" / "summing.py").write_text(CODE)
    (tmp_path / "weights_reloaded.py").write_text(HELPER)
    (tmp_path / "graph.yaml").write_text(GRAPH)
    yield tmp_path
    _forget()


def _forget() -> None:
    for name in ("offering_reloaded", "offering_reloaded.summing", "weights_reloaded"):
        sys.modules.pop(name, None)


def _command(*words: str, code: int = 0) -> str:
    """What `dataflow reload` prints."""
    done = CliRunner().invoke(app, ["reload", *words, "--graph", "reloaded"])
    assert done.exit_code == code, done.output
    return done.stdout if code == 0 else done.stderr


def _run(folder: Path, act: Callable[[Processes], None]) -> Path:
    """Runs the graph live while `act` does something to it; returns the recording."""
    recording = folder / "run.mcap"
    supervisor = Supervisor(RunPlan(load_graph(folder / "graph.yaml", live=True), live=True, record=recording))
    thread = threading.Thread(target=supervisor.run)
    thread.start()
    try:
        with processes_of(find_running("reloaded", wait=30)) as processes:
            _await_firings(processes, "after", 20)
            act(processes)
            _await_firings(processes, "after", 20)
    finally:
        supervisor.stop()
        thread.join(60)
    return recording


def _verified(recording: Path) -> VerifyReport:
    """Verifies as a program does that begins now."""
    _forget()
    return verify(recording, graph=load_graph(recording.parent / "graph.yaml", live=True))


def _await_firings(processes: Processes, operator: str, more: int) -> None:
    deadline, first = time.monotonic() + 30, None
    while time.monotonic() < deadline:
        counts = {name: c[0] for status in processes.statuses(1) for name, c in status.counts.items()}
        first = counts.get(operator, 0) if first is None else first
        if counts.get(operator, 0) >= first + more:
            return
        time.sleep(0.02)
    raise AssertionError(f"{operator} did not fire {more} times")


def _records(recording: Path, operator: str) -> list[Any]:
    with Recording(recording) as opened:
        return list(recorded_firings(opened, operator))


def test_reloaded_code_keeps_the_state_and_the_run_verifies_identical(folder: Path) -> None:
    outcomes: list[dict[str, Any]] = []

    def reload(processes: Processes) -> None:
        for weight in (100, 10_000):
            (folder / "weights_reloaded.py").write_text(HELPER.replace("WEIGHT = 1", f"WEIGHT = {weight}"))
            outcomes.append(json.loads(_command("sum", "--json")))
            _await_firings(processes, "after", 5)
        assert "is a source, which holds its device" in _command("ticks", code=1)
        assert "did you mean 'sum'?" in _command("sun", code=2)
        (folder / "weights_reloaded.py").write_text("WEIGHT =\n")
        assert "cannot import 'offering_reloaded:Sum'" in _command("sum", code=1)
        (folder / "weights_reloaded.py").write_text(HELPER.replace("WEIGHT = 1", "WEIGHT = 10_000"))

    recording = _run(folder, reload)

    assert [(o["state"], o["warning"]) for o in outcomes] == [("kept", "")] * 2
    records = _records(recording, "sum")
    kinds = [(r.incarnation, r.kind) for r in records if r.kind in ("setup", "restore")]
    assert kinds == [(0, "setup"), (1, "setup"), (1, "restore"), (2, "setup"), (2, "restore")]
    codes = [r.detail["code"] for r in records if r.kind == "setup"]
    assert len({code["weights_reloaded"] for code in codes}) == 3
    assert len({code["offering_reloaded.summing"] for code in codes}) == 1
    assert {file.name for file in store().iterdir()} == {digest for code in codes[:2] for digest in code.values()}
    with Recording(recording) as opened:
        totals = [number(item.message) for item in opened.messages(["test/sum/total"])]
        said = [str(item.message.text) for item in opened.messages(["test/@/logs"])]
    assert [text for text in said if text.startswith("is not reloaded, the old code goes on: cannot import 'offering")]
    assert all(b - a in (0, 1, 100, 10_000) for a, b in itertools.pairwise(totals))

    report = _verified(recording)
    assert report.identical, report.as_json()

    for file in store().iterdir():  # as on a machine on which nothing was reloaded
        file.unlink()
    report = _verified(recording)
    assert report.culprits == ("sum",)
    assert {v.operator: v.code_changed for v in report.operators} == {"sum": ["weights_reloaded"], "after": []}
