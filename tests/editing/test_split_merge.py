"""Split recordings are recordings; merged, they are the whole again. Others are merged as streams."""

from __future__ import annotations

import os
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
from example_messages import example
from made_parts import cut, messages

from dataflow.editing.merge import merge
from dataflow.editing.part import Part, write_part
from dataflow.editing.split import split
from dataflow.editing.spool import Spool
from dataflow.messages import Imu, Odometry
from dataflow.recording import Recorded, Recording, RecordingError, RecordingWriter
from dataflow.recording.streams.copying import Origin
from dataflow.recording.streams.cutting import cut_of
from dataflow.recording.streams.ordering import Row
from dataflow.recording.streams.streams import IndexedStream
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import recorded_graph
from dataflow.verification.verify import verify

pytestmark = pytest.mark.usefixtures("in_process")

SECOND = 1_000_000_000


def records(path: Path) -> dict[str, list[object]]:
    with Recording(path) as recording:
        log = FiringLog.read(recording)
        return {name: list(log.of(name)) for name in log.operators}


def merged(paths: list[Path], out: Path, *prefixes: str) -> list[str]:
    origins = [Origin(path) for path in paths]
    try:
        return merge(origins, out, prefixes=prefixes).notes
    finally:
        for origin in origins:
            origin.close()


