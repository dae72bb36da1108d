"""A difference is named to the field and the element; a tolerance lets through only what it may, and says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dataflow.graph import Graph, load_graph
from dataflow.recording import Recording, machine_facts
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.run import run
from dataflow.verification import facts as verification_facts
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify

pytestmark = pytest.mark.usefixtures("in_process")

HERE = Path(__file__).resolve().parent
SETTINGS = ["count=30"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fields") / "run.mcap"
    run(load_graph(HERE / "mixed.yaml", settings=SETTINGS), placement="one_process", record=path)
    return path


def with_smooth(use: str) -> Graph:
    """The graph with another class for its operator `smooth`."""
    graph = load_graph(HERE / "mixed.yaml", settings=SETTINGS)
    return replace(graph, nodes={**graph.nodes, "smooth": replace(graph.nodes["smooth"], use=use)})


def verified(recorded: Path, use: str, tolerance: float | None = None) -> VerifyReport:
    return verify(recorded, graph=with_smooth(f"verified_operators:{use}"), tolerance=tolerance, jobs=1)


def verdict(report: VerifyReport, operator: str) -> str:
    return next(report.verdict(v) for v in report.operators if v.operator == operator)


def test_the_first_difference_of_a_culprit_names_field_element_and_values(recorded: Path) -> None:
    report = verified(recorded, "Nudged")

    assert report.culprits == ("smooth",)
    first = next(v.first for v in report.operators if v.operator == "smooth")
    [output] = report.comparisons["smooth"].first
    assert first is not None
    assert (output.index, output.port, output.recorded, output.here) == (first.index, "mean", first.expected, first.got)
    [field] = output.fields
    assert (field.field, field.index, field.count, field.size) == ("vectors", (0, 2), 1, 3)
    with Recording(recorded) as recording:
        stored = next(m for m in recording.messages(["test/smooth/mean"]) if m.seq == output.seq).message
    assert field.a == float(stored.vectors[0, 2])
    assert isinstance(field.a, float)
    assert isinstance(field.b, float)
    assert field.max_difference == pytest.approx(abs(field.b - field.a))
    assert report.repeats("smooth") is True
    assert report.as_json()["operators"][1]["comparison"]["first"][0]["fields"][0]["index"] == [0, 2]


def test_random_operator_is_distinguished_from_a_changed_one(recorded: Path) -> None:
    report = verified(recorded, "Moody")

    assert report.culprits == ("smooth",)
    assert report.repeats("smooth") is False


def test_values_within_the_tolerance_pass_as_such_and_never_as_identical(recorded: Path) -> None:
    report = verified(recorded, "Nudged", tolerance=1e-5)

    assert verdict(report, "smooth") == "within tolerance"
    assert report.within_tolerance
    assert not report.identical
    compared = report.comparisons["smooth"]
    assert compared.tolerated
    assert compared.within > 0 < compared.equal
    assert 0 < compared.max_difference <= 1e-5
    assert compared.within + compared.equal == next(v.outputs for v in report.operators if v.operator == "smooth")


def test_one_value_beyond_the_tolerance_is_a_difference_again(recorded: Path) -> None:
    report = verified(recorded, "Nudged", tolerance=1e-8)

    assert verdict(report, "smooth") == "culprit"
    assert not report.within_tolerance
    assert report.comparisons["smooth"].beyond > 0


def test_no_tolerance_covers_messages_where_there_were_none(recorded: Path) -> None:
    report = verified(recorded, "Chatty", tolerance=1e3)

    assert verdict(report, "smooth") == "culprit"
    compared = report.comparisons["smooth"]
    assert (compared.beyond, compared.unpaired > 0) == (0, True)


def test_downstream_operators_with_recorded_inputs_are_within_tolerance(recorded: Path) -> None:
    report = verified(recorded, "Nudged", tolerance=1e-5)

    differing = {v.operator for v in report.operators if v.first is not None} - {"smooth"}
    for operator in differing:
        assert report.comparisons[operator].within == 0
        assert verdict(report, operator) == "within tolerance"


@pytest.mark.parametrize("tolerance", [-1.0, float("nan"), float("inf")])
def test_a_tolerance_that_is_none_is_refused(recorded: Path, tolerance: float) -> None:
    with pytest.raises(ReplayError, match="expected a finite number, 0 or more"):
        verify(recorded, tolerance=tolerance)


@pytest.mark.long
def test_without_recorded_outputs_only_digests_are_compared(tmp_path: Path) -> None:
    graph = load_graph(HERE / "mixed.yaml", settings=SETTINGS)
    sensors = tuple(s for s, made in graph.streams.items() if graph.nodes[made.node].source)
    path = tmp_path / "thin.mcap"
    run(replace(graph, record=replace(graph.record, streams=sensors)), placement="one_process", record=path)

    report = verified(path, "Nudged")

    [output] = report.comparisons["smooth"].first
    assert output.fields == ()
    assert "does not hold this message" in output.note
    assert not verified(path, "Nudged", tolerance=1.0).within_tolerance


def test_facts_that_differ_from_the_recording_are_named_with_both_values(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = machine_facts

    def elsewhere(environment: object = None) -> dict[str, dict[str, str]]:
        facts = real({"OMP_NUM_THREADS": "8"})
        facts["machine"]["cpu_features"] = "sse4_2"
        facts["packages"]["numpy"] = "1.0"
        facts["device"]["gpu 0"] = "Imaginary 9000"
        return facts

    monkeypatch.setattr(verification_facts, "machine_facts", elsewhere)

    found = {fact: (then, here) for fact, then, here in verify(recorded, only=["sum"], jobs=1).facts}

    assert found["machine cpu_features"][1] == "sse4_2"
    assert found["packages numpy"][1] == "1.0"
    assert found["device gpu 0"] == ("–", "Imaginary 9000")
    assert found["threads OMP_NUM_THREADS"] == ("1", "8")


def test_the_facts_hold_the_threads_of_the_processes_and_the_gpus_of_the_driver(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dataflow.recording.streams import facts

    with Recording(recorded) as recording:
        assert recording.metadata["threads"]["OMP_NUM_THREADS"] == "1"
        assert set(recording.metadata["machine"]) >= {"cpu", "cpu_features", "python", "os"}
        assert "numpy" in recording.metadata["packages"]
    card = tmp_path / "gpus" / "0000:01:00.0"
    card.mkdir(parents=True)
    (card / "information").write_text("Model: \t\t Imaginary 9000\nIRQ: 7\n")
    (tmp_path / "version").write_text("NVRM version: Driver 1.2.3\nGCC\n")
    assert facts._devices(tmp_path) == {"gpu 0": "Imaginary 9000", "gpu driver": "Driver 1.2.3"}
    assert facts._devices(tmp_path / "absent") == {}
