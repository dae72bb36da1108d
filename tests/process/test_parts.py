"""The recorder of a run: parts that join into the whole again, a disk that is full for a while, and who may read."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from process_doubles import Disk

from dataflow.editing.merge import merge
from dataflow.graph import Graph, load_graph
from dataflow.messages import FeatureVector
from dataflow.recording import Recording, RecordingError
from dataflow.recording.parts import Splitting, Storage, parts_of
from dataflow.recording.streams.copying import Origin
from dataflow.records.firing import CALLS, encode_batch
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.sinks.parts import PartsSink
from dataflow.supervision.run import run
from dataflow.verification.verify import verify
from dataflow.video.decoder import PacketDecoder

pytestmark = pytest.mark.usefixtures("in_process")

RUNTIME = Path(__file__).resolve().parent.parent / "runtime"
SECOND = 1_000_000_000
GRAPH = """
graph: parted
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 200, period: 50000000, ratio: 20, padding: 200}}
  first: {use: runtime_operators:Tuned, inputs: {x: left/fast}}
  second: {use: runtime_operators:Tuned, inputs: {x: first/y}, params: {factor: 0.5}}
record: {snapshots: 1s}
"""
GO_ON = Storage(on_failure="go_on")


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Graph:
    sys.path.append(str(RUNTIME))
    path = tmp_path_factory.mktemp("parted") / "parted.yaml"
    path.write_text(GRAPH)
    return load_graph(path)


@pytest.fixture(scope="module")
def recorded(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 10 s in one file."""
    path = tmp_path_factory.mktemp("parted") / "run.mcap"
    run(graph, placement="one_process", record=path)
    return path


class Given:
    """A recorder that is given what another one was: records `late` seconds after their calls, a flush each second."""

    def __init__(
        self, recorded: Path, graph: Graph, out: Path, storage: Storage, *, late: float = 0.25, behind: float = 0.0
    ) -> None:
        """`behind`: seconds by which the messages of `second` come behind those of the same stamp."""
        self.recorded, self.late, self.behind = recorded, round(late * SECOND), round(behind * SECOND)
        with Recording(recorded) as recording:
            about = {n: dict(v) for n, v in recording.metadata.items() if n not in ("recording", "digests")}
        options = {"metadata": about, "compression": "zstd", "overwrite": False, "storage": storage}
        self.sink = PartsSink(out, graph, list(graph.record.streams), options)

    def all(self, at: Callable[[float], None] = lambda _: None) -> dict[str, Any]:
        """Gives everything; `at` is called with the seconds since the beginning before each message."""
        sink, flushed = self.sink, 0
        with Recording(self.recorded) as recording:
            records = _records(recording)
            record = next(records, None)
            for found in sorted(recording.messages(), key=lambda m: m.stamp + self.behind * ("/second/" in m.stream)):
                while record is not None and record.stamp < found.stamp - self.late:
                    sink.firings(record.operator, [record], encode_batch([record]))
                    record = next(records, None)
                if found.stamp > SECOND:
                    at(found.stamp / SECOND - 1)
                sink.message(found.stream, found.message, found.seq, found.incarnation)
                if found.stamp // SECOND > flushed:
                    flushed = found.stamp // SECOND
                    sink.flush()
            while record is not None:
                sink.firings(record.operator, [record], encode_batch([record]))
                record = next(records, None)
        return dict(sink.close("complete"))


def _records(recording: Recording) -> Iterator[Any]:
    log = FiringLog.read(recording)
    return iter(sorted((r for name in log.operators for r in log.of(name)), key=lambda r: r.stamp))


def joined(files: list[Path], out: Path) -> Path:
    with ExitStack() as stack:
        merge([stack.enter_context(Origin(file)) for file in files], out)
    return out


def verdicts(path: Path) -> dict[str, str]:
    return {v.operator: v.verdict for v in verify(path, jobs=1).operators}


IDENTICAL = {"first": "identical", "second": "identical"}


@pytest.mark.long
@pytest.mark.parametrize(
    "splitting", [Splitting(every=2 * SECOND), Splitting(size=20_000), Splitting(size=20_000, every=SECOND)]
)
def test_parts_are_verified_each_and_join_into_the_whole(
    recorded: Path, graph: Graph, tmp_path: Path, splitting: Splitting
) -> None:
    facts = Given(recorded, graph, tmp_path / "run.mcap", Storage(splitting)).all()

    parts = parts_of(tmp_path / "run.mcap")
    assert len(parts) >= 4
    assert facts["parts"] == [str(part) for part in parts]
    assert "lost" not in facts
    whole = joined(parts, tmp_path / "whole.mcap")
    with Recording(recorded) as was, Recording(whole) as again:
        assert again.digests() == was.digests()
        assert facts["messages"] == sum(info.count for info in was.streams.values())
    assert verdicts(whole) == IDENTICAL
    assert not verify(whole, jobs=1).cut
    for part in parts:
        assert set(verdicts(part).values()) <= {"identical", "unverifiable"}, part


