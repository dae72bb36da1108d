"""The flight recorder: what it keeps is re-executed exactly, and what it takes of the disk is bounded."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from process_doubles import Disk

from dataflow.graph import Graph, load_graph
from dataflow.graph.sections import Flight, Trigger
from dataflow.messages import Diagnostics, FeatureVector
from dataflow.recording import Recording
from dataflow.recording.parts import Storage
from dataflow.records.firing import encode_batch
from dataflow.records.reading import FiringLog
from dataflow.sinks.flight_recorder import FlightSink
from dataflow.sinks.triggers import Triggers
from dataflow.supervision.run import replay, run
from dataflow.verification.verify import verify

pytestmark = pytest.mark.usefixtures("in_process")

RUNTIME = Path(__file__).resolve().parent.parent / "runtime"
SECOND = 1_000_000_000
GRAPH = """
graph: flown
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 600, period: 50000000, ratio: 300}}
  first: {use: runtime_operators:Tuned, inputs: {x: left/fast}}
  second: {use: runtime_operators:Tuned, inputs: {x: first/y}, params: {factor: 0.5}}
  slow: {use: runtime_operators:Tuned, inputs: {x: left/slow}}
record: {keep: 4s, after: 2s, snapshots: 1s}
"""


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Graph:
    sys.path.append(str(RUNTIME))
    path = tmp_path_factory.mktemp("flown") / "flown.yaml"
    path.write_text(GRAPH)
    return load_graph(path)


@pytest.fixture(scope="module")
def recorded(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All of a run of 30 s, of which the flight recorder is to keep a part."""
    path = tmp_path_factory.mktemp("flown") / "run.mcap"
    run(graph, placement="one_process", record=path)
    return path


def flown(
    recorded: Path,
    graph: Graph,
    folder: Path,
    *,
    when: tuple[Trigger, ...] = (),
    asks: Any = (),
    each: Any = lambda stamp: None,
    ahead: int = 0,
    late: int = 0,
    lag: int = 0,
    **more: Any,
) -> Any:
    """Gives a flight recorder what a recorder was given; `asks`: stamps (s) at which it is triggered, by a
    clock that is `ahead` (ns); `late`: by how much firing records are (ns); `lag`: by how much all of the operators is
    behind the sources (ns)."""

    def due(node: str, stamp: int) -> int:
        return stamp if node == "left" or not lag else max(stamp, SECOND) + lag

    flight = replace(graph.record.flight, when=when, **more)
    made = replace(graph, record=replace(graph.record, flight=flight))
    history: list[tuple[int, int]] = []
    asks, clock = sorted(asks), 0
    with Recording(recorded) as recording:
        metadata = {n: dict(v) for n, v in recording.metadata.items() if n not in ("recording", "digests")}
        options = {"metadata": metadata, "compression": "zstd", "overwrite": True, "label": "ring", "settle": 0.0}
        options["storage"] = Storage(on_failure="go_on")
        sink = FlightSink(folder, made, list(made.record.streams), options)
        records = iter(sorted(_records(recording), key=lambda record: due(record.operator, record.stamp)))
        at = next(records, None)
        for found in sorted(recording.messages(), key=lambda m: due(m.stream.split("/")[1], m.stamp)):
            while at is not None and due(at.operator, at.stamp) < due(found.stream.split("/")[1], found.stamp) - late:
                sink.firings(at.operator, [at], encode_batch([at]))
                at = next(records, None)
            each(found.stamp / SECOND)
            sink.message(found.stream, found.message, found.seq, found.incarnation)
            if found.stamp // SECOND != clock:
                clock = found.stamp // SECOND
                sink.flush()
            history.append((sink.ring_bytes, len(list((folder / ".ring").iterdir()))))
            if asks and found.stamp >= asks[0] * SECOND and found.stamp < 10**14:
                asks = asks[1:]
                sink.event("trigger", found.stamp + ahead, {"text": "a test"})
        while at is not None:
            sink.firings(at.operator, [at], encode_batch([at]))
            at = next(records, None)
    return sink, history


def _records(recording: Recording) -> Iterator[Any]:
    log = FiringLog.read(recording)
    return iter(sorted((r for name in log.operators for r in log.of(name)), key=lambda r: r.stamp))


