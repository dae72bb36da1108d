"""Tools that follow a running graph are served, and can neither slow it nor cost it a message."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from background_run import Background
from tests_runtime_graphs import chain

from dataflow.client.attach import NotRunning, find_running, graph_of, still_runs, tap
from dataflow.graph import Graph
from dataflow.recording import Recording
from dataflow.supervision.run import run

HERE = Path(__file__).resolve().parent


@pytest.fixture(autouse=True)
def _registry_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def slow_graph(count: int = 200, sleep: float = 0.02) -> Graph:
    return chain(
        f"smooth: {{use: runtime_operators:Smooth, inputs: {{x: left/fast}}, params: {{sleep: {sleep}}}}}",
        "sum: {use: runtime_operators:Sum, inputs: {x: smooth/mean}}",
        count=count,
    )


@pytest.mark.long
def test_a_tap_sees_the_statics_first_and_then_the_messages_of_a_running_graph() -> None:
    running = Background(slow_graph(), window=(8, 1 << 20))
    found = find_running("chain", wait=30)

    assert set(graph_of(found).nodes) == {"left", "smooth", "sum"}
    with tap(found, ["left/*", "smooth/mean"]) as client:
        taken = [m for _ in range(20) if (m := client.take(timeout=5)) is not None]
    running.end()

    assert taken[0].stream == "test/left/constant"
    assert {"test/left/fast", "test/smooth/mean"} <= {m.stream for m in taken}
    assert not still_runs(found)


def test_finding_a_graph_that_does_not_run_raises() -> None:
    with pytest.raises(NotRunning, match="no graph 'nothing' runs on this machine"):
        find_running("nothing")


@pytest.mark.long
def test_a_stopped_viewer_costs_nothing_and_loses_nothing(tmp_path: Path) -> None:
    graph = slow_graph(count=400, sleep=0.01)
    undisturbed = run(graph)
    running = Background(graph, record=tmp_path / "run.mcap", window=(8, 1 << 20))
    find_running("chain", wait=30)
    viewer = subprocess.Popen(
        [sys.executable, "-m", "dataflow.cli.main", "echo", "--graph", "chain", "--json"],
        env={**os.environ, "PYTHONPATH": str(HERE)},
        stdout=subprocess.PIPE,
    )
    try:
        assert viewer.stdout is not None
        assert viewer.stdout.readline().startswith(b"{")  # it is attached and served
        viewer.send_signal(signal.SIGSTOP)
        report = running.end()  # ends although the viewer takes nothing any more
    finally:
        viewer.kill()
        viewer.communicate(timeout=10)

    assert report.digests() == undisturbed.digests()
    with Recording(tmp_path / "run.mcap") as recording:
        assert dict(recording.digests()) == undisturbed.digests()
