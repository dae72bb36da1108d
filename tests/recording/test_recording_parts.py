"""A folder of the parts of a recording opens, seeks and reads as the recording that it was."""

from __future__ import annotations

import json
import shutil
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_recordings import pose
from mcap.data_stream import ReadDataStream
from mcap.records import Channel
from mcap.writer import Writer

from dataflow.editing.merge import merge
from dataflow.editing.split import split
from dataflow.interop.opening import is_foreign
from dataflow.messages import Pose
from dataflow.recording import Recording, RecordingError, RecordingWriter, describe
from dataflow.recording.mcap.attachments import Attachment
from dataflow.recording.mcap.contents import Entries
from dataflow.recording.parts import Splitting, Storage
from dataflow.recording.streams.copying import Origin
from dataflow.recording.streams.part_folder import _JoinedIndex, parts_in
from dataflow.records.reading import FiringLog, whole
from dataflow.verification.gate import recordings_in

KEPT = Path(__file__).resolve().parent.parent / "recordings_of" / "live.mcap"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The kept recording in parts, which hold firing records, and messages and static streams more than once."""
    folder = tmp_path_factory.mktemp("split")
    with pytest.MonkeyPatch.context() as patched, Origin(KEPT) as origin:
        patched.syspath_prepend(str(KEPT.parent))
        span = origin.span()
        assert span is not None
        list(split(origin, folder, every=(span[1] - span[0]) // 4))
    assert len(parts_in(folder)) >= 4
    return folder


def test_parts_read_as_the_whole(folder: Path) -> None:
    with Recording(KEPT) as expected, Recording(folder) as recording:
        for name, info in expected.streams.items():
            for fact in ("count", "first", "last", "incarnations"):
                assert getattr(recording.streams[name], fact) == getattr(info, fact), name
        assert recording.digests() == expected.digests()
        names = [name for name, info in expected.streams.items() if not info.static and info.count]
        first = min(info.first or 0 for name, info in expected.streams.items() if name in names)
        last = max(info.last or 0 for name, info in expected.streams.items() if name in names)
        for begin, end in ((first + (last - first) // 3, last - (last - first) // 3), (last - 10**8, None)):
            read = ([(m.stream, m.stamp, m.seq) for m in r.messages(names, begin, end)] for r in (recording, expected))
            assert next(read) == next(read)
        assert sorted(e.stamp for e in recording.events()) == sorted(e.stamp for e in expected.events())
        assert "dataflow:cut" not in recording.metadata
        assert describe(recording).bytes == sum(part.stat().st_size for part in parts_in(folder))


def test_firing_records_of_parts_are_those_of_the_whole(folder: Path) -> None:
    with Recording(KEPT) as expected, Recording(folder) as recording:
        one, other = FiringLog.read(expected), FiringLog.read(recording)
        for operator in one.operators:
            assert whole(other.of(operator)) == whole(one.of(operator)), operator


def test_parts_are_verified_record_by_record(folder: Path) -> None:
    """What a part begins with, in place of the records before it, is no disorder for which all of them are held."""
    with Recording(KEPT) as expected, Recording(folder) as recording:
        one, other = FiringLog.read(expected), FiringLog.read(recording)
        checked = 0
        for operator in one.operators:
            streams = [n for n, info in recording.streams.items() if info.metadata.get("operator") == operator]
            if len(streams) > 1:
                continue
            maker = SimpleNamespace(name=operator, outputs={stream: stream for stream in streams})
            outline = other.outline(maker)
            moving = {stream for stream in streams if not recording.streams[stream].static}
            assert not outline.scattered & moving
            assert len({run.first for run in outline.runs if run.first[1] > 0}) >= 3
            assert list(other.ordered(maker)) == list(one.ordered(maker))
            for stream in moving:
                assert list(other.emissions(maker, stream)) == list(one.emissions(maker, stream))
                checked += 1
        assert checked > 2


def test_reading_the_records_of_parts_takes_time_by_their_number_alone(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part is two or three runs of the records, which are read without those before them."""
    looked_up: list[int] = []
    moved = _JoinedIndex._moved

    def noting(index: _JoinedIndex, number: int, entries: Entries, after: int | None) -> Entries:
        looked_up.append(len(entries))
        return moved(index, number, entries, after)

    monkeypatch.setattr(_JoinedIndex, "_moved", noting)
    with Recording(folder) as recording:
        log = FiringLog.read(recording)
        for operator, batches in recording.firing_batches().items():
            maker = SimpleNamespace(name=operator, outputs={})
            assert len(log.outline(maker).runs) > 3
            looked_up.clear()
            assert len(list(log.ordered(maker))) > 3
            assert sum(looked_up) <= 3 * batches


