"""The writer keeps what it was given: through a kill, a full disk, restarts of a source; and refuses what cannot be."""

from __future__ import annotations

import errno
import gc
import os
import resource
import signal
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from made_recordings import noise, pose
from mcap.reader import make_reader

from dataflow.messages import Image, Pose
from dataflow.recording import Recording, RecordingError, RecordingWriter
from dataflow.recording.mcap import container
from dataflow.recording.streams.codecs import SchemaText

WRITE_UNTIL_KILLED = """
import sys, numpy as np
from dataflow.messages import Image, Pose
from dataflow.recording import RecordingWriter
rng = np.random.default_rng(0)
writer = RecordingWriter(sys.argv[1], metadata={"graph": {"text": "graph: g"}}, chunk_bytes=100_000)
writer.add_stream("camera/image", Image)
writer.add_stream("odometry/pose", Pose)
for seq in range(10**9):
    image = Image(stamp=1000 + seq, frame="camera", data=rng.integers(0, 255, (100, 100, 3), dtype=np.uint8))
    writer.write("camera/image", image, seq=seq)
    pose = Pose(stamp=1000 + seq, frame="map", position=[seq, 0, 0], orientation=[0, 0, 0, 1], child_frame="camera")
    writer.write("odometry/pose", pose, seq=seq)
    if seq == 4:
        writer.flush()
        print("flushed", flush=True)
    if seq == 60:
        print("enough", flush=True)
"""


