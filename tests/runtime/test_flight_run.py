"""The flight recorder of a live run: somebody asks, an operator fails, and what is kept re-executes exactly."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dataflow.chaos.plan import plan_of
from dataflow.client.attach import NotRunning, find_running
from dataflow.client.trigger import trigger
from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.supervision.run import run
from dataflow.supervision.supervisor import Supervisor
from dataflow.verification.verify import verify

GRAPH = """
graph: flying
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 200, period: 10000000}}
  first: {use: runtime_operators:Tuned, inputs: {x: left/fast}, live: {restart: {max: 5, backoff: 20ms}}}
  second: {use: runtime_operators:Tuned, inputs: {x: first/y}}
record: {keep: 1s, after: 200ms, snapshots: 200ms, when: [raise]}
"""


def flown(tmp_path: Path, **options: Any) -> Any:
    (tmp_path / "flying.yaml").write_text(GRAPH)
    graph = load_graph(tmp_path / "flying.yaml", live=True)
    if "faults" in options:
        options["faults"] = plan_of(options["faults"], graph)
    folder = tmp_path / "kept"
    report = run(graph, live=True, rate=1.0, placement="one_process", flight=folder, **options)
    return report, sorted(folder.glob("*.mcap"))


@pytest.mark.long
def test_triggered_recording_is_kept_and_verifies(tmp_path: Path) -> None:
    asked: list[str] = []

    def ask() -> None:
        found = find_running("flying", wait=30)
        try:
            trigger(found, "near the door")
            asked.append("yes")
        except NotRunning as error:
            asked.append(str(error))

    thread = threading.Thread(target=ask)
    thread.start()
    _, files = flown(tmp_path)
    thread.join()

    assert asked == ["yes"]
    (file,) = files
    with Recording(file) as kept:
        assert "near the door" in kept.metadata["dataflow:flight"]["triggers"]
    report = verify(file)
    assert {v.verdict for v in report.operators} == {"identical"}


@pytest.mark.long
def test_trigger_by_the_user_keeps_a_flight_recording(tmp_path: Path) -> None:
    @contextmanager
    def controls(supervisor: Supervisor) -> Iterator[None]:
        def press() -> None:
            find_running("flying", wait=30)
            while "second" not in supervisor.status.operators:
                pause.wait(0.01)
            supervisor.trigger("the key k")

        pause, thread = threading.Event(), threading.Thread(target=press)
        thread.start()
        yield
        thread.join()

    _, files = flown(tmp_path, controls=controls)

    (file,) = files
    with Recording(file) as kept:
        assert "the key k" in kept.metadata["dataflow:flight"]["triggers"]


@pytest.mark.long
def test_failing_operator_triggers_a_flight_recording(tmp_path: Path) -> None:
    plan = {"faults": [{"kind": "raise", "operator": "first", "at": "1200ms"}]}

    _, files = flown(tmp_path, faults=plan)

    assert files
    with Recording(files[0]) as kept:
        assert "first" in kept.metadata["dataflow:flight"]["triggers"]
    report = verify(files[0])
    assert not report.culprits
    assert {v.verdict for v in report.operators} == {"identical"}, report.as_json()
