"""A live run drops, times out and is late; it says so, and its recording repeats it exactly."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataflow.execution.source import SourceRunner
from dataflow.graph import load_graph, load_text
from dataflow.recording import Recording
from dataflow.recording.layout import RUN
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import recorded_firings
from dataflow.supervision.run import run
from dataflow.sync import Entry
from dataflow.verification.verify import verify

HERE = Path(__file__).resolve().parent


@pytest.mark.parametrize("placement", ["one_process", pytest.param("process_each", marks=pytest.mark.long)])
def test_a_live_run_with_drops_and_timeouts_is_verified_in_another_placement(placement: str, tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    graph = load_graph(HERE / "live.yaml", live=True)

    report = run(graph, live=True, placement=placement, record=path)

    reasons = {(op, reason) for op, drops in report.drops.items() for _, reason, _ in drops}
    assert ("slow", "overflow") in reasons
    waited = {(op, what) for op, waits in report.waits.items() for _, what, _ in waits}
    assert ("mix", "timeout") in waited
    assert "timeout" not in {reason for _, reason in reasons}
    with Recording(path) as recording:
        assert recording.metadata[RUN]["seeding"] == "3"
        overflowed = [d for r in recorded_firings(recording, "slow") for d in r.drops if d.reason == "overflow"]
        assert len(overflowed) == sum(n for _, why, n in report.drops["slow"] if why == "overflow")
    verified = verify(path, jobs=1 if placement == "process_each" else None)
    assert verified.identical, verified.as_json()
    assert {v.operator for v in verified.operators} == {"mix", "slow", "smooth", "merge", "sum"}


@pytest.mark.long
def test_live_runs_differ_so_verification_is_not_vacuous(tmp_path: Path) -> None:
    graph = load_graph(HERE / "live.yaml", settings=["count=60"], live=True)

    digests = {run(graph, live=True, placement="one_process").streams["test/slow/mean"] for _ in range(3)}

    assert len(digests) > 1


def test_cpu_time_of_a_source_is_counted() -> None:
    """In a live run it is read by a thread of its own."""
    graph = load_graph(HERE / "live.yaml", settings=["count=60"], live=True)
    source = SourceRunner(graph.nodes["left"], Outlets(), live=True)
    source.setup()
    assert source.work.cpu_ns == 0

    while source.take() is not None:
        pass

    assert source.work.cpu_ns > 0


class Outlets:
    """Takes everything that a runner gives, and leaves it."""

    def message(self, stream: str, entry: Entry) -> None:
        pass

    def frontier(self, stream: str, frontier: int) -> None:
        pass

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        pass

    def record(self, record: FiringRecord) -> None:
        pass


def test_the_report_of_a_device_has_the_span_of_its_stamps() -> None:
    graph = load_text("graph: one\noperators:\n  device: {use: 'faulty_operators:Device', params: {steps: 20}}\n")

    report = run(graph, live=True)

    assert report.sources == ("device",)
    assert report.first is not None
    assert report.last is not None
    assert report.last - report.first >= 19 * 10_000_000
