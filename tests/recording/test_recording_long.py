"""Recordings of very many chunks: their messages are looked up as they are needed, with the same result."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import pose
from mcap.opcode import Opcode

from dataflow.messages import Image, Pose
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.mcap import chunk_indexes, contents, message_index, summary
from dataflow.recording.mcap.chunks import Column
from dataflow.recording.mcap.index import McapFile


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Streams with and without a companion, a static one, one whose clock jumps back, firing records and events."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={}, namespace="r") as writer:
        writer.add_stream("r/mount/out", Pose, static=True)
        writer.write("r/mount/out", pose(5), seq=0)
        for name, kind in (("r/camera/image", Image), ("r/pose/out", Pose), ("r/jump/out", Pose)):
            writer.add_stream(name, kind)
        for k in range(60):
            stamp = 1000 + 10 * k
            image = Image(stamp=stamp, frame="camera", data=np.full((3, 4), k, np.uint8))
            writer.write("r/camera/image", image, seq=k)
            writer.write("r/pose/out", pose(stamp - 3), seq=2 * k)
            if k % 7:
                writer.write("r/pose/out", pose(stamp + 2), seq=2 * k + 1)
            writer.write("r/jump/out", pose(stamp - 400 * (k >= 30)), seq=k % 30, incarnation=k // 30)
            writer.write_firings("pose", stamp, bytes([k]) * 9)
            if k % 20 == 3:
                writer.write_event("gap", stamp, {"from": k})
            writer.flush()
    return path


def content(path: Path) -> dict[str, Any]:
    with Recording(path) as recording:
        streams = recording.streams.values()
        return {
            "streams": [(i.name, i.count, i.first, i.last, i.static, i.incarnations) for i in streams],
            "messages": [(m.stream, m.stamp, m.seq, m.incarnation, m.message.digest()) for m in recording.messages()],
            "ranged": [(m.stream, m.stamp, m.seq) for m in recording.messages(start=1203, end=1377)],
            "before": list(recording.messages(["r/pose/out"], end=3)),
            "raw": [(r.stream, r.log_time, r.sequence, r.data) for r in recording.raw(start=1100, end=1480)],
            "stamps": [list(recording.stamps(name, 1155, None)) for name in recording.streams],
            "counts": [recording.counts(name) for name in recording.streams],
            "firings": list(recording.firings()),
            "behind": [list(recording.firings("pose", skip=skip)) for skip in (17, 1, 43, 60, 99)],
            "behind a stamp": list(recording.firings(start=1203, skip=5)),
            "events": list(recording.events()),
            "indexed": [recording.index("r/pose/out", 1100, 1300).read(k).stamp for k in range(9)],
            "damage": recording.damage,
        }


def index_behind(data: bytes, *, chunk: int) -> int:
    """The place of the first message index behind a chunk."""
    at, number = 8, -1
    while number < chunk or data[at] == Opcode.CHUNK:
        number += data[at] == Opcode.CHUNK
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return at


def long(monkeypatch: pytest.MonkeyPatch, step: int = 4) -> None:
    """Has every recording be one of many chunks."""
    monkeypatch.setattr(summary, "LONG", 0)
    monkeypatch.setattr(message_index, "STEP", step)
    monkeypatch.setattr(chunk_indexes, "SEGMENT", 7 * step)


@pytest.mark.parametrize(
    "step", [pytest.param(1, marks=pytest.mark.long), 4, pytest.param(1000, marks=pytest.mark.long)]
)
def test_a_long_recording_reads_as_a_short_one(path: Path, step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = content(path)
    long(monkeypatch, step)
    assert content(path) == expected


@pytest.mark.long
@pytest.mark.parametrize("size", [1, 300, 2000])
def test_so_does_one_of_many_messages_however_few_of_them_are_looked_up_together(
    path: Path, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the number of its chunks: a day of small messages has few, and tens of millions of messages."""
    expected = content(path)
    monkeypatch.setattr(summary, "LONG_BYTES", 0)
    monkeypatch.setattr(message_index, "STEP_BYTES", size)
    monkeypatch.setattr(message_index, "SAMPLED_BYTES", size)

    assert content(path) == expected
    with Recording(path) as recording:
        assert isinstance(recording._file.index, message_index.LongIndex)


def test_a_summary_is_read_in_blocks_of_any_size(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = content(path)
    for size in (150, 300, 1000):  # less than some records take, and some of them
        monkeypatch.setattr(summary, "BLOCK_BYTES", size)
        assert content(path) == expected


def test_the_number_of_chunks_is_not_limited(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit on records that are parsed counted them: nothing opened a recording of 262,145 chunks."""
    monkeypatch.setattr(contents, "MAX_PARSED", 40)
    expected = content(path)
    torn = path.with_name("torn.mcap")
    torn.write_bytes(path.read_bytes()[:-9])
    with Recording(torn) as recording:
        assert recording.torn
        assert [m.stamp for m in recording.messages()] == [m[1] for m in expected["messages"]]


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of the chunks whose messages are looked up."""
    found: list[int] = []
    real = message_index.take_messages

    def noting(contents: Any, indexes: Any, numbers: Column, **options: Any) -> None:
        found.extend(numbers.tolist())
        real(contents, indexes, numbers, **options)

    monkeypatch.setattr(message_index, "take_messages", noting)
    return found


def test_only_the_chunks_of_a_span_are_looked_up(path: Path, taken: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    long(monkeypatch)
    with Recording(path) as recording:
        taken.clear()
        assert len(list(recording.messages(["r/camera/image"], 1200, 1240))) == 5
    assert 5 <= len(set(taken)) < 40  # of 120; many reach over the span, as one stream lags by 400 ns


def test_records_that_are_passed_over_are_not_looked_up_again(
    path: Path, taken: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The records of an operator that was restarted often lie in many runs, each of which is read by itself."""
    long(monkeypatch)
    with Recording(path) as recording:
        every = list(recording.firings("pose"))
        taken.clear()
        assert list(recording.firings("pose", skip=50)) == every[50:]
    assert 10 <= len(taken) <= 14  # of 60


def test_message_indexes_looked_up_together_are_those_of_each_chunk(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(McapFile(path)) as file:
        together = {channel: file.index.entries(channel) for channel in file.channels}

    monkeypatch.setattr(message_index, "_sound_entries", lambda *_: None)
    with closing(McapFile(path)) as file:
        for channel, entries in together.items():
            np.testing.assert_array_equal(file.index.entries(channel).columns, entries.columns)
            assert len(entries)


def test_damaged_message_indexes_are_noted_when_they_are_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = content(path)
    long(monkeypatch)
    data = bytearray(path.read_bytes())
    at = index_behind(data, chunk=40) + 20
    data[at] ^= 1
    path.write_bytes(data)
    got = content(path)
    assert any("is damaged; chunk 40" in note for note in got.pop("damage"))
    expected.pop("damage")
    assert got == expected


def test_sizes_of_streams_are_estimated_from_some_chunks(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Recording(path) as recording:
        exact = {name: info.bytes for name, info in recording.streams.items()}
    long(monkeypatch)
    monkeypatch.setattr(message_index, "SAMPLED", 30)
    with Recording(path) as recording:
        for name in ("r/camera/image", "r/jump/out"):
            assert recording.streams[name].bytes == pytest.approx(exact[name], rel=0.05)