def test_a_part_begins_with_one_write_behind_its_header(
    graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a disk that takes a tenth of a second for each, a recorder in parts is then not held up for seconds."""
    real, writes = os.write, list[int]()

    def write(fd: int, data: Any) -> int:
        writes.append(len(data))
        return real(fd, data)

    monkeypatch.setattr(os, "write", write)
    options = {"metadata": {"graph": {"text": GRAPH}}, "compression": "zstd", "overwrite": False, "storage": GO_ON}

    sink = PartsSink(tmp_path / "run.mcap", graph, list(graph.record.streams), options)

    assert len(writes) == 2
    assert sink.size == sum(writes)
    sink.close("complete")


@pytest.mark.parametrize("what", ["header", "static message", "state"])
def test_a_limit_below_what_each_part_begins_with_does_not_begin_one_with_each_message(
    what: str, recorded: Path, graph: Graph, tmp_path: Path
) -> None:
    """Such as a map that is larger than a part may be: the disk would be given little else."""
    large = np.random.default_rng(1).random((1, 2_000), np.float32)
    sink = Given(recorded, graph, tmp_path / "run.mcap", Storage(Splitting(size=2_000))).sink
    with Recording(recorded) as recording:
        found = [*recording.messages(["test/left/fast"])]
        setup, *records = FiringLog.read(recording).of("first")
    if what == "static message":
        sink.message("test/left/constant", FeatureVector(stamp=0, vectors=large, model="test"), 0, 0)
    if what == "state":
        snapshot = replace(setup, kind="snapshot", index=1, detail={"state": large.tobytes()})
        sink.firings("first", [setup, snapshot], encode_batch([setup, snapshot]))
        records = [replace(record, index=record.index + 1) for record in records]
    for each, record in zip(found, records, strict=False):
        sink.message(each.stream, each.message, each.seq, each.incarnation)
        sink.firings("first", [record], encode_batch([record]))
        sink.flush()
    parts = sink.close("complete")["parts"]

    assert 2 <= len(parts) <= len(found) // 10
    assert what == "header" or min(Path(part).stat().st_size for part in parts[:-1]) > 2 * large.nbytes


def test_the_newest_part_stays_however_large_it_is(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    facts = Given(recorded, graph, tmp_path / "run.mcap", Storage(Splitting(every=6 * SECOND), keep=1000)).all()

    assert facts["deleted"] == 1
    assert facts["parts"] == [str(part) for part in parts_of(tmp_path / "run.mcap")] == [str(tmp_path / "run_001.mcap")]


def test_a_part_that_is_stored_does_not_give_way_to_one_that_holds_nothing_yet(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk
) -> None:
    """What stands in for the calls before may take more than all parts may, and the run may end before a message."""
    sink = Given(recorded, graph, tmp_path / "run.mcap", replace(GO_ON, keep=2_000)).sink
    with Recording(recorded) as recording:
        messages = [m for m in recording.messages() if m.stamp <= 2 * SECOND]
    for found in messages:
        sink.message(found.stream, found.message, found.seq, found.incarnation)
    sink.flush()
    disk.full = True
    sink.message(messages[-1].stream, messages[-1].message.replace(stamp=3 * SECOND), 999, 0)
    sink.flush()
    disk.full = False
    sink.flush()
    facts = sink.close("complete")

    assert facts["parts"] == [str(tmp_path / "run.mcap")]
    assert facts["messages"] == len(messages)


def test_a_part_that_holds_firing_records_alone_is_kept(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk
) -> None:
    """As one may that begins after a full disk, of a recording of few streams."""
    given = Given(recorded, graph, tmp_path / "run.mcap", GO_ON)
    with Recording(recorded) as recording:
        records = [r for r in _records(recording) if r.kind in CALLS]
    for number, record in enumerate(records):
        if number == len(records) // 2:
            disk.full = True
            given.sink.flush()
            disk.full = False
            given.sink.flush()
        given.sink.firings(record.operator, [record], encode_batch([record]))
    facts = given.sink.close("complete")

    stored = 0
    for part in facts["parts"]:
        with Recording(Path(part)) as recording:
            log = FiringLog.read(recording)
            stored += sum(r.kind in CALLS for name in log.operators for r in log.of(name))
    assert stored + facts["lost"]["firings"] == len(records)
    assert stored >= len(records) // 2


def test_a_recording_of_firing_records_alone_is_split(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    options = {"metadata": {}, "compression": "zstd", "overwrite": False, "storage": Storage(Splitting(every=SECOND))}
    sink = PartsSink(tmp_path / "run.mcap", graph, [], options)
    with Recording(recorded) as recording:
        for record in _records(recording):
            sink.firings(record.operator, [record], encode_batch([record]))
    facts = sink.close("complete")

    assert len(facts["parts"]) >= 9


def test_a_part_without_calls_of_an_operator_is_verified(
    recorded: Path, graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of an operator that fires rarely: what stands in for its calls before is in each part."""
    given = Given(recorded, graph, tmp_path / "run.mcap", Storage(Splitting(every=2 * SECOND)))
    take = given.sink.firings

    def without(operator: str, records: Any, payload: bytes) -> None:
        if operator != "second" or records[0].stamp < 4 * SECOND:
            take(operator, records, payload)

    monkeypatch.setattr(given.sink, "firings", without)
    given.all()

    parts = parts_of(tmp_path / "run.mcap")
    assert len(parts) == 5
    assert [sorted(verdicts(part)) for part in parts] == [["first", "second"]] * 5


@pytest.mark.parametrize("first", ["message", "record"])
def test_nothing_that_follows_a_jump_of_the_clock_is_in_the_part_before(
    first: str, recorded: Path, graph: Graph, tmp_path: Path
) -> None:
    """Stamps that come again belong behind what was given before them, also while the part before is still open."""
    given = Given(recorded, graph, tmp_path / "run.mcap", Storage(Splitting(every=5 * SECOND)))
    with Recording(recorded) as recording:
        messages = [m for m in recording.messages() if m.message.stamp]
        records = list(_records(recording))
    begin = messages[0].stamp

    def give(start: float, end: float, life: int) -> None:
        for found in messages:
            if start <= (found.stamp - begin) / SECOND < end:
                calls = [replace(r, incarnation=life) for r in records if r.stamp == found.stamp and r.kind in CALLS]
                acts = [lambda m=found: given.sink.message(m.stream, m.message, m.seq, life)]
                acts += [lambda r=r: given.sink.firings(r.operator, [r], encode_batch([r])) for r in calls]
                for act in acts if first == "message" else reversed(acts):
                    act()

    give(0, 5.3, 0)
    give(4.8, 5.3, 1)
    given.sink.close("complete")

    lives = []
    for part in parts_of(tmp_path / "run.mcap"):
        with Recording(part) as recording:
            log = FiringLog.read(recording)
            found = {record.incarnation for name in log.operators for record in log.of(name)}
            lives.append((found, {message.incarnation for message in recording.messages() if message.stamp}))
    assert lives == [({0}, {0}), ({0, 1}, {0, 1})]


def test_the_oldest_parts_are_deleted_and_the_rest_verifies(recorded: Path, graph: Graph, tmp_path: Path) -> None:
    (tmp_path / "other_000.mcap").write_bytes(b"of another recording")
    storage = Storage(Splitting(size=10_000), keep=40_000)
    facts = Given(recorded, graph, tmp_path / "run.mcap", storage).all()

    parts = parts_of(tmp_path / "run.mcap")
    assert facts["deleted"] >= 3
    assert facts["parts"] == [str(part) for part in parts]
    assert sum(part.stat().st_size for part in parts) == facts["bytes"] <= 40_000
    assert not (tmp_path / "run_000.mcap").exists()
    assert (tmp_path / "other_000.mcap").exists()
    rest = joined(parts, tmp_path / "rest.mcap")
    report = verify(rest, jobs=1)
    assert report.cut
    assert not [v for v in report.operators if v.verdict == "culprit"]
    assert sum(v.firings for v in report.operators) > 20


def test_recording_survives_a_full_disk_and_counts_the_loss(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk, capsys: pytest.CaptureFixture[str]
) -> None:
    def at(seconds: float) -> None:
        disk.full = 3 <= seconds < 6

    facts = Given(recorded, graph, tmp_path / "run.mcap", GO_ON).all(at)

    first, second = tmp_path / "run.mcap", tmp_path / "run_001.mcap"
    assert facts["parts"] == [str(first), str(second)]
    said = capsys.readouterr().out
    assert "recording stops, the run goes on" in said
    assert "No space left" in said
    assert f"recording goes on in {second}" in said
    whole = joined([first, second], tmp_path / "whole.mcap")
    with Recording(recorded) as was, Recording(whole) as again, Recording(second) as part:
        given = {name: info.count for name, info in was.streams.items()}
        stored = {name: info.count for name, info in again.streams.items()}
        assert [event.name for event in part.events()] == ["not_recorded"]
    lost = facts["lost"]["streams"]
    assert lost["test/left/fast"] > 50
    assert {name: stored[name] + lost.get(name, 0) for name in given} == given
    with Recording(recorded) as was, Recording(whole) as again:
        before, after = (sum(record.kind in CALLS for record in _records(each)) for each in (was, again))
    assert before - after == facts["lost"]["firings"] > 100
    for path in (first, second, whole):
        assert "culprit" not in verdicts(path).values()


def test_no_message_is_in_a_part_behind_a_full_disk_whose_record_is_lost(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk
) -> None:
    def at(seconds: float) -> None:
        disk.full = 3 <= seconds < 6

    facts = Given(recorded, graph, tmp_path / "run.mcap", GO_ON, behind=0.2).all(at)

    made = verify(tmp_path / "run_001.mcap", jobs=1)
    assert {v.operator: v.unaccounted for v in made.operators} == {"first": 0, "second": 0}
    with Recording(recorded) as was, Recording(joined([Path(p) for p in facts["parts"]], tmp_path / "all.mcap")) as now:
        stored = {name: now.streams[name].count + facts["lost"]["streams"].get(name, 0) for name in was.streams}
        assert stored == {name: info.count for name, info in was.streams.items()}


def test_messages_of_a_part_are_counted_once_despite_refused_writes(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk
) -> None:
    """As records of one operator after the other that are to stand in front of it."""
    given = Given(recorded, graph, tmp_path / "run.mcap", GO_ON)

    def at(seconds: float) -> None:
        part, disk.full = given.sink._current, 3 <= seconds < 6
        if disk.full and part is not None:
            with pytest.raises(RecordingError) as refused:
                part.sink.flush()
            for _ in range(2):
                given.sink._failed(part, refused.value)

    facts = given.all(at)

    assert facts["parts"] == [str(tmp_path / name) for name in ("run.mcap", "run_001.mcap")]
    whole = joined([Path(part) for part in facts["parts"]], tmp_path / "whole.mcap")
    with Recording(recorded) as was, Recording(whole) as again:
        stored = {name: info.count for name, info in again.streams.items()}
        lost = facts["lost"]["streams"]
        assert {n: stored[n] + lost.get(n, 0) for n in stored} == {n: was.streams[n].count for n in stored}


def test_part_whose_end_finds_the_disk_full_is_reported_at_once_and_at_the_end(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk, capsys: pytest.CaptureFixture[str]
) -> None:
    """All messages are there, and the next part goes on; but the file does not say that there is one."""
    sink = Given(recorded, graph, tmp_path / "run.mcap", replace(GO_ON, splitting=Splitting(every=2 * SECOND))).sink
    with Recording(recorded) as recording:
        found = [m for m in recording.messages() if m.stamp <= 4 * SECOND]
    for each in found:
        sink.message(each.stream, each.message, each.seq, each.incarnation)
    sink.flush()
    disk.full = True
    sink._close_full()
    disk.full = False
    said = capsys.readouterr().out
    facts = sink.close("complete")

    assert f"the end of a file is not recorded: writing {tmp_path / 'run_000.mcap'} failed: No space left" in said
    assert [Path(part).name for part in facts["parts"]] == ["run_000.mcap", "run_001.mcap"]
    assert (facts["messages"], facts["lost"]["messages"], facts["lost"]["spans"]) == (len(found), 0, [])
    assert "run_000.mcap failed: No space left" in facts["lost"]["reasons"][0]
    with pytest.raises(ReplayError, match="the recording has no proper end"):
        verify(tmp_path / "run_000.mcap", jobs=1)


def test_a_static_message_of_which_only_a_copy_is_stored_is_not_lost(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk
) -> None:
    """The first part, which it came into, found no room."""

    def at(seconds: float) -> None:
        disk.full = seconds < 3

    given = Given(recorded, graph, tmp_path / "run.mcap", GO_ON)
    disk.full = True
    facts = given.all(at)

    with Recording(tmp_path / "run_001.mcap") as part:
        assert part.streams["test/left/constant"].count == 1
    assert "test/left/fast" in facts["lost"]["streams"]
    assert "test/left/constant" not in facts["lost"]["streams"]


def test_a_static_message_of_which_the_only_copy_is_deleted_is_lost(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk
) -> None:
    """The part that began with it held nothing else, and so was deleted at the end."""
    sink = Given(recorded, graph, tmp_path / "run.mcap", GO_ON).sink
    with Recording(recorded) as recording:
        static = next(m for m in recording.messages() if m.stream == "test/left/constant")
    disk.full = True
    sink.message(static.stream, static.message, static.seq, static.incarnation)
    sink.flush()
    disk.full = False
    sink.flush()
    facts = sink.close("complete")

    assert facts["parts"] == [str(tmp_path / "run.mcap")]
    assert facts["lost"]["streams"] == {"test/left/constant": 1}


def test_a_disk_that_stays_full_leaves_a_readable_recording(
    recorded: Path, graph: Graph, tmp_path: Path, disk: Disk
) -> None:
    def at(seconds: float) -> None:
        disk.full = seconds >= 3

    facts = Given(recorded, graph, tmp_path / "run.mcap", GO_ON).all(at)

    assert list(tmp_path.iterdir()) == [tmp_path / "run.mcap"]  # tries that failed leave nothing behind
    assert facts["lost"]["spans"][0][1] is None
    assert verdicts(tmp_path / "run.mcap") == IDENTICAL
    with Recording(tmp_path / "run.mcap") as part:
        assert part.streams["test/left/fast"].count == 40


def test_full_disk_ends_the_run_if_so_configured(recorded: Path, graph: Graph, tmp_path: Path, disk: Disk) -> None:
    def at(seconds: float) -> None:
        disk.full = seconds >= 3

    with pytest.raises(RecordingError, match="No space left"):
        Given(recorded, graph, tmp_path / "run.mcap", Storage(on_failure="end")).all(at)


def test_one_message_that_is_refused_costs_that_message_alone(
    recorded: Path, graph: Graph, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = Given(recorded, graph, tmp_path / "run.mcap", GO_ON)
    with Recording(recorded) as recording:
        found = next(iter(recording.messages(["test/left/fast"])))
    before = FeatureVector(stamp=-5, vectors=np.zeros((1, 1), np.float32), model="test")
    given.sink.message(found.stream, before, 0, 0)

    facts = given.all()

    assert "not recorded:" in capsys.readouterr().out
    assert facts["lost"]["streams"] == {"test/left/fast": 1}
    assert verdicts(tmp_path / "run.mcap") == IDENTICAL


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o644])
def test_recording_has_the_configured_mode(graph: Graph, tmp_path: Path, mode: int) -> None:
    before = os.umask(0o000)
    try:
        storage = Storage(Splitting(every=SECOND), mode=mode)
        options = {"metadata": {}, "compression": "zstd", "overwrite": False, "storage": storage}
        PartsSink(tmp_path / "run.mcap", graph, list(graph.record.streams), options).close("complete")
    finally:
        os.umask(before)

    (file,) = tmp_path.iterdir()
    assert file.stat().st_mode & 0o777 == mode