@pytest.mark.long
@pytest.mark.parametrize("asked", [3.0, 12.0, 21.7, 29.5])
def test_kept_flight_recording_verifies_from_its_beginning(
    recorded: Path, graph: Graph, tmp_path: Path, asked: float
) -> None:
    sink, _ = flown(recorded, graph, tmp_path, asks=[asked])
    facts = sink.close("complete")

    assert [one.get("error") for one in facts["kept"]] == [None]
    path = facts["kept"][0]["path"]
    report = verify(Path(path))
    assert {v.operator: v.verdict for v in report.operators} == dict.fromkeys(("first", "second", "slow"), "identical")
    assert report.cut
    assert all(s.whole for s in report.stand_ins)
    assert not [s for s in report.stored if not s.as_recorded or s.missing]
    with Recording(path) as kept:
        stamps = [m.stamp for m in kept.messages(["test/left/fast"])]
        assert max(stamps) >= min(asked + 2, 30.9) * SECOND - 60_000_000
        assert min(stamps) <= max(1.0, asked - 4) * SECOND
        assert json.loads(kept.metadata["dataflow:flight"]["triggers"])[0]["what"] == "a test"
    assert not (tmp_path / ".ring").exists()


def test_kept_flight_recording_replays_from_its_states(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    sink, _ = flown(recorded, graph, tmp_path, asks=[20.0])
    path = Path(sink.close("complete")["kept"][0]["path"])

    replay(path, placement="one_process", record=tmp_path / "again.mcap")

    with Recording(tmp_path / "again.mcap") as again, Recording(recorded) as whole:
        made = {m.stamp: m.message.digest() for m in again.messages(["test/second/y"])}
        was = {m.stamp: m.message.digest() for m in whole.messages(["test/second/y"])}
    assert len(made) > 80
    assert made.items() <= was.items()


def test_a_trigger_of_a_run_that_is_behind_the_clock_keeps_what_it_had_come_to(
    recorded: Path, graph: Graph, tmp_path: Path
) -> None:
    """As of one that is paused, or slower than the clock."""
    sink, _ = flown(recorded, graph, tmp_path, asks=[20.0], ahead=300 * SECOND)
    (one,) = sink.close("complete")["kept"]

    with Recording(one["path"]) as kept:
        stamps = [m.stamp for m in kept.messages(["test/left/fast"])]
    assert min(stamps) <= 16 * SECOND
    assert max(stamps) >= 22 * SECOND - 60_000_000


def test_firing_records_that_are_late_are_waited_for(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    """As of a recorder that is behind, since its disk is slow."""
    sink, _ = flown(recorded, graph, tmp_path, asks=[10.0], late=6 * SECOND)
    (one,) = sink.close("complete")["kept"]

    with Recording(one["path"]) as kept:
        assert max(m.stamp for m in kept.messages(["test/left/fast"])) >= 12 * SECOND - 60_000_000


def test_operators_are_waited_for_of_which_nothing_has_come(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    """As at the beginning of a run, of a recorder that is behind."""
    sink, _ = flown(recorded, graph, tmp_path, asks=[1.5], lag=6 * SECOND)
    (one,) = sink.close("complete")["kept"]

    report = verify(Path(one["path"]))
    assert {v.operator: v.verdict for v in report.operators} == dict.fromkeys(("first", "second", "slow"), "identical")


def test_a_pause_of_the_recorder_is_no_time_in_which_firing_records_would_have_come(
    recorded: Path, graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a stopped container: the clock goes on by 40 s when the span has just ended."""
    now = [0.0]
    monkeypatch.setattr("dataflow.process.awake_clock.time", SimpleNamespace(monotonic=lambda: now[0]))

    def at(stamp: float) -> None:
        now[0] = stamp + 40 * (stamp >= 12.2)

    sink, _ = flown(recorded, graph, tmp_path, asks=[10.0], late=6 * SECOND, each=at)
    (one,) = sink.close("complete")["kept"]

    with Recording(one["path"]) as kept:
        assert max(m.stamp for m in kept.messages(["test/left/fast"])) >= 12 * SECOND - 60_000_000


@pytest.mark.long
def test_the_disk_that_the_ring_takes_does_not_grow_with_the_run(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    sink, history = flown(recorded, graph, tmp_path)
    sink.close("complete")

    half = len(history) // 2
    longest = 4 + 2 * 1 + 2 * 1 + 3 + 8  # s: kept, needed for it, files at both ends of 1 s each, waiting to be deleted
    assert max(files for _, files in history) <= longest
    assert max(size for size, _ in history[half:]) <= 1.1 * max(size for size, _ in history[:half])
    assert not list(tmp_path.glob("*.mcap"))  # nobody asked


@pytest.mark.long
def test_the_ring_keeps_less_time_where_it_may_take_less_of_the_disk(
    recorded: Path, graph: Graph, tmp_path: Path
) -> None:
    _, history = flown(recorded, graph, tmp_path / "a")
    most = max(size for size, _ in history) // 2
    sink, bounded = flown(recorded, graph, tmp_path / "b", disk=most, asks=[20.0])
    (one,) = sink.close("complete")["kept"]

    assert max(size for size, _ in bounded) < 1.5 * most
    assert not verify(Path(one["path"])).culprits


@pytest.mark.long
def test_no_more_is_kept_than_the_graph_allows(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    sink, _ = flown(recorded, graph, tmp_path, asks=[4.0, 12.0, 20.0, 25.0], files=2)
    facts = sink.close("complete")

    assert len(list(tmp_path.glob("*.mcap"))) == len(facts["kept"]) == 2
    assert facts["not_kept"] == 2


@pytest.mark.long
def test_triggers_that_come_together_keep_one_recording(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    sink, _ = flown(recorded, graph, tmp_path, asks=[12.0, 13.0])
    (one,) = sink.close("complete")["kept"]

    assert len(one["reasons"]) == 2
    with Recording(one["path"]) as kept:
        assert max(m.stamp for m in kept.messages(["test/left/fast"])) >= 14.9 * SECOND


@pytest.mark.long
def test_a_field_of_a_stream_triggers_once_while_it_holds(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    above = Trigger("field", stream="test/left/fast", field="vectors", above=250.0)
    sink, _ = flown(recorded, graph, tmp_path, when=(above,))
    (one,) = sink.close("complete")["kept"]

    assert one["reasons"] == [
        {"what": "test/left/fast vectors above 250", "stream": "test/left/fast", "stamp": SECOND + 251 * 50_000_000}
    ]


def test_a_run_that_fails_keeps_its_end(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    sink, _ = flown(recorded, graph, tmp_path, when=(Trigger("raise"),))
    (one,) = sink.close("failed: operator 'second' failed in firing 3: boom")["kept"]

    assert "boom" in one["reasons"][0]["what"]
    assert not verify(Path(one["path"])).culprits


def test_drops_trigger_above_their_rate_by_operator() -> None:
    triggers = Triggers([Trigger("drops", above=5.0), Trigger("drops", operator="slow", above=1.0)])

    def fares(**rates: float) -> Diagnostics:
        return Diagnostics(
            stamp=1,
            names=tuple(rates),
            messages=("",) * len(rates),
            keys=("drop_rate_hz",) * len(rates),
            values=tuple(str(rate) for rate in rates.values()),
            levels=np.zeros(len(rates), np.uint8),
            owners=np.arange(len(rates), dtype=np.int32),
        )

    assert not list(triggers.diagnostics(fares(slow=0.5, fast=5.0)))
    assert [r["operator"] for r in triggers.diagnostics(fares(slow=2.0, fast=6.0))] == ["fast", "slow"]
    assert not list(triggers.diagnostics(fares(slow=2.0, fast=6.0)))  # they go on


@pytest.mark.parametrize(
    ("trigger", "values", "expected"),
    [
        (Trigger("field", stream="s", field="vectors", below=0.0), [[1.0, -1.0]], 1),
        (Trigger("field", stream="s", field="vectors", above=2.0), [[1.0, 1.5]], 0),
        (Trigger("field", stream="s", field="model", equals="m"), [[1.0]], 1),
        (Trigger("field", stream="s", field="nothing", above=1.0), [[5.0]], 0),
        (Trigger("field", stream="other", field="vectors", above=1.0), [[5.0]], 0),
    ],
)
def test_a_field_or_any_of_its_elements_meets_a_condition(trigger: Trigger, values: Any, expected: int) -> None:
    message = FeatureVector(stamp=1, vectors=values, model="m")
    assert len(list(Triggers([trigger]).message("s", message))) == expected


def test_flight_recorder_settings_are_read_from_the_graph(tmp_path: Path) -> None:
    sys.path.append(str(RUNTIME))
    text = GRAPH.replace(
        "record: {keep: 4s, after: 2s, snapshots: 1s}",
        "record:\n  keep: 60s\n  folder: kept\n  when:\n    - raise\n    - {drops: 5, operator: first}\n"
        "    - {stream: left/fast, field: vectors, above: 3}\n",
    )
    (tmp_path / "a.yaml").write_text(text)
    record = load_graph(tmp_path / "a.yaml").record

    assert record.snapshots == 10 * SECOND
    assert record.flight == Flight(
        60 * SECOND,
        10 * SECOND,
        (
            Trigger("raise"),
            Trigger("drops", operator="first", above=5.0),
            Trigger("field", stream="test/left/fast", field="vectors", above=3.0),
        ),
        "kept",
    )
    loaded = load_graph(tmp_path / "a.yaml")
    assert Graph.from_json(json.loads(json.dumps(loaded.to_json()))).record == record


@pytest.mark.parametrize(
    ("said", "fault"),
    [
        ("{after: 2s}", "say how much it keeps"),
        ("{keep: 4s, when: [raises]}", "when must be"),
        ("{keep: 4s, when: [{drops: many}]}", "drops must be a number"),
        ("{keep: 4s, when: [{drops: 1, operator: frist}]}", "no operator 'frist'"),
        ("{keep: 4s, when: [{stream: left/fast}]}", "when must be"),
        ("{keep: 4s, when: [{stream: left/fats, field: vectors, above: 1}]}", "left/fats"),
        ("{keep: 0s}", "more than 0"),
        ("{keep: 4s, snapshots: cpu}", "a flight recorder needs a duration"),
    ],
)
def test_a_flight_recorder_that_cannot_be_is_refused_where_it_stands(tmp_path: Path, said: str, fault: str) -> None:
    from dataflow.graph import GraphError

    sys.path.append(str(RUNTIME))
    (tmp_path / "a.yaml").write_text(GRAPH.replace("{keep: 4s, after: 2s, snapshots: 1s}", said))
    with pytest.raises(GraphError, match=fault):
        load_graph(tmp_path / "a.yaml")


@pytest.mark.long
def test_a_full_disk_is_outlived_and_what_comes_after_is_kept(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk, capsys: pytest.CaptureFixture[str]
) -> None:
    def at(stamp: float) -> None:
        disk.full = 10 <= stamp < 14

    sink, _ = flown(recorded, graph, tmp_path, asks=[25.0], each=at)
    facts = sink.close("complete")

    said = capsys.readouterr().out
    assert "flight recorder: stops, the run goes on" in said
    assert "flight recorder: goes on" in said
    assert facts["lost"]["streams"]["test/left/fast"] == pytest.approx(4 * 20, abs=25)
    path = Path(facts["kept"][0]["path"])
    assert facts["messages"] == facts["kept"][0]["messages"] > 100
    assert {v.operator: v.verdict for v in verify(path).operators} == dict.fromkeys(
        ("first", "second", "slow"), "identical"
    )
    assert path.stat().st_mode & 0o777 == 0o600


def test_calls_whose_records_find_no_room_are_lost(recorded: Path, graph: Graph, tmp_path: Path, disk: Disk) -> None:
    """Those that the ring had taken and not given to the disk, too: each message is made by one."""
    sink, _ = flown(recorded, graph, tmp_path, each=lambda stamp: setattr(disk, "full", stamp > 29.5))
    lost = sink.close("complete")["lost"]

    assert lost["firings"] >= lost["messages"] > 60


def test_a_file_whose_end_finds_no_room_is_followed_by_one_when_there_is_room(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where there would be room for the few bytes of a beginning: the span that is lost is told to its end."""
    sink, _ = flown(recorded, graph, tmp_path)
    assert sink._sink is not None
    end = sink._sink.close

    def refused(outcome: str) -> None:
        disk.full = True
        try:
            end(outcome)
        finally:
            disk.full = False

    sink._sink.close = refused
    sink._rotate()
    assert "flight recorder: stops" in capsys.readouterr().out
    sink.flush()
    assert "flight recorder: goes on" in capsys.readouterr().out

    ((_, until),) = sink.close("complete")["lost"]["spans"]
    assert until is not None


def test_tries_that_failed_leave_nothing_on_a_full_disk(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk
) -> None:
    sink, _ = flown(recorded, graph, tmp_path)
    disk.full = True
    for _ in range(3):
        sink.flush()

    assert sorted((tmp_path / ".ring").iterdir()) == [segment.path for segment in sink._segments]
    sink.close("complete")


def test_a_restart_is_kept_with_the_line_and_the_traceback_of_its_failure() -> None:
    failed = {"text": "operator 'a' failed", "operators": ["a"], "where": "crashy.py:12", "traceback": "Traceback …"}
    triggers = Triggers([Trigger("raise")])

    assert list(triggers.event("restart", failed)) == [
        {"what": "operator 'a' failed", "operators": ["a"], "where": "crashy.py:12", "traceback": "Traceback …"}
    ]
    killed = {"text": "process 'a' was killed", "operators": ["a"]}
    assert list(triggers.event("restart", killed)) == [{"what": "process 'a' was killed", "operators": ["a"]}]