def test_a_killed_writer_leaves_everything_up_to_the_last_chunk(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    child = subprocess.Popen([sys.executable, "-c", WRITE_UNTIL_KILLED, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    assert child.stdout.readline() == "flushed\n"
    assert child.stdout.readline() == "enough\n"
    child.send_signal(signal.SIGKILL)
    child.wait(timeout=30)
    with Recording(path) as recording:
        assert recording.torn
        assert recording.metadata["graph"] == {"text": "graph: g"}
        images = list(recording.messages(["camera/image"]))
        poses = list(recording.messages(["odometry/pose"]))
        assert [m.seq for m in images] == list(range(len(images)))
        assert [m.seq for m in poses] == list(range(len(poses)))
        assert len(images) > 50  # all but the chunk in progress, of at most four images
        assert abs(len(images) - len(poses)) <= 1
        assert all(m.message.child_frame == "camera" for m in poses)


def test_flushed_messages_are_readable_while_the_writer_lives(tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    with RecordingWriter(path, metadata={}) as writer:
        writer.add_stream("a", Pose)
        writer.write("a", pose(1), seq=0)
        writer.flush()
        writer.write("a", pose(2), seq=1)
        with Recording(path) as recording:
            assert recording.torn
            assert [m.stamp for m in recording.messages()] == [1]
    with Recording(path) as recording:
        assert not recording.torn
        assert [m.stamp for m in recording.messages()] == [1, 2]


def test_an_old_chunk_is_finished_by_the_next_message(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "slow.mcap", metadata={}, chunk_seconds=0.0) as writer:
        writer.add_stream("a", Pose)
        writer.write("a", pose(1), seq=0)
        before = writer.saved_bytes
        writer.write("a", pose(2), seq=1)
        assert writer.saved_bytes > before


def record_until_it_fails(path: Path, limit: int = 1000) -> tuple[RecordingError, int]:
    """Writes images until the writer raises; the error, and how many messages it had taken before."""
    writer = RecordingWriter(path, metadata={}, chunk_bytes=50_000)
    writer.add_stream("camera/image", Image)
    try:
        for seq in range(limit):
            writer.write("camera/image", Image(stamp=seq, frame="c", data=noise(seq, 64, 64, 3)), seq=seq)
    except RecordingError as error:
        more = Image(stamp=limit, frame="c", data=noise(0, 8, 8))
        for refused in (lambda: writer.write("camera/image", more, seq=limit), writer.flush, writer.close):
            with pytest.raises(RecordingError, match="failed"):
                refused()
        writer.close()
        return error, seq
    raise AssertionError("the disk was never full")


def test_a_full_disk_is_reported_and_leaves_a_readable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, room = os.write, 400_000

    def write(fd: int, data: Any) -> int:
        nonlocal room
        if room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        count = real(fd, memoryview(data)[: max(1, room)])
        room -= count
        return count

    monkeypatch.setattr(os, "write", write)
    path = tmp_path / "full.mcap"
    error, taken = record_until_it_fails(path)
    assert "No space left on device" in str(error)
    assert str(path) in str(error)
    with Recording(path) as recording:
        seqs = [m.seq for m in recording.messages()]
        assert recording.torn
        assert recording.lost_bytes == 0
    assert seqs == list(range(len(seqs)))
    assert taken - 5 <= len(seqs) <= taken
    assert f"stamps up to {seqs[-1]}" in str(error)


def noted_writes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    real, writes = os.write, list[int]()
    monkeypatch.setattr(os, "write", lambda fd, data: (writes.append(len(data)), real(fd, data))[1])
    return writes


def refuse_once(monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.write

    def refuse(fd: int, data: Any) -> int:
        monkeypatch.setattr(os, "write", real)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", refuse)


def test_the_end_of_a_file_is_one_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that takes a tenth of a second for each would hold up a recorder for seconds."""
    writer = RecordingWriter(tmp_path / "many.mcap", metadata={})
    for k in range(40):
        writer.add_stream(f"a{k}", Pose)
        writer.write(f"a{k}", pose(1), seq=0)
    writes = noted_writes(monkeypatch)
    writer.flush()
    assert len(writes) == 1
    writer.close()

    assert len(writes) <= 3  # the digests, which are metadata, and the index
    with Recording(tmp_path / "many.mcap") as recording:
        assert len(list(recording.messages())) == 40


def test_declarations_and_first_messages_share_one_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a write for each schema, channel and metadata, a part of a recording began with forty."""
    writes = noted_writes(monkeypatch)
    writer = RecordingWriter(tmp_path / "many.mcap", metadata={"graph": {"text": "graph: g"}})
    for k in range(12):
        writer.add_stream(f"a{k}", Pose)
        writer.write(f"a{k}", pose(1), seq=0)
        writer.write_firings(f"operator{k}", 1, b"record")
    writer.flush()

    assert len(writes) == 2  # the header, and everything else
    with Recording(tmp_path / "many.mcap") as recording:
        assert recording.metadata["graph"] == {"text": "graph: g"}
        assert len(list(recording.messages())) == 12
    writer.close()


def test_declarations_of_a_failed_write_are_not_in_the_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "full.mcap"
    writer = RecordingWriter(path, metadata={"graph": {"text": "graph: g"}})
    writer.add_stream("kept", Pose)
    writer.write("kept", pose(1), seq=0)
    writer.flush()
    writer.add_stream("lost", Pose)
    writer.add_metadata("later", {"a": "b"})
    writer.write("lost", pose(1), seq=0)
    refuse_once(monkeypatch)
    with pytest.raises(RecordingError, match="No space left"):
        writer.flush()
    with pytest.raises(RecordingError, match="No space left"):
        writer.close()

    with Recording(path) as recording:
        assert not recording.torn
        assert list(recording.streams) == ["kept"]
        assert "later" not in recording.metadata
        assert recording.metadata["graph"] == {"text": "graph: g"}


def test_a_disk_without_room_for_the_digests_leaves_an_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "full.mcap"
    writer = RecordingWriter(path, metadata={})
    writer.add_stream("kept", Pose)
    writer.write("kept", pose(1), seq=0)
    writer.flush()
    refuse_once(monkeypatch)
    with pytest.raises(RecordingError, match="No space left"):
        writer.close()

    with Recording(path) as recording:
        assert not recording.torn
        assert len(list(recording.messages())) == 1


def test_a_file_size_limit_of_the_system_leaves_a_finished_file(tmp_path: Path) -> None:
    """A real refusal by the kernel; cutting the torn chunk off makes room for the index."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    path = tmp_path / "limited.mcap"
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, hard))
    try:
        error, taken = record_until_it_fails(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert "File too large" in str(error)
    with Recording(path) as recording:
        count = sum(1 for _ in recording.messages())
        assert not recording.torn
    assert taken - 5 <= count <= taken
    with path.open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count == count


def test_an_existing_file_is_not_overwritten_unasked(tmp_path: Path) -> None:
    path = tmp_path / "once.mcap"
    RecordingWriter(path, metadata={}).close()
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="exists already"):
        RecordingWriter(path, metadata={})
    assert path.read_bytes() == before
    RecordingWriter(path, metadata={}, overwrite=True).close()


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere.*No such file or directory"):
        RecordingWriter(tmp_path / "nowhere" / "a.mcap", metadata={})


def test_unknown_compression_is_refused_before_a_file_is_made(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="known: zstd, lz4, none"):
        RecordingWriter(tmp_path / "a.mcap", metadata={}, compression="gzip")
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_every_compression_reads_back(compression: Any, record: Callable[..., Path]) -> None:
    images = [Image(stamp=i, frame="c", data=noise(i, 40, 40)) for i in range(20)]
    path = record([("a", m) for m in images], compression=compression, chunk_bytes=5000)
    with Recording(path) as recording:
        assert [m.message for m in recording.messages()] == images


@pytest.mark.parametrize(
    ("message", "seq", "incarnation", "complaint"),
    [
        (pose(-1), 5, 0, "before the epoch"),
        (pose(10), 5, 0, "must increase"),  # the stamp of the message before
        (pose(11), 4, 0, "must increase"),  # its number
        (pose(11), -1, 1, "must be ≥ 0"),
        (Image(stamp=11, frame="c", data=[[0]]), 5, 0, "holds Pose, got Image"),
    ],
    ids=["negative stamp", "same stamp", "same number", "negative number", "another type"],
)
def test_refused_messages_are_named_and_leave_the_recording_usable(
    message: Any, seq: int, incarnation: int, complaint: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={}) as writer:
        writer.add_stream("odometry/pose", Pose)
        writer.write("odometry/pose", pose(10), seq=4)
        with pytest.raises(RecordingError, match=complaint):
            writer.write("odometry/pose", message, seq=seq, incarnation=incarnation)
        writer.write("odometry/pose", pose(12), seq=5)
    with Recording(path) as recording:
        assert [(m.seq, m.stamp) for m in recording.messages()] == [(4, 10), (5, 12)]


def test_undeclared_and_twice_declared_streams_are_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", metadata={}) as writer:
        writer.add_stream("a", Pose)
        with pytest.raises(RecordingError, match="declared twice"):
            writer.add_stream("a", Pose)
        with pytest.raises(RecordingError, match="'b' is not declared; declared are: a"):
            writer.write("b", pose(1), seq=0)
        with pytest.raises(RecordingError, match="extra must not set kind"):
            writer.add_stream("c", Pose, extra={"kind": "mine"})


def test_incarnations_and_long_sequences_keep_their_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    rows = [(2**32 - 1, 0, 5), (2**32, 0, 6), (2**33 + 3, 0, 7), (0, 2, 1), (1, 2, 2)]
    with RecordingWriter(path, metadata={}) as writer:
        writer.add_stream("a", Pose)
        for seq, incarnation, stamp in rows:
            writer.write("a", pose(stamp).replace(child_frame=f"base_{seq}"), seq=seq, incarnation=incarnation)
    with Recording(path) as recording:
        read = list(recording.messages())
        assert [(m.seq, m.incarnation, m.stamp) for m in read] == rows
        assert [m.message.child_frame for m in read] == [f"base_{seq}" for seq, _, _ in rows]
        assert recording.streams["a"].incarnations == 2


def test_firings_events_and_metadata_come_back(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={"graph": {"text": "graph: g", "name": "g"}}, namespace="robot1") as writer:
        writer.add_stream("robot1/a/pose", Pose)
        writer.write_firings("a", -(2**63), b"\x81setup")
        writer.write("robot1/a/pose", pose(50), seq=0)
        writer.write_firings("b", 60, b"one")
        writer.write_firings("a", 2**63 - 1, b"finish")
        writer.write_event("gap", 55, {"stream": "robot1/a/pose", "from": 3, "to": 9})
        writer.add_metadata("graph", {"name": "h"})
        writer.add_metadata("ends", {"robot1/a/pose": "50"})
        with pytest.raises(RecordingError, match="written by the recording itself"):
            writer.add_metadata("digests", {})
        with pytest.raises(RecordingError, match="JSON values"):
            writer.write_event("gap", 55, {"bad": {1, 2}})
    with Recording(path) as recording:
        assert list(recording.firings()) == [("a", b"\x81setup"), ("b", b"one"), ("a", b"finish")]
        assert list(recording.firings("b")) == [("b", b"one")]
        assert recording.firing_batches() == {"a": 2, "b": 1}
        [event] = recording.events()
        assert (event.name, event.stamp, event.data["to"]) == ("gap", 55, 9)
        assert recording.metadata["graph"] == {"text": "graph: g", "name": "h"}
        assert recording.metadata["ends"] == {"robot1/a/pose": "50"}
        assert list(recording.streams) == ["robot1/a/pose"]
    with path.open("rb") as file:
        topics = {c.topic for _, c, _ in make_reader(file).iter_messages()}
    assert topics == {"robot1/a/pose", "robot1/@/firings/a", "robot1/@/firings/b", "robot1/@/events"}


def test_firing_records_and_events_lie_apart_from_the_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={}, chunk_bytes=500) as writer:
        writer.add_stream("a/out/pose", Pose)
        for seq in range(40):
            writer.write("a/out/pose", pose(seq + 1), seq=seq)
            writer.write_firings(f"op{seq % 3}", seq + 1, bytes([seq]))
            if seq % 10 == 0:
                writer.write_event("gap", seq + 1, {})
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    kinds = {c.id: c.metadata["kind"] for c in summary.channels.values()}
    held = [{kinds[channel] for channel in index.message_index_offsets} for index in summary.chunk_indexes]
    assert len(held) > 6
    assert all(kinds == {"stream"} or kinds <= {"firings", "events"} for kinds in held)
    data = bytearray(path.read_bytes())
    for index, kinds_of_chunk in zip(summary.chunk_indexes, held, strict=True):
        if kinds_of_chunk == {"stream"}:
            data[index.chunk_start_offset + index.chunk_length - 1] ^= 1
    path.write_bytes(data)
    with Recording(path) as recording:  # read without the chunks of messages, which are destroyed
        assert list(recording.firings()) == [(f"op{seq % 3}", bytes([seq])) for seq in range(40)]
        assert [e.stamp for e in recording.events()] == [1, 11, 21, 31]
        with pytest.raises(RecordingError, match="chunk"):
            list(recording.messages())


def test_a_recording_cut_anywhere_holds_no_message_without_the_record_before_it(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={}, chunk_bytes=600) as writer:
        writer.add_stream("a/out/pose", Pose)
        for seq in range(60):
            writer.write_firings("a", seq + 1, bytes([seq]))
            writer.write("a/out/pose", pose(seq + 1), seq=seq)
    whole = path.read_bytes()
    for cut in range(8, len(whole), 97):
        path.write_bytes(whole[:cut])
        with Recording(path) as recording:
            records = [payload[0] for _, payload in recording.firings()]
            messages = [m.seq for m in recording.messages()]
        assert records == list(range(len(records)))
        assert messages == list(range(len(messages)))
        assert len(messages) <= len(records)


def test_a_message_that_readers_would_refuse_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(container, "MAX_CHUNK_BYTES", 10_000)
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={}) as writer:
        writer.add_stream("a", Image)
        for seq in range(9):
            writer.write("a", Image(stamp=seq, frame="c", data=noise(seq, 60, 60)), seq=seq)
        with pytest.raises(RecordingError, match=r"a message of \d+ bytes; at most 10000 are recorded"):
            writer.write("a", Image(stamp=10, frame="c", data=noise(0, 200, 200)), seq=10)
        writer.write("a", Image(stamp=11, frame="c", data=noise(0, 60, 60)), seq=11)
    with Recording(path) as recording:
        assert [m.seq for m in recording.messages()] == [*range(9), 11]
    with path.open("rb") as file:
        assert max(index.uncompressed_size for index in make_reader(file).get_summary().chunk_indexes) <= 10_000


def test_the_same_calls_write_the_same_bytes(record: Callable[..., Path]) -> None:
    rows = [("a", pose(i)) for i in range(5)]
    assert record(rows, name="one.mcap").read_bytes() == record(rows, name="two.mcap").read_bytes()


def test_close_is_idempotent_and_ends_writing(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", metadata={})
    writer.add_stream("a", Pose)
    writer.close()
    writer.close()
    with pytest.raises(RecordingError, match="closed"):
        writer.write("a", pose(1), seq=0)


@pytest.mark.long
def test_the_index_of_a_long_run_takes_no_more_memory_than_its_bytes(tmp_path: Path) -> None:
    streams = [f"s/{i}" for i in range(20)]

    def chunks(writer: RecordingWriter, first: int, count: int) -> None:
        for seq in range(first, first + count):
            for stream in streams:
                writer.write(stream, pose(1000 + seq), seq=seq)
            writer.flush()

    with RecordingWriter(tmp_path / "long.mcap", metadata={}) as writer:
        for stream in streams:
            writer.add_stream(stream, Pose)
        chunks(writer, 0, 10)
        tracemalloc.start()
        before, _ = tracemalloc.get_traced_memory()
        chunks(writer, 10, 200)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert (after - before) / 200 < 2 * (len(streams) * 10 + 100)  # an entry of the index: 10 bytes a channel, and more


def test_a_topic_without_a_schema_is_kept_without_one(tmp_path: Path) -> None:
    path = tmp_path / "kept.mcap"
    with RecordingWriter(path, metadata={}) as writer:
        writer.add_untouched("/raw", "x-bytes", SchemaText("", "", b""), {})
        writer.add_untouched("/typed", "json", SchemaText("other.Type", "jsonschema", b"{}"), {})
        writer.write_untouched("/raw", 5, b"as it was")
    with path.open("rb") as file:
        reader = make_reader(file)
        ((schema, channel, message),) = reader.iter_messages(["/raw"])

    assert schema is None
    assert (channel.schema_id, channel.message_encoding, message.data) == (0, "x-bytes", b"as it was")
