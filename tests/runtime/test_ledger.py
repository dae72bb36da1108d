"""What a recording cannot account for is never called identical: records that are lost, cuts, streams with holes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dataflow.graph import Graph, load_graph
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.layout import OUTCOME, RESERVED_METADATA
from dataflow.records.comparison import Verification
from dataflow.records.firing import FiringRecord, Kind, consecutive, encode_batch
from dataflow.records.reading import FiringLog, recorded_firings
from dataflow.reexecution.recorded_run import ReplayError, recorded_graph
from dataflow.supervision.run import run
from dataflow.verification.complete import complete
from dataflow.verification.ledger import read_ledger
from dataflow.verification.record_totals import GraphRecordTotals
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify

pytestmark = pytest.mark.usefixtures("in_process")

HERE = Path(__file__).resolve().parent


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ledger") / "run.mcap"
    run(load_graph(HERE / "mixed.yaml", settings=["count=60"]), placement="one_process", record=path)
    return path


def rewritten(
    path: Path,
    out: Path,
    *,
    records: Callable[[FiringRecord], bool] = lambda record: True,
    stored: Callable[[str, int], bool] = lambda stream, seq: True,
    outcome: str | None = None,
) -> Path:
    """A recording without some of its firing records, or of its messages (stream, number), or with another outcome."""
    with Recording(path) as recording:
        metadata = {n: dict(v) for n, v in recording.metadata.items() if n not in RESERVED_METADATA}
        if outcome is not None:
            metadata[OUTCOME] = {"outcome": outcome}
        with RecordingWriter(out, metadata=metadata, namespace="test") as writer:
            for name, info in recording.streams.items():
                if "/@/" in name or not any(stored(name, m.seq) for m in recording.messages([name])):
                    continue
                assert info.message_type is not None
                extra = {key: info.metadata[key] for key in ("operator", "port") if key in info.metadata}
                writer.add_stream(name, info.message_type, static=info.static, extra=extra)
                for m in recording.messages([name]):
                    if stored(name, m.seq):
                        writer.write(name, m.message, seq=m.seq, incarnation=m.incarnation)
            for operator in ("left", "right", "mix", "smooth", "merge", "sum"):
                for batch in consecutive(r for r in recorded_firings(recording, operator) if records(r)):
                    writer.write_firings(operator, max(batch[-1].stamp, 1), encode_batch(batch))
    return out


def early(operator: str, index: int) -> Callable[[FiringRecord], bool]:
    """The records of an operator before `index`, and all of the others."""
    return lambda record: record.operator != operator or record.index < index


def of(report: VerifyReport, operator: str) -> Verification:
    return next(v for v in report.operators if v.operator == operator)


@pytest.mark.long
def test_a_rewritten_recording_is_as_good_as_the_one_it_was(recorded: Path, tmp_path: Path) -> None:
    assert verify(rewritten(recorded, tmp_path / "same.mcap"), jobs=1).identical


@pytest.mark.parametrize("thin", [False, True])
def test_messages_that_no_record_made_show_that_the_last_records_are_lost(
    recorded: Path, tmp_path: Path, thin: bool
) -> None:
    sources = ("test/left/", "test/right/")
    path = rewritten(
        recorded,
        tmp_path / "tail.mcap",
        records=early("smooth", 10),
        stored=lambda stream, seq: not thin or stream.startswith(sources),
    )

    report = verify(path, jobs=1, only=None if thin else ["smooth"])

    smooth = of(report, "smooth")
    assert not report.identical
    assert smooth.verdict == "unverifiable"
    assert smooth.unaccounted > 20
    assert smooth.verified == 9  # the first record is that of setup()


def test_a_sink_whose_last_records_are_lost_is_not_identical(recorded: Path, tmp_path: Path) -> None:
    report = verify(rewritten(recorded, tmp_path / "sink.mcap", records=early("sum", 10)), only=["sum"])

    assert of(report, "sum").verdict == "unverifiable"
    assert of(report, "sum").unfinished


def test_up_to_a_cut_a_failed_run_can_be_verified_but_is_not_identical(recorded: Path, tmp_path: Path) -> None:
    failed = rewritten(recorded, tmp_path / "failed.mcap", records=early("smooth", 10), outcome="failed: on fire")

    report = verify(failed, only=["smooth"])

    smooth = of(report, "smooth")
    assert smooth.verdict == "identical"
    assert smooth.cut
    assert smooth.after_cut > 20
    assert report.cut
    assert not report.identical


def test_an_operator_of_which_nothing_lies_before_the_cut_is_not_verified(recorded: Path, tmp_path: Path) -> None:
    failed = rewritten(recorded, tmp_path / "failed.mcap", records=early("smooth", 1), outcome="failed: on fire")

    assert of(verify(failed, only=["smooth"]), "smooth").verdict == "unverifiable"


def test_firings_needing_messages_after_the_cut_are_counted_apart(recorded: Path, tmp_path: Path) -> None:
    half = rewritten(
        recorded,
        tmp_path / "half.mcap",
        records=lambda r: (r.operator != "mix" or r.index < 20) and r.kind != "finish",
        stored=lambda stream, seq: stream != "test/mix/mixed" or seq < 15,
        outcome="failed: on fire",
    )

    smooth = of(verify(half, only=["smooth"]), "smooth")

    assert smooth.verdict == "identical"
    assert smooth.verified > 10
    assert smooth.unverifiable == smooth.beyond > 20


def test_a_hole_before_the_cut_is_no_cut(recorded: Path, tmp_path: Path) -> None:
    hole = rewritten(
        recorded,
        tmp_path / "hole.mcap",
        records=lambda r: r.kind != "finish",
        stored=lambda stream, seq: stream != "test/left/fast" or seq != 15,
        outcome="failed: on fire",
    )

    mix = of(verify(hole, only=["mix"]), "mix")

    assert mix.verdict == "unverifiable"
    assert mix.missing == "test/left/fast #15"


def test_made_messages_that_the_recording_lacks_are_counted(recorded: Path, tmp_path: Path) -> None:
    path = rewritten(recorded, tmp_path / "gap.mcap", stored=lambda s, seq: s != "test/smooth/mean" or seq % 10 != 3)

    report = verify(path, only=["smooth"])

    assert report.identical
    assert of(report, "smooth").not_stored > 3


def test_completing_keeps_messages_that_cannot_be_recomputed(recorded: Path, tmp_path: Path) -> None:
    path = rewritten(recorded, tmp_path / "tail.mcap", records=early("merge", 10))

    made = complete(path, tmp_path / "whole.mcap")

    assert made.stored
    assert not made.whole
    assert made.kept > 20
    with Recording(recorded) as before, Recording(made.path) as after:
        assert after.digests(["test/merge/seen"]) == before.digests(["test/merge/seen"])


def test_sink_is_compared_by_its_summary(recorded: Path) -> None:
    graph = load_graph(HERE / "mixed.yaml", settings=["count=60"])
    merge = replace(graph.nodes["merge"], use="verified_operators:MergeDoubled")
    total = replace(graph.nodes["sum"], use="verified_operators:SumHalved")

    changed = verify(recorded, graph=replace(graph, nodes={**graph.nodes, "sum": total}))
    fed = verify(recorded, graph=replace(graph, nodes={**graph.nodes, "merge": merge}))

    assert changed.culprits == ("sum",)
    first = of(changed, "sum").first
    assert first is not None
    assert first.kind == "finish"
    assert first.expected.startswith("summary total: ")
    assert fed.culprits == ("merge",)
    assert of(fed, "sum").verdict == "identical"  # given the recorded inputs


@pytest.mark.parametrize(
    ("more", "finished"),
    [(((1, 0, "setup"),), True), (((0, 99, "param"),), True), (((1, 0, "setup"), (1, 1, "fire")), False)],
)
def test_finished_operator_needs_another_end_only_if_called_again(
    recorded: Path, more: tuple[tuple[int, int, Kind], ...], finished: bool
) -> None:
    """A parameter may change, and its process be restarted, while others are still at work."""
    with Recording(recorded) as recording:
        graph = recorded_graph(recording)
        known = FiringLog.read(recording)
        batches = {name: list(known.batches(name)) for name in known.operators}
        batches["sum"] += [encode_batch([FiringRecord("sum", *place, kind, 10**10)]) for *place, kind in more]
        account = read_ledger(recording, graph, GraphRecordTotals(FiringLog(batches, "test"), graph), ["sum"]).accounts[
            "sum"
        ]
    assert account.finished is finished


def breaking(folder: Path, use: str, how: str) -> Graph:
    """A live graph with an operator that fails once, `how`, and is started again."""
    file = folder / f"{use.rpartition(':')[2]}.yaml"
    file.write_text(
        "graph: errors\nnamespace: test\noperators:\n"
        "  left: {use: runtime_operators:Counter, params: {count: 40, period: 2000000}}\n"
        f"  broken: {{use: {use}, params: {{how: {how}}}, inputs: {{x: left/fast}}, "
        "live: {queue: block, restart: {max: 3}}}\n"
    )
    return load_graph(file, live=True)


@pytest.mark.long
@pytest.mark.parametrize("how", ["raise", "exit", "stamp"])
def test_a_recorded_error_is_repeated_whatever_was_raised(tmp_path: Path, how: str) -> None:
    path = tmp_path / "run.mcap"
    run(breaking(tmp_path, "runtime_operators:Broken", how), live=True, record=path)

    again = verify(path)
    other = verify(path, graph=breaking(tmp_path, "verified_operators:BrokenOtherwise", how))

    with Recording(path) as recording:
        assert sum(r.outcome == "error" for r in recorded_firings(recording, "broken")) == 1
    assert again.identical, again.as_json()
    assert other.culprits == ("broken",)
    first = of(other, "broken").first
    assert first is not None
    assert first.expected.startswith("error: ")
    assert first.got == "error: KeyError: 'gripper'"


def test_an_operator_with_other_ports_than_recorded_is_named(recorded: Path) -> None:
    graph = load_graph(HERE / "mixed.yaml", settings=["count=60"])
    smooth = graph.nodes["smooth"]
    more = replace(smooth, outputs={**smooth.outputs, "extra": "test/smooth/extra"})

    with pytest.raises(ReplayError, match="'smooth' was recorded with 1 output ports and has 2 now"):
        verify(recorded, graph=replace(graph, nodes={**graph.nodes, "smooth": more}))


def test_unrecorded_inputs_of_an_operator_are_recomputed(recorded: Path, tmp_path: Path) -> None:
    path = rewritten(recorded, tmp_path / "thin.mcap", stored=lambda stream, seq: stream != "test/mix/mixed")

    report = verify(path, only=["smooth"])

    assert report.identical
    assert {v.operator for v in report.operators} == {"mix", "smooth"}


def test_within_tolerance_no_operator_is_blamed_for_another_input(recorded: Path, tmp_path: Path) -> None:
    sensors = ("test/left/", "test/right/")
    thin = rewritten(recorded, tmp_path / "thin.mcap", stored=lambda stream, seq: stream.startswith(sensors))
    graph = load_graph(HERE / "mixed.yaml", settings=["count=60"])
    merge = replace(graph.nodes["merge"], use="verified_operators:MergeDoubled")

    report = verify(thin, graph=replace(graph, nodes={**graph.nodes, "merge": merge}), tolerance=1e-9)

    assert report.culprits == ("merge",)
    assert report.verdict(of(report, "sum")) == "downstream"