VIDEO = """
graph: cameras
namespace: test
operators:
  camera: {use: video_operators:Cameras}
  size: {use: video_operators:Bytes, inputs: {video: camera/front}}
"""


def test_the_video_of_each_part_is_decoded_by_itself(tmp_path: Path) -> None:
    (tmp_path / "cameras.yaml").write_text(VIDEO)
    graph = load_graph(tmp_path / "cameras.yaml")
    run(graph, placement="one_process", record=tmp_path / "whole.mcap")
    given = Given(tmp_path / "whole.mcap", graph, tmp_path / "run.mcap", Storage(Splitting(every=SECOND // 2)))
    facts = given.all()

    parts = parts_of(tmp_path / "run.mcap")
    assert len(parts) == 4
    assert facts["messages"] == 3 * 48
    for part in parts:
        with Recording(part) as recording:
            for stream in ("test/camera/front", "test/camera/rear"):
                decoder = PacketDecoder("h264")
                for found in recording.messages([stream]):
                    assert decoder.decode(found.message.data.tobytes(), found.stamp) is not None, decoder.lost
                decoder.close()
        assert verdicts(part) == {"size": "identical"}
        assert all(s.whole and not s.unaccounted for s in verify(part, jobs=1).stand_ins)
    again = joined(parts, tmp_path / "again.mcap")
    with Recording(tmp_path / "whole.mcap") as was, Recording(again) as made:
        assert made.digests() == was.digests()
    assert verify(again, jobs=1).identical
