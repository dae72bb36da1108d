"""Files made to do harm: each costs little memory and time, and ends in an error that names the file and the place."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from dataflow.recording import Recording
from dataflow.recording.mcap import contents

MAGIC = b"\x89MCAP0\r\n"
LIMIT_S = 30
OPEN = """
import resource, sys, time
from dataflow.recording import Recording, RecordingError, describe
resource.setrlimit(resource.RLIMIT_AS, (2 * 10**9, 2 * 10**9))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    with Recording(sys.argv[1]) as recording:
        describe(recording)
        count = sum(1 for _ in recording.raw())
        lacking = (*recording.damage, *recording.lacking)
    print("; ".join([f"read {count} messages", *lacking]))
except RecordingError as error:
    print("error", error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


HEADER = record(1, text("") + text("made by hand"))
SCHEMA = record(3, struct.pack("<H", 1) + text("x") + text("jsonschema") + struct.pack("<I", 2) + b"{}")


def channel(number: int = 1, topic: str = "t/x") -> bytes:
    return record(4, struct.pack("<HH", number, 1) + text(topic) + text("json") + struct.pack("<I", 0))


def message(time: int = 1, data: bytes = b"{}") -> bytes:
    return record(5, struct.pack("<HIQQ", 1, 0, time, time) + data)


def metadata(name: str, values: dict[str, str]) -> bytes:
    body = b"".join(text(key) + text(value) for key, value in values.items())
    return record(12, text(name) + struct.pack("<I", len(body)) + body)


def chunk(packed: bytes, size: int, compression: str = "zstd", crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 9, size, crc) + text(compression) + struct.pack("<Q", len(packed))
    return record(6, head + packed)


def message_index(entries: Iterable[tuple[int, int]], number: int = 1) -> bytes:
    body = b"".join(struct.pack("<QQ", *entry) for entry in entries)
    return record(7, struct.pack("<HI", number, len(body)) + body)


def chunk_index(start: int, length: int, offsets: dict[int, int], index_length: int, size: int = 0) -> bytes:
    table = b"".join(struct.pack("<HQ", *pair) for pair in offsets.items())
    head = struct.pack("<QQQQ", 0, 9, start, length) + struct.pack("<I", len(table)) + table
    return record(8, head + struct.pack("<Q", index_length) + text("") + struct.pack("<QQ", 0, size))


DATA_END = record(15, struct.pack("<I", 0))


def ending(summary_start: int = 0) -> bytes:
    return record(2, struct.pack("<QQI", summary_start, 0, 0)) + MAGIC


BEGIN = MAGIC + HEADER + SCHEMA + channel()


def unindexed(*records: bytes) -> bytes:
    return BEGIN + b"".join(records) + DATA_END + ending()


def indexed(data: bytes, summary: bytes) -> bytes:
    start = len(BEGIN) + len(data) + len(DATA_END)
    return BEGIN + data + DATA_END + SCHEMA + channel() + summary + ending(start + 0)


def zeros_packed(size: int, head: bytes = b"") -> bytes:
    """A zstd frame of `head` and zeros that states its size."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=size)
    parts = [packer.compress(head), packer.compress(bytes((size - len(head)) % 2**20))]
    parts += [packer.compress(bytes(2**20)) for _ in range((size - len(head)) // 2**20)]
    return b"".join([*parts, packer.flush()])


def frame_that_states_more_than_the_chunk() -> bytes:
    return unindexed(chunk(zeros_packed(2**32), 1000))


def frame_header_that_lies() -> bytes:
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 200 << 30)
    return unindexed(chunk(frame + zstandard.compress(bytes(1000))[9:], 1000))


def giant_message_in_every_chunk() -> bytes:
    size = 2**30
    head = struct.pack("<BQHIQQ", 5, size - 9, 1, 0, 1, 1)
    return unindexed(chunk(zeros_packed(size, head), size) * 6)


def chunks_that_expand_without_end() -> bytes:
    size = 2**29
    head = struct.pack("<BQHIQQ", 5, size - 9, 1, 0, 1, 1)
    return unindexed(chunk(zeros_packed(size, head), size) * 60)


def large_chunks_with_an_index() -> bytes:
    size = 2**29 - 2**20
    head = struct.pack("<BQHIQQ", 5, size - 9, 1, 0, 1, 1)
    return unindexed((chunk(zeros_packed(size, head), size) + message_index([(1, 0)])) * 6)


def zeros_in_lz4() -> bytes:
    return unindexed(chunk(lz4.frame.compress(bytes(2**27)), 2**27, "lz4") * 30)


def the_largest_lz4_chunk() -> bytes:
    return unindexed(chunk(lz4.frame.compress(bytes(2**29)), 2**29, "lz4"))


def lz4_that_expands_beyond_the_chunk() -> bytes:
    return unindexed(chunk(lz4.frame.compress(bytes(2**30)), 1000, "lz4"))


def chunk_indexes_that_share_a_message_index() -> bytes:
    empty = chunk(b"", 0, "")
    index = message_index([(5, 0)] * 60_000)
    at = len(BEGIN)
    one = chunk_index(at, len(empty), {1: at + len(empty)}, len(index))
    return indexed(empty + index, one * 3000)


def channels_that_share_a_message_index() -> bytes:
    empty = chunk(b"", 0, "")
    index = message_index([(5, 0)] * 60_000)
    at = len(BEGIN)
    shared = dict.fromkeys(range(1, 60_000), at + len(empty))
    return indexed(empty + index, chunk_index(at, len(empty), shared, len(index)))


def metadata_indexes_that_share_a_record() -> bytes:
    one = metadata("m", {"a": "x" * 2**20})
    index = record(13, struct.pack("<QQ", len(BEGIN), len(one)) + text("m"))
    return indexed(one, index * 10_000)


def tiny_records_in_a_chunk() -> bytes:
    body = record(0x80, b"") * 10**5
    return unindexed(*[chunk(zstandard.compress(body), len(body))] * 5)


def many_metadata_records() -> bytes:
    return unindexed(metadata("m", {"a": "b"}) * 3 * 10**5)


def summary_that_is_the_whole_file() -> bytes:
    return BEGIN + record(0x80, b"\0" * 1000) * 10_000 + ending(8)


def many_records_of_no_length() -> bytes:
    return unindexed(record(0x80, b"") * 10**5 + message())


def many_messages() -> bytes:
    return unindexed(message() * 10**5)


def attachments_and_long_strings() -> bytes:
    attachment = record(9, struct.pack("<QQ", 0, 0) + text("a") + text("b") + struct.pack("<Q", 2**26) + bytes(2**26))
    return unindexed(attachment, metadata("m", {"k": "v" * 2**24}), channel(2, "t/" + "x" * 2**24), message())


def string_longer_than_the_file() -> bytes:
    return unindexed(record(12, struct.pack("<I", 2**32 - 1) + b"m"))


def opened(path: Path, content: bytes) -> tuple[str, int]:
    """Reads a file in a process of its own, with limits: what that says, and the megabytes that it took."""
    path.write_bytes(content)
    done = subprocess.run(
        [sys.executable, "-c", OPEN, str(path)], capture_output=True, text=True, timeout=LIMIT_S, check=True
    )
    said, megabytes = done.stdout.splitlines()
    return said, int(megabytes)


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (frame_that_states_more_than_the_chunk, "chunk 0 at byte {chunk} states 1000 bytes, its zstd frame 4294"),
        (frame_header_that_lies, "chunk 0 at byte {chunk} states 1000 bytes, its zstd frame 214748364800"),
        (giant_message_in_every_chunk, "chunk 0 at byte {chunk} states 1073741824 bytes, at most 536870912"),
        (chunks_that_expand_without_end, "expand from"),
        (zeros_in_lz4, "has no whole record at its byte 0"),
        (the_largest_lz4_chunk, "chunk 0 at byte {chunk} has no whole record at its byte 0"),
        (lz4_that_expands_beyond_the_chunk, "chunk 0 at byte {chunk} does not hold the 1000 bytes"),
        (chunk_indexes_that_share_a_message_index, "read 0 messages"),
        (channels_that_share_a_message_index, "read 0 messages"),
        (metadata_indexes_that_share_a_record, "read 0 messages"),
        (tiny_records_in_a_chunk, "read 0 messages"),
        (many_metadata_records, "is beyond the 262144 that are read"),
        (summary_that_is_the_whole_file, "read 0 messages"),
        (many_records_of_no_length, "read 1 messages"),
        (many_messages, "read 100000 messages"),
        (attachments_and_long_strings, "read 1 messages"),
        (string_longer_than_the_file, "Metadata record at byte {record} cannot be read"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_a_file_made_to_do_harm_costs_little_and_is_named(
    make: Callable[[], bytes], expected: str, tmp_path: Path
) -> None:
    said, megabytes = opened(tmp_path / "hostile.mcap", make())
    assert expected.format(chunk=len(BEGIN) + 9, record=len(BEGIN)) in said
    assert said.startswith("read") or "hostile.mcap" in said
    assert megabytes < 850


@pytest.mark.long
def test_large_messages_of_next_to_nothing_take_the_memory_of_three_at_a_time(tmp_path: Path) -> None:
    said, megabytes = opened(tmp_path / "hostile.mcap", large_chunks_with_an_index())

    assert said == "read 6 messages"
    assert megabytes < 1600


def test_checksums_of_chunks_are_held_against_them(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    data = message()
    for crc, expected in ((zlib.crc32(data), "read 1 messages"), (1, "chunk 0 at byte")):
        path.write_bytes(unindexed(chunk(data, len(data), "", crc)))
        done = subprocess.run([sys.executable, "-c", OPEN, str(path)], capture_output=True, text=True, timeout=LIMIT_S)
        assert expected in done.stdout


@pytest.mark.parametrize("records", [message() * 1001, record(0x80, b"") * 1001])
def test_the_records_read_without_an_index_are_bounded(
    records: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contents, "UNINDEXED_RECORDS", 1000)
    monkeypatch.setattr(contents, "BYTES_PER_RECORD", 2**30)
    path = tmp_path / "a.mcap"
    path.write_bytes(unindexed(chunk(records, len(records), "")))
    with Recording(path) as recording:
        assert any("there were more than the 1000 records" in note for note in recording.damage)
        assert "a.mcap: chunks that cannot be read" in recording.lacking[0]
