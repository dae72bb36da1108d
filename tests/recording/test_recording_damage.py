"""One flipped bit anywhere in a recording: what is read stays the same, or an error or a note says so."""

from __future__ import annotations

import random
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import pose
from mcap.opcode import Opcode
from mcap.reader import make_reader

from dataflow.messages import Image, Odometry, Pose
from dataflow.recording import Recording, RecordingError, RecordingWriter, describe
from dataflow.recording.mcap import container, packing
from dataflow.recording.mcap.seals import Seal, seal_of, sealed

FLIPS_PER_KIND = 40


def write(path: Path) -> Path:
    """Every kind of record: streams with and without a companion, a static one, firing records, events, metadata."""
    metadata = {"dataflow:graph": {"text": "graph: g\n" * 20}, "note": {"robot": "kitchen 3"}}
    with RecordingWriter(path, metadata=metadata, namespace="r", chunk_bytes=1500, chunk_seconds=1e9) as writer:
        writer.add_stream("r/mount/out", Pose, static=True)
        writer.add_stream("r/camera/image", Image)
        writer.add_stream("r/odometry/out", Odometry)
        place: dict[str, Any] = {"position": [1.0, 2.0, 3.0], "orientation": [0.0, 0.0, 0.0, 1.0]}
        writer.write("r/mount/out", Pose(stamp=5, frame="base", child_frame="camera", **place), seq=0)
        for i in range(12):
            stamp = 1000 + 10 * i
            pixels = np.full((8, 8), i, np.uint8)
            writer.write("r/camera/image", Image(stamp=stamp, frame="camera", data=pixels), seq=i)
            writer.write("r/odometry/out", Odometry(stamp=stamp, frame="odom", child_frame="base", **place), seq=i)
            writer.write_firings("odometry", stamp, bytes([i]) * 30)
            if i % 4 == 3:
                writer.write_event("gap", stamp, {"from": i})
                writer.flush()
    return path


def content(path: Path) -> tuple[dict[str, Any], bool]:
    """Everything that a reader is given, and whether a note says that the file is damaged."""
    with Recording(path) as recording:
        streams = recording.streams
        found = {
            "messages": [(m.stream, m.stamp, m.seq, m.incarnation, m.message.digest()) for m in recording.messages()],
            "ranged": [(m.stream, m.stamp) for m in recording.messages(start=1030, end=1080)],
            "raw": [(r.stream, r.schema, r.encoding, r.log_time, r.sequence, r.data) for r in recording.raw()],
            "streams": {
                name: (info.static, info.message_type, info.count, info.first, info.last, dict(info.metadata))
                for name, info in streams.items()
            },
            "sizes": {name: info.bytes for name, info in streams.items()},
            "counts": {name: dict(recording.counts(name)) for name in streams},
            "firings": (list(recording.firings()), recording.firing_batches()),
            "events": [(e.name, e.stamp, dict(e.data)) for e in recording.events()],
            "metadata": {name: dict(mapping) for name, mapping in recording.metadata.items()},
            "facts": (recording.library, recording.profile),
        }
        return found, recording.torn or bool(recording.damage)


def regions(data: bytes) -> Iterator[tuple[str, int, int]]:
    """(kind, first byte, end) of every record; those of the summary are kinds of their own."""
    position, after = 8, ""
    yield "magic", 0, 8
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        yield after + Opcode(opcode).name, position, position + 9 + length
        position += 9 + length
        after = "summary " if opcode == Opcode.DATA_END else after
    yield "end magic", position, len(data)


def flips(data: bytes, seed: int) -> Iterator[tuple[str, int, int]]:
    """(kind, byte, bit): some of every kind of record, its length and opcode as likely as its content."""
    kinds: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for kind, start, end in regions(data):
        kinds[kind].append((start, end))
    rng = random.Random(seed)
    for kind, places in kinds.items():
        for i in range(FLIPS_PER_KIND):
            start, end = rng.choice(places)
            yield kind, rng.randrange(start, min(start + 9, end) if i % 4 == 0 else end), 1 << rng.randrange(8)


def silent_changes(path: Path, *, seed: int) -> list[tuple[str, set[str]]]:
    """Kind of record and what of the content differs, of the flips that neither an error nor a note tells of."""
    data = path.read_bytes()
    expected, noted = content(path)
    assert not noted
    found = []
    for kind, at, bit in flips(data, seed):
        changed = bytearray(data)
        changed[at] ^= bit
        path.write_bytes(changed)
        try:
            got, noted = content(path)
        except RecordingError:
            continue
        differ = {name for name in expected if got[name] != expected[name]}
        if differ and not noted:
            found.append((kind, differ))
    return found


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write(tmp_path / "a.mcap")


