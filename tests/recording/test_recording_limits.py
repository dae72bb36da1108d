"""The writer and the reader keep to one table: what is at a limit reads back, what is beyond it is refused at once."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from made_recordings import recorded

from dataflow.messages import FeatureVector, Image
from dataflow.recording import Recording, RecordingError, RecordingWriter, limits
from dataflow.recording.mcap.attachments import Attachment
from dataflow.recording.mcap.container import ContainerWriter
from dataflow.recording.mcap.index import McapFile
from dataflow.records.firing import MAX_STATE_BYTES, FiringRecord, encode_batch

LIMITS = {"MAX_CHUNK_BYTES": 20_000, "MAX_RECORD_BYTES": 10_000, "MAX_CHUNK_MESSAGES": 50, "MAX_PARSED": 60}
HEAD = 31
"""Bytes of a message beside its data."""


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the limits small in every module that holds to them: files at them are then quickly written."""
    for name, module in list(sys.modules.items()):
        if name.startswith("dataflow.recording."):
            for limit in LIMITS.keys() & vars(module).keys():
                monkeypatch.setattr(module, limit, LIMITS[limit])


def opened(path: Path) -> ContainerWriter:
    return ContainerWriter(path, library="robot-dataflow/0", chunk_bytes=10**9, chunk_seconds=1e9)


@pytest.mark.parametrize("kind", ["message", "record", "copied"])
def test_a_message_of_the_largest_size_reads_back(kind: str, tmp_path: Path) -> None:
    path, most = tmp_path / "a.mcap", LIMITS["MAX_CHUNK_BYTES"] - HEAD
    writer = opened(path)
    channel = writer.add_channel("t", "json", 0, {})
    add = {
        "message": lambda data: writer.add_messages([(channel, 1, 0, [data])]),
        "record": lambda data: writer.add_record(channel, 1, 0, data),
        "copied": lambda data: writer.add_copied(channel, 1, 1, 0, data),
    }[kind]
    with pytest.raises(RecordingError, match=r"a (message|record) of 20001 bytes; at most 20000 are recorded"):
        add(bytes(most + 1))
    for _ in range(3):
        add(bytes(most))
    writer.close()
    with Recording(path) as recording:
        assert [len(raw.data) for raw in recording.raw()] == [most] * 3
        assert not recording.damage


def test_a_schema_a_channel_and_metadata_of_the_largest_size_read_back(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = opened(path)
    for what, add, beside in (
        ("schema 's'", lambda n: writer.add_schema("s", "jsonschema", bytes(n)), 8 + 9 + 2 + 5 + 14 + 4),
        ("channel 't'", lambda n: writer.add_channel("t", "json", 1, {"k": "v" * n}), 8 + 9 + 4 + 5 + 8 + 4 + 5 + 4),
        ("metadata 'm'", lambda n: writer.add_metadata("m", {"k": "v" * n}), 8 + 9 + 5 + 4 + 5 + 4),
    ):
        most = LIMITS["MAX_RECORD_BYTES"] - beside
        with pytest.raises(RecordingError, match=f"{what} of 10001 bytes; at most 10000 are recorded"):
            add(most + 1)
        add(most)
    writer.add_messages([(1, 1, 0, [b"{}"])])
    writer.close()
    for content in (path.read_bytes(), path.read_bytes()[:-1]):  # by its summary, and by a pass
        path.write_bytes(content)
        with closing(McapFile(path)) as file:
            assert len(file.schemas[1].data) > 9_900
            assert len(file.channels[1].metadata["k"]) > 9_900
            assert len(dict(file.metadata)["m"]["k"]) > 9_900
            assert not file.damage


def test_an_attachment_of_the_largest_size_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    most = LIMITS["MAX_CHUNK_BYTES"] - (9 + 16 + 4 + 1 + 4 + 1 + 8 + 4)
    writer = opened(path)
    with pytest.raises(RecordingError, match="attachment 'a' of 20001 bytes; at most 20000 are recorded"):
        writer.add_attachment(Attachment("a", "b", 0, 0, bytes(most + 1)))
    writer.add_attachment(Attachment("a", "b", 0, 0, bytes(most)))
    writer.close()
    with Recording(path) as recording:
        assert [len(attachment.data) for attachment in recording.attachments()] == [most]


def test_a_chunk_ends_with_its_most_messages_so_that_its_index_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = opened(path)
    channel = writer.add_channel("t", "json", 0, {})
    for k in range(120):
        writer.add_messages([(channel, k, k, [b""])])
    writer.close()
    with Recording(path) as recording:
        assert [raw.log_time for raw in recording.raw()] == list(range(120))
    with closing(McapFile(path)) as file:
        assert np.bincount(file.index.entries(channel).chunks).tolist() == [50, 50, 20]


def test_a_recording_holds_as_many_metadata_records_as_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = opened(path)
    for k in range(LIMITS["MAX_PARSED"]):
        writer.add_metadata(f"m{k}", {})
    with pytest.raises(RecordingError, match="at most 60 schemas, channels, metadata and attachments"):
        writer.add_metadata("one more", {})
    writer.close()
    for content in (path.read_bytes(), path.read_bytes()[:-1]):
        path.write_bytes(content)
        with closing(McapFile(path)) as file:
            assert len(file.metadata) == LIMITS["MAX_PARSED"]


@pytest.mark.long
def test_dark_images_beyond_any_ratio_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Volumes, cost maps and dark frames: what together expanded more than 50-fold beyond 768 MiB was refused."""
    monkeypatch.undo()
    dark = Image(stamp=1, frame="c", data=np.zeros((8200, 8200), np.uint8))
    path = recorded(tmp_path / "a.mcap", [("g/s/x", dark.replace(stamp=k + 1)) for k in range(13)])
    assert path.stat().st_size < 100_000
    with Recording(path) as recording:
        assert sum(1 for _ in recording.raw()) == 13
        assert recording.streams["g/s/x"].message_type is Image
    path.write_bytes(path.read_bytes()[:-1])
    with Recording(path) as recording:
        assert recording.torn
        assert sum(1 for _ in recording.raw()) == 13


def test_a_stream_in_a_damaged_recording_may_expand_as_it_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Our writer's chunks are read whatever their ratio, where a damaged index has all of them be read."""
    for name, module in list(sys.modules.items()):
        if name.startswith("dataflow.recording.") and "UNINDEXED_BYTES" in vars(module):
            monkeypatch.setattr(module, "UNINDEXED_BYTES", 10_000)
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={}) as writer:
        writer.add_stream("g/s/x", FeatureVector)
        for k in range(6):
            vectors = np.zeros((1, 2000), np.float32)
            writer.write("g/s/x", FeatureVector(stamp=k + 1, vectors=vectors, model=""), seq=k)
            writer.flush()
    data = bytearray(path.read_bytes())
    data[data.rindex(b"g/s/x")] ^= 1  # in the summary
    path.write_bytes(data)
    with Recording(path) as recording:
        assert recording.damage
        assert sum(1 for _ in recording.messages()) == 6


def test_a_state_of_the_largest_size_fits_into_a_record(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    beside = len(encode_batch([FiringRecord("o" * 200, 0, 2**40, "snapshot", 2**62, detail={"state": b""})]))
    assert MAX_STATE_BYTES + beside + HEAD <= limits.MAX_CHUNK_BYTES
    assert limits.MAX_CHUNK_BYTES - MAX_STATE_BYTES <= 2**16
