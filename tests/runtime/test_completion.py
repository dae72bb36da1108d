"""A thin recording of a live run is completed to what a full recording of that run holds, or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dataflow.graph import Graph, load_graph, load_text
from dataflow.recording import LogLine, Recording, RecordingWriter
from dataflow.recording.layout import RESERVED_METADATA
from dataflow.recording.streams.diff import diff
from dataflow.records.firing import decode_batch
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.run import replay as replay_recording
from dataflow.supervision.run import run
from dataflow.verification.complete import complete
from dataflow.verification.verify import verify

HERE = Path(__file__).resolve().parent
SENSORS = tuple(f"test/{source}/{port}" for source in ("left", "right") for port in ("fast", "slow", "constant"))


def thin(
    full: Path, out: Path, *, streams: tuple[str, ...] = SENSORS, keep: float = 1.0, logs: tuple[LogLine, ...] = ()
) -> Path:
    """Only those streams of a recording, its firing records and metadata. `keep`: how much of each stream; `logs`:
    lines at its first stamp."""
    with Recording(full) as recording:
        metadata = {n: dict(v) for n, v in recording.metadata.items() if n not in RESERVED_METADATA}
        with RecordingWriter(out, metadata=metadata, namespace="test") as writer:
            runs_own = [s for s in recording.streams if "/@/" in s]
            for stream in (*streams, *runs_own):
                info = recording.streams[stream]
                assert info.message_type is not None
                extra = {name: info.metadata[name] for name in ("operator", "port") if name in info.metadata}
                writer.add_stream(stream, info.message_type, static=info.static, extra=extra)
                for m in list(recording.messages([stream]))[: round(keep * info.count)]:
                    writer.write(stream, m.message, seq=m.seq, incarnation=m.incarnation)
            for operator, payload in recording.firings():
                writer.write_firings(operator, decode_batch(payload).records[-1].stamp, payload)
            first = min(s.first for s in recording.streams.values() if s.first)
            for line in logs:
                writer.write_log(first, line)
    return out


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A full recording of a live run with drops and timeouts."""
    path = tmp_path_factory.mktemp("live") / "full.mcap"
    report = run(load_graph(HERE / "live.yaml", live=True), live=True, placement="one_process", record=path)
    assert report.drops
    return path


@pytest.mark.long
def test_the_completed_recording_of_a_live_run_is_equal_to_the_full_one_and_verified(
    live: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"

    made = complete(thin(live, tmp_path / "thin.mcap"), out)

    assert made.whole
    assert set(made.added) == {"test/mix/mixed", "test/slow/mean", "test/smooth/mean", "test/merge/seen"}
    with Recording(live) as a, Recording(out) as b:
        assert diff(a, b).same
        assert list(a.firings()) == list(b.firings())
        assert a.metadata["dataflow:graph"] == b.metadata["dataflow:graph"]
        assert a.metadata["dataflow:outcome"] == b.metadata["dataflow:outcome"]
        assert b.metadata["dataflow:completed"]["from"] == "thin.mcap"
    verified = verify(out, jobs=1)
    assert verified.identical
    assert verify(out, only=["smooth"], jobs=1).identical  # its input stands in from the new file
    assert [p.name for p in tmp_path.iterdir() if p.name.endswith(".part")] == []


@pytest.mark.long
def test_recording_of_sensors_only_can_be_completed(tmp_path: Path) -> None:
    graph = _recording_sensors_only(load_graph(HERE / "mixed.yaml", settings=["count=40"]))
    path, out = tmp_path / "thin.mcap", tmp_path / "out.mcap"
    full = run(graph, placement="one_process", record=path)
    with Recording(path) as recording:
        assert set(recording.streams) == set(SENSORS)

    assert complete(path, out).whole

    with Recording(out) as recording:
        assert recording.digests() == full.digests()
    assert replay_recording(out, placement="one_process").digests() == full.digests()


def test_acting_operator_is_not_needed_to_complete_a_recording(tmp_path: Path) -> None:
    """It does not act again, so what it alone took may be missing."""
    graph = load_text("""
graph: acting
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 10}}
  act: {use: runtime_operators:Act, inputs: {x: left/fast}}
  sum: {use: runtime_operators:Sum, inputs: {x: left/slow}}
record: {exclude: [left/fast]}
""")
    path, out = tmp_path / "thin.mcap", tmp_path / "out.mcap"
    run(graph, placement="one_process", record=path)

    assert complete(path, out).whole

    with Recording(path) as a, Recording(out) as b:
        assert diff(a, b).same


def _recording_sensors_only(graph: Graph) -> Graph:
    return replace(graph, record=replace(graph.record, streams=SENSORS))


@pytest.mark.long
def test_changed_code_completes_nothing_and_names_the_operator(live: Path, tmp_path: Path) -> None:
    graph = load_graph(HERE / "live.yaml", live=True)
    smooth = graph.nodes["smooth"]
    changed = replace(graph, nodes={**graph.nodes, "smooth": replace(smooth, use="runtime_operators:SmoothChanged")})
    out = tmp_path / "out.mcap"

    made = complete(thin(live, tmp_path / "thin.mcap"), out, graph=changed)

    assert not made.stored
    [culprit] = [v for v in made.operators if v.verdict == "culprit"]
    assert culprit.operator == "smooth"
    assert culprit.first is not None
    assert culprit.first.port == "mean"
    assert list(tmp_path.iterdir()) == [tmp_path / "thin.mcap"]


def test_lines_of_the_log_that_came_in_one_call_are_taken_over(live: Path, tmp_path: Path) -> None:
    lines = (LogLine("info", "one", operator="smooth"), LogLine("warning", "two", operator="smooth"))

    made = complete(thin(live, tmp_path / "thin.mcap", logs=lines), tmp_path / "out.mcap")

    assert made.whole
    with Recording(tmp_path / "thin.mcap") as a, Recording(tmp_path / "out.mcap") as b:
        assert [line.text for _, line in b.logs()] == ["one", "two"]
        assert list(a.logs()) == list(b.logs())


def test_unavailable_streams_are_not_completed(live: Path, tmp_path: Path) -> None:
    short = thin(live, tmp_path / "short.mcap", keep=0.5)

    made = complete(short, tmp_path / "out.mcap")

    assert made.stored
    assert not made.whole
    assert {v.verdict for v in made.operators} == {"unverifiable"}
    with pytest.raises(ReplayError, match="no stream of 'right' is in the recording"):
        complete(thin(live, tmp_path / "left.mcap", streams=SENSORS[:3]), tmp_path / "other.mcap")