@pytest.fixture
def unsealed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording as it was written before records outside chunks had checksums."""
    with monkeypatch.context() as patched:
        for module in (container, packing):
            patched.setattr(module, "sealed", lambda record: record)
        return write(tmp_path / "old.mcap")


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_flipped_bits_never_change_messages_silently(recording: Path, seed: int) -> None:
    assert silent_changes(recording, seed=seed) == []


@pytest.mark.long
def test_without_checksums_only_metadata_and_the_header_can_change_silently(unsealed: Path) -> None:
    """And sizes, which are taken from where messages lie."""
    changes = silent_changes(unsealed, seed=2)
    assert {kind for kind, differ in changes if differ != {"sizes"}} <= {"METADATA", "HEADER"}


def test_a_recording_without_checksums_of_its_records_reads_as_before(recording: Path, unsealed: Path) -> None:
    with recording.open("rb") as file:
        assert make_reader(file).get_summary() is not None
    assert content(unsealed) == content(recording)


def test_other_readers_take_the_checksums_for_fields_that_they_do_not_know(recording: Path, unsealed: Path) -> None:
    def read(path: Path) -> Any:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            messages = [(s and s.name, c.topic, m.log_time, m.data) for s, c, m in reader.iter_messages()]
            metadata = [(m.name, m.metadata) for m in reader.iter_metadata()]
            return messages, metadata, reader.get_header().library

    assert read(recording) == read(unsealed)


def flip(path: Path, kind: str, *, which: int = 0, at: int = -1, bit: int = 1) -> None:
    """Flips a bit of the `which`-th record of a kind, by default in its last byte."""
    data = bytearray(path.read_bytes())
    start, end = [(start, end) for k, start, end in regions(data) if k == kind][which]
    data[start + at if at >= 0 else end + at] ^= bit
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["CHANNEL", "SCHEMA", "CHUNK_INDEX", "METADATA_INDEX", "STATISTICS", "FOOTER"])
def test_a_damaged_summary_is_noted_and_got_round_without_loss(recording: Path, kind: str) -> None:
    expected, _ = content(recording)
    flip(recording, f"summary {kind}", at=20)
    with Recording(recording) as opened:
        [note] = opened.damage
        assert "fails its checksum; all of its records were read instead" in note
        assert not opened.torn
        assert describe(opened).damage == opened.damage
    assert content(recording) == (expected, True)


def test_a_damaged_message_index_is_noted_and_its_chunk_is_read_instead(recording: Path) -> None:
    expected, _ = content(recording)
    flip(recording, "MESSAGE_INDEX", which=2, at=16)
    with Recording(recording) as opened:
        [note] = opened.damage
        assert "message index" in note
        assert "was read instead" in note
    assert content(recording) == (expected, True)


def test_a_damaged_metadata_record_is_noted_by_name_and_left_out(recording: Path) -> None:
    flip(recording, "METADATA", which=1, at=60)
    with Recording(recording) as opened:
        [note] = opened.damage
        assert "'dataflow:graph'" in note
        assert "dataflow:graph" not in opened.metadata
        assert opened.metadata["note"] == {"robot": "kitchen 3"}
        assert sum(1 for _ in opened.messages(["r/camera/image"])) == 12


def test_damaged_messages_end_in_an_error_that_names_the_chunk(recording: Path) -> None:
    flip(recording, "CHUNK", which=1)
    with Recording(recording) as opened, pytest.raises(RecordingError, match=r"chunk 1 at byte \d+ (fails|does not)"):
        list(opened.messages())


@pytest.mark.parametrize("kind", ["CHANNEL", "SCHEMA", "METADATA", "MESSAGE_INDEX", "CHUNK"])
def test_damage_in_a_torn_recording_is_noted_too(recording: Path, kind: str) -> None:
    expected, _ = content(recording)
    cut = next(start for k, start, _ in regions(recording.read_bytes()) if k == "DATA_END")
    recording.write_bytes(recording.read_bytes()[:cut])
    flip(recording, kind, which=1, at=14)
    try:
        with Recording(recording) as opened:
            assert opened.torn
            got = [(m.stream, m.stamp) for m in opened.messages()]
            noted = bool(opened.damage)
    except RecordingError:
        noted = True
    assert noted or got == [row[:2] for row in expected["messages"]]


def test_an_index_that_disagrees_with_the_statistics_is_not_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: Callable[..., Path]
) -> None:
    real = packing.PendingChunk.add

    def forgetful(self: Any, channel: int, log_time: int, *of_it: Any) -> None:
        real(self, channel, log_time, *of_it)
        if log_time == 3:
            del self.entries[channel][-2:]

    path = record([("a", pose(i)) for i in range(1, 6)], name="whole.mcap")
    with path.open("rb") as file:
        statistics = make_reader(file).get_summary().statistics
    with monkeypatch.context() as patched:
        patched.setattr(packing.PendingChunk, "add", forgetful)
        patched.setattr(container.ContainerWriter, "_statistics", lambda self: statistics)
        path = record([("a", pose(i)) for i in range(1, 6)])
    with Recording(path) as recording:
        assert "its statistics count 5 messages of channel 1, its index 4" in recording.damage[0]
        assert [m.stamp for m in recording.messages()] == [1, 2, 3, 4, 5]


def test_seal_detects_every_change_of_its_record() -> None:
    record = sealed(b"\x04" + struct.pack("<Q", 3) + b"abc")
    assert seal_of(record) is Seal.SOUND
    assert struct.unpack_from("<BQ", record) == (4, len(record) - 9)
    for at in range(len(record)):
        changed = bytearray(record)
        changed[at] ^= 4
        assert seal_of(bytes(changed)) is not Seal.SOUND
    assert seal_of(b"\x04" + struct.pack("<Q", 3) + b"abc") is Seal.ABSENT
