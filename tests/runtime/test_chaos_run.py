"""A live run under a fault plan ends in order, records what was done to it, and is repeated bit for bit, faults too."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataflow.chaos.plan import plan_of
from dataflow.graph import load_graph
from dataflow.messages import Diagnostics
from dataflow.names import diagnostics_key
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.run import run
from dataflow.verification.verify import verify

HERE = Path(__file__).resolve().parent

PLAN = {
    "faults": [
        {"kind": "kill", "operator": "smooth", "every": "700ms"},
        {"kind": "raise", "operator": "merge", "every": "300ms"},
        {"kind": "raise", "operator": "tuned", "every": "500ms"},
        {"kind": "hang", "operator": "slow", "every": "900ms"},
        {"kind": "slow", "operator": "mix", "by": "30ms", "for": "150ms", "every": "600ms"},
        {"kind": "leak", "operator": "sum", "megabytes": 1, "every": "500ms"},
        {"kind": "freeze", "operator": "right", "for": "100ms", "every": "900ms"},
        {"kind": "stop", "operator": "right", "for": "100ms", "every": "900ms"},
        {"kind": "flood", "operator": "left", "factor": 5, "for": "50ms", "every": "600ms"},
        {"kind": "jump", "operator": "left", "by": "300ms", "every": "800ms"},
        {"kind": "past", "operator": "right", "by": "300ms", "every": "300ms"},
        {"kind": "malformed", "operator": "mix", "every": "400ms"},
        {"kind": "param", "operator": "tuned", "name": "factor", "values": [0.5, 1.0, 2.0], "every": "100ms"},
    ]
}


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("placement", ["one_process", "process_each"])
def test_a_run_under_faults_of_every_kind_is_verified_in_the_other_placement(
    placement: str, seed: int, tmp_path: Path
) -> None:
    path = tmp_path / "chaos.mcap"
    graph = load_graph(HERE / "chaos.yaml", settings=["count=150"], live=True)

    report = run(graph, live=True, placement=placement, record=path, faults=plan_of(PLAN, graph, seed=seed), rate=1.0)

    assert not report.interrupted
    assert report.restarts
    with Recording(path) as recording:
        assert not recording.torn
        assert recording.metadata["dataflow:outcome"]["outcome"] == "complete"
        faults = [event.data for event in recording.events() if event.name == "fault"]
        assert faults
        tuned = list(recorded_firings(recording, "tuned"))
        diagnosed = [r.message for r in recording.messages([diagnostics_key("test")])]
    verified = verify(path, jobs=1 if placement == "process_each" else None)
    assert verified.identical, verified.as_json()
    assert {v.operator for v in verified.operators} == {"mix", "slow", "smooth", "merge", "tuned", "sum"}
    assert len({r.detail["value"] for r in tuned if r.kind == "param"}) > 1  # so they were changed, and repeated
    assert all(isinstance(m, Diagnostics) and set(m.names) <= set(graph.nodes) for m in diagnosed)
    assert diagnosed


@pytest.mark.long
def test_process_restarted_after_its_sources_ended_ends_in_order(tmp_path: Path) -> None:
    """The recorder has their ends, and is told to expect them again: what came in 0.5 s keeps `slow` busy for 3 s, and
    its hang comes well within these."""
    text = (HERE / "chaos.yaml").read_text()
    text = text.replace("{sleep: 0.02}", "{sleep: 0.08}").replace("queue: newest, size: 1", "queue: oldest, size: 100")
    file, path = tmp_path / "late.yaml", tmp_path / "late.mcap"
    file.write_text(text)
    graph = load_graph(file, settings=["count=60"], live=True)
    plan = {"faults": [{"kind": "hang", "operator": "slow", "at": "900ms"}]}

    report = run(graph, live=True, placement="one_process", record=path, faults=plan_of(plan, graph), rate=1.0)

    assert report.restarts == dict.fromkeys(("left", "right", "mix", "slow", "smooth", "merge", "tuned", "sum"), 1)
    with Recording(path) as recording:
        assert recording.metadata["dataflow:outcome"]["outcome"] == "complete"
    assert verify(path, jobs=1).identical


@pytest.mark.long
def test_a_parameter_that_is_changed_changes_what_comes_after_and_is_repeated(tmp_path: Path) -> None:
    path = tmp_path / "tuned.mcap"
    graph = load_graph(HERE / "chaos.yaml", settings=["count=60"], live=True)
    plan = {"faults": [{"kind": "param", "operator": "tuned", "name": "factor", "values": [0.0], "at": "200ms"}]}

    run(graph, live=True, placement="one_process", record=path, faults=plan_of(plan, graph))

    with Recording(path) as recording:
        records = list(recorded_firings(recording, "tuned"))
        (change,) = [k for k, r in enumerate(records) if r.kind == "param"]
        numbers = [float(r.message.vectors[0, 0]) for r in recording.messages(["test/tuned/y"])]
    assert records[change].detail == {"name": "factor", "value": 0.0}
    before = sum(any(records[k].outputs) for k in range(change))
    assert 0 < before < len(numbers)
    assert len(set(numbers[: before - 1])) > 1
    assert set(numbers[before:]) == {numbers[before - 1]}  # nothing is added with a weight of nothing
    assert verify(path).identical