def test_a_folder_of_parts_is_one_recording_for_commands(folder: Path) -> None:
    assert not is_foreign(folder)
    assert recordings_in([folder]) == [(folder, folder.name)]


def test_a_missing_part_is_named(folder: Path, tmp_path: Path) -> None:
    there = tmp_path / "parts"
    shutil.copytree(folder, there)
    parts_in(there)[1].unlink()

    with pytest.raises(RecordingError, match=r"the part after live_000\.mcap is missing: number 1"):
        Recording(there)


@pytest.mark.parametrize("kept", [0, 8, 53, 200, None])
def test_a_part_that_its_writer_died_as_it_began_is_passed_over(folder: Path, tmp_path: Path, kept: int | None) -> None:
    """None: a full disk took its header and its end."""
    shutil.copytree(folder, tmp_path / "parts")
    parts = parts_in(tmp_path / "parts")
    begun = parts[-1].with_name(parts[-1].name.replace(f"_{len(parts) - 1:03}", f"_{len(parts):03}"))
    if kept is None:
        writer = Writer(str(begun))
        writer.start()
        writer.finish()
    else:
        begun.write_bytes(parts[-1].read_bytes()[:kept])

    with Recording(folder) as expected, Recording(tmp_path / "parts") as recording:
        assert recording.digests() == expected.digests()
        assert recording.torn
        assert any(begun.name in note and "holds nothing" in note for note in recording.damage)
    if kept != 0:
        with ExitStack() as stack:
            origins = [stack.enter_context(Origin(part)) for part in parts_in(tmp_path / "parts")]
            done = merge(origins, tmp_path / "whole.mcap")
        assert any(begun.name in note and "holds nothing" in note for note in done.notes)
        with Recording(KEPT) as expected, Recording(tmp_path / "whole.mcap") as recording:
            assert recording.digests() == expected.digests()


def test_declarations_of_a_file_are_parsed_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(stream: ReadDataStream) -> Channel:
        raise AssertionError("a channel is parsed again")

    with Recording(folder) as expected:
        monkeypatch.setattr(Channel, "read", staticmethod(refused))
        with Recording(folder) as recording:
            assert recording.streams == expected.streams


def test_parts_without_what_they_share_follow_each_other(tmp_path: Path) -> None:
    """As a recorder makes them that begins a new file: times go on, and so do numbers and firing records."""
    for part in range(3):
        with RecordingWriter(tmp_path / f"a_{part:03}.mcap", metadata={"note": {"part": str(part)}}) as writer:
            writer.add_stream("a", Pose)
            writer.add_attachment(Attachment("file", "text/plain", 0, 0, b"the same"))
            for k in range(4 * part, 4 * part + 4):
                writer.write("a", pose(100 + k), seq=k)
                writer.write_firings("op", 100 + k, bytes([k]))
    with Recording(tmp_path) as recording:
        assert [(m.stamp, m.seq) for m in recording.messages()] == [(100 + k, k) for k in range(12)]
        assert [m.stamp for m in recording.messages(start=105, end=108)] == [105, 106, 107, 108]
        assert list(recording.firings()) == [("op", bytes([k])) for k in range(12)]
        assert [a.data for a in recording.attachments()] == [b"the same"]
        assert recording.metadata["note"] == {"part": "2"}
    (tmp_path / "b.mcap").write_bytes(b"")
    assert parts_in(tmp_path) == []


def test_storage_options_survive_json() -> None:
    storage = Storage(Splitting(size=1000, every=60_000_000_000), keep=10**6, on_failure="end", mode=0o640)

    assert Storage.from_json(json.loads(json.dumps(storage.to_json()))) == storage