@pytest.mark.long
@pytest.mark.parametrize("how", [{"every": SECOND // 4}, {"size": 20_000}], ids=["time", "size"])
def test_the_merge_of_a_split_is_the_whole(recorded: Path, tmp_path: Path, how: dict[str, int]) -> None:
    with Origin(recorded) as origin:
        parts = [Path(done.path) for done in split(origin, tmp_path / "parts", **how)]

    merged(list(reversed(parts)), tmp_path / "whole.mcap")

    assert len(parts) > 2
    assert messages(tmp_path / "whole.mcap") == messages(recorded)
    assert records(tmp_path / "whole.mcap") == records(recorded)
    assert verify(tmp_path / "whole.mcap").identical


def test_reading_begins_at_any_record(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.records.order.STEP", 1)
    with Recording(recorded) as recording:
        graph = recorded_graph(recording)
        for node in graph.nodes.values():
            log = FiringLog.read(recording)
            listed = list(log.ordered(node))
            for k in range(0, len(listed), 17):
                assert list(log.since(node, (listed[k].incarnation, listed[k].index))) == listed[k:]


def test_messages_are_decoded_for_the_part_that_they_are_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame tree is derived from them."""
    with RecordingWriter(tmp_path / "a.mcap", metadata={}) as writer:
        writer.add_stream("a", Odometry)
        for k in range(40):
            writer.write("a", example(Odometry).replace(stamp=1000 + 10 * k), seq=k)
    decoded: list[Path] = []
    of = Recording._recorded

    def noting(recording: Recording, stream: IndexedStream, row: Row) -> Recorded:
        decoded.append(recording.path)
        return of(recording, stream, row)

    monkeypatch.setattr(Recording, "_recorded", noting)
    with Origin(tmp_path / "a.mcap") as origin:
        parts = list(split(origin, tmp_path / "parts", every=50))

    assert len(parts) == 8
    assert len(decoded) == 40


def test_every_message_is_in_the_part_of_its_time(recorded: Path, tmp_path: Path) -> None:
    with Origin(recorded) as origin:
        first, last = origin.span()
        done = list(split(origin, tmp_path / "parts", every=SECOND // 3))

    spans = [one.span for one in done]
    assert all(b[0] > a[1] for a, b in pairwise(spans))
    assert (spans[0][0], spans[-1][1]) == (first, last)


@pytest.mark.long
def test_parts_with_a_gap_between_stay_a_part_and_verify_around_it(stateful: Path, tmp_path: Path) -> None:
    parts = [cut(stateful, tmp_path / "a.mcap", None, 0.3), cut(stateful, tmp_path / "b.mcap", 0.6, None)]

    notes = merged(parts, tmp_path / "both.mcap")

    report = verify(tmp_path / "both.mcap")
    assert any("nothing is known of" in note for note in notes)
    assert {v.verdict for v in report.operators} == {"identical"}
    assert report.cut
    assert not report.identical


def test_overlapping_parts_hold_everything_once(recorded: Path, tmp_path: Path) -> None:
    parts = [cut(recorded, tmp_path / "a.mcap", None, 0.6), cut(recorded, tmp_path / "b.mcap", 0.4, None)]

    merged(parts, tmp_path / "both.mcap")

    assert messages(tmp_path / "both.mcap") == messages(recorded)
    assert verify(tmp_path / "both.mcap").identical


def test_no_gap_is_behind_a_part_that_lies_within_another(kept: Path, tmp_path: Path) -> None:
    """As the spans of parts do after a jump of the clock, too."""
    spans = [(None, 0.6), (0.2, 0.4), (0.5, None), (0.7, 0.8)]
    parts = [cut(kept, tmp_path / f"{k}.mcap", *span) for k, span in enumerate(spans)]

    notes = merged(parts, tmp_path / "all.mcap")

    assert not any("nothing is known of" in note for note in notes)
    with Recording(tmp_path / "all.mcap") as whole:
        assert cut_of(whole.metadata) is None


def test_each_part_is_open_once_while_many_are_merged(kept: Path, tmp_path: Path) -> None:
    opened: list[int] = []
    with ExitStack() as stack:
        origins = [stack.enter_context(Origin(kept)) for _ in range(8)]
        before = len(os.listdir("/dev/fd"))
        merge(origins, tmp_path / "all.mcap", watch=lambda done, total: opened.append(len(os.listdir("/dev/fd"))))

    assert max(opened) <= before + 2  # the file that is written, and the records on their way to it
    assert records(tmp_path / "all.mcap") == records(kept)


def test_a_folder_that_takes_nothing_is_a_fault_of_the_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="absent does not take the firing records"):
        Spool(tmp_path / "absent", {})


def test_a_file_that_exists_is_refused_before_records_are_read(
    kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "out.mcap").write_text("mine")
    monkeypatch.setattr("dataflow.editing.merge.Spool", None)
    with pytest.raises(RecordingError, match="exists already"):
        merged([kept, kept], tmp_path / "out.mcap")
    assert [file.name for file in tmp_path.iterdir()] == ["out.mcap"]


def test_streams_of_another_recording_join_a_run_that_still_verifies(stateful: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    with RecordingWriter(other, metadata={}, namespace="test") as writer:
        for name, kind in (("test/imu/data", Imu), ("test/odometry/pose", Odometry)):
            writer.add_stream(name, kind)
            writer.write(name, example(kind).replace(stamp=5 * SECOND), seq=0)

    notes = merged([stateful, other], tmp_path / "both.mcap")

    assert messages(tmp_path / "both.mcap") == messages(stateful) | messages(other)
    assert verify(tmp_path / "both.mcap").identical
    assert any("clocks that differ" in note for note in notes)
    with pytest.raises(RecordingError, match="both hold test/imu/data"):
        merged([other, other], tmp_path / "twice.mcap")
    merged([other, other], tmp_path / "twice.mcap", "", "rear/")
    assert set(messages(tmp_path / "twice.mcap")) == {
        f"{prefix}test/{name}" for prefix in ("", "rear/") for name in ("imu/data", "odometry/pose")
    }


def test_filtered_recording_reports_unverifiable_operators(recorded: Path, tmp_path: Path) -> None:
    with Origin(recorded) as origin:
        names = [name for name in origin.counts() if not name.startswith("test/right/")]
        write_part(origin, Part(streams=names), tmp_path / "part.mcap")

    report = verify(tmp_path / "part.mcap")

    assert not report.culprits
    verdicts = {v.operator: (v.verdict, v.missing) for v in report.operators}
    assert verdicts["mix"] == ("unverifiable", "test/right/fast") or verdicts["mix"][1].startswith("test/right/")
    assert verdicts["slow"][0] == "identical"
    assert not report.identical
