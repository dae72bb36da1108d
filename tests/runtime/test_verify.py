"""Verification repeats recorded firings, says 'identical' only when all is, and names who is to blame when not."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import pytest
from tests_runtime_graphs import chain

from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.run import run
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify

HERE = Path(__file__).resolve().parent


@pytest.fixture(autouse=True)
def _verified_here(request: pytest.FixtureRequest) -> None:
    """Leaves worker processes to the test of their number."""
    if "jobs" not in request.fixturenames:
        request.getfixturevalue("in_process")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("verify") / "run.mcap"
    run(load_graph(HERE / "mixed.yaml"), placement="process_each", record=path)
    return path


def verdicts(report: VerifyReport) -> dict[str, str]:
    return {v.operator: v.verdict for v in report.operators}


@pytest.mark.parametrize("jobs", [2, *(pytest.param(jobs, marks=pytest.mark.long) for jobs in (1, 9))])
def test_a_recorded_run_is_identical_with_any_number_of_workers(recorded: Path, jobs: int) -> None:
    report = verify(recorded, jobs=jobs)

    assert report.identical
    assert report.messages == 403
    assert {v.operator: v.verified for v in report.operators} == {"mix": 101, "smooth": 121, "merge": 200, "sum": 200}
    assert all(v.verified == v.firings and v.whole for v in report.operators)


def test_one_operator_is_verified_alone_with_its_inputs_taken_from_the_recording(recorded: Path) -> None:
    report = verify(recorded, only=["smooth"])

    assert verdicts(report) == {"smooth": "identical"}
    assert report.stood_in == ("mix",)


def test_verify_first_covers_the_operator_and_its_downstream(recorded: Path) -> None:
    assert set(verdicts(verify(recorded, first="merge"))) == {"merge", "sum"}


@pytest.fixture(scope="module")
def thin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the sensors alone: operators are fed by those that make what they take."""
    graph = load_graph(HERE / "mixed.yaml")
    sensors = tuple(s for s, made in graph.streams.items() if graph.nodes[made.node].source)
    path = tmp_path_factory.mktemp("thin") / "run.mcap"
    run(replace(graph, record=replace(graph.record, streams=sensors)), placement="one_process", record=path)
    return path


def test_change_in_one_operator_names_it_and_its_firing_alone(recorded: Path) -> None:
    graph = load_graph(HERE / "changed.yaml")

    report = verify(recorded, graph=graph)

    assert report.culprits == ("smooth",)
    assert verdicts(report) == {"mix": "identical", "smooth": "culprit", "merge": "identical", "sum": "identical"}
    first = next(v.first for v in report.operators if v.operator == "smooth")
    assert first is not None
    assert (first.kind, first.port) == ("fire", "mean")
    with Recording(recorded) as recording:
        expected = next(m.message for m in recording.messages(["test/smooth/mean"]) if m.stamp == first.stamp)
    assert first.expected == expected.digest().hex() != first.got


@pytest.mark.long
def test_where_inputs_were_not_recorded_others_are_downstream_of_the_culprit(thin: Path) -> None:
    report = verify(thin, graph=load_graph(HERE / "changed.yaml"))

    assert report.culprits == ("smooth",)
    assert verdicts(report) == {"mix": "downstream", "smooth": "culprit", "merge": "identical", "sum": "identical"}


def test_an_operator_that_reads_the_clock_or_draws_unseeded_numbers_is_the_culprit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    graph = chain(
        "smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}}",
        "dice: {use: runtime_operators:Unrepeatable, inputs: {x: smooth/mean}}",
        "sum: {use: runtime_operators:Merge, inputs: {all: dice/y}}",
    )
    run(graph, record=path)

    report = verify(path)

    assert report.culprits == ("dice",)
    assert verdicts(report)["smooth"] == "identical"
    assert verdicts(report)["sum"] == "identical"
    assert report.repeats("dice") is False


def test_a_torn_recording_is_never_called_wholly_identical(recorded: Path, tmp_path: Path) -> None:
    data = recorded.read_bytes()
    for cut in random.Random(3).sample(range(len(data) // 3, len(data) * 9 // 10), 3):
        torn = tmp_path / f"{cut}.mcap"
        torn.write_bytes(data[:cut])
        try:
            report = verify(torn, jobs=1)
        except ReplayError:
            continue
        assert not any(v.first for v in report.operators)
        assert report.torn
        assert report.identical != report.cut
        assert report.cut or report.messages == 403  # the file lacks no more than its index


def test_verifying_sources_or_unknown_operators_is_refused(recorded: Path) -> None:
    with pytest.raises(ReplayError, match="'left' cannot be verified: it is a source"):
        verify(recorded, only=["left"])
    with pytest.raises(ReplayError, match="no operator of the graph; those that can: merge, mix, smooth, sum"):
        verify(recorded, only=["nobody"])
