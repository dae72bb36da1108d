"""Damaged bags: what damage took is passed over and counted, the rest is read; `strict` refuses."""

from __future__ import annotations

import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
import zstandard
from made_bags import ROS1, SECOND, imus, write_ros2
from made_recordings import foreign
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Writer1

from dataflow.interop.bag import BagError, shortfalls
from dataflow.interop.opening import open_bag
from dataflow.recording import RecordingError

STAMPS = [1_700_000_000 * SECOND + i * SECOND // 100 for i in range(300)]


def held(path: Path, *, strict: bool = False) -> tuple[list[bytes], list[str]]:
    """Messages of all topics in their order, and what is said to be missing."""
    with closing(open_bag(path, strict=strict)) as bag:
        return [bytes(stored.data) for stored in bag.messages(list(bag.topics))], shortfalls(bag)


def mcap_of(path: Path, compression: CompressionType = CompressionType.ZSTD) -> Path:
    """300 messages in some 10 chunks."""
    messages = [(stamp, b'{"number": %d, "text": "%s"}' % (i, b"abcdefgh" * 10)) for i, stamp in enumerate(STAMPS)]
    any_ = ("/any", "json", ("any", "jsonschema", b"{}"), messages)
    return foreign(path, any_, chunk_size=4096, compression=compression)


def chunk_of(path: Path, number: int) -> tuple[int, int, int]:
    """Where a chunk begins, its bytes, and how many messages are in it."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        chunk = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)[number]
        messages = make_reader(file).iter_messages()
        times = range(chunk.message_start_time, chunk.message_end_time + 1)
        return chunk.chunk_start_offset, chunk.chunk_length, sum(m.log_time in times for _, _, m in messages)


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0xFF
    path.write_bytes(data)


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_a_damaged_chunk_costs_its_own_messages(tmp_path: Path, compression: CompressionType) -> None:
    whole, _ = held(mcap_of(tmp_path / "a.mcap", compression))
    start, length, number = chunk_of(tmp_path / "a.mcap", 3)
    flip(tmp_path / "a.mcap", start + length * 2 // 3)

    found, missing = held(tmp_path / "a.mcap")

    assert len(found) == 300 - number
    assert set(found) < set(whole)
    assert [f"/any: {number} messages lost to damage: a.mcap, chunk 3" in text for text in missing] == [True]
    with pytest.raises(RecordingError, match=r"a\.mcap.*chunk 3 at byte"):
        held(tmp_path / "a.mcap", strict=True)


def test_a_damaged_chunk_that_nothing_indexes_is_passed_over(tmp_path: Path) -> None:
    start, length, number = chunk_of(mcap_of(tmp_path / "a.mcap"), 3)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[start + length // 2] ^= 0xFF
    footer = len(data) - 8 - 20
    data[footer : footer + 20] = bytes(20)  # no summary
    (tmp_path / "a.mcap").write_bytes(data)

    found, missing = held(tmp_path / "a.mcap")

    assert len(found) == 300 - number
    assert len(missing) == 1
    with pytest.raises(RecordingError):
        held(tmp_path / "a.mcap", strict=True)


def database(tmp_path: Path) -> Path:
    return write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3") / "bag.db3"


def page_of(path: Path, kind: int) -> int:
    """The start of a page in the middle of the file that is of a kind: 13 a leaf of a table, 10 one of an index."""
    data = path.read_bytes()
    (size,) = struct.unpack_from(">H", data, 16)
    pages = [p for p in range(size, len(data), size) if data[p] == kind]
    return pages[len(pages) // 2]


def test_a_damaged_page_of_a_database_costs_its_own_rows(tmp_path: Path) -> None:
    file = database(tmp_path)
    whole, _ = held(file)
    at = page_of(file, 13)
    data = bytearray(file.read_bytes())
    rows = int.from_bytes(data[at + 3 : at + 5], "big")
    data[at : at + 64] = b"\xee" * 64
    file.write_bytes(data)
    with sqlite3.connect(file) as judge, pytest.raises(sqlite3.DatabaseError):
        judge.execute("select count(*), max(length(data)) from messages").fetchall()

    found, missing = held(file)

    assert len(found) == 300 - rows > 200
    assert set(found) < set(whole)
    assert any(f"missing: {rows}" in text for text in missing)
    assert any("300 messages are promised" in text for text in held(file.parent)[1])
    with pytest.raises(BagError, match=r"dataflow recover .*bag\.db3"):
        held(file, strict=True)


def test_a_database_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    file = database(tmp_path)
    whole, _ = held(file)
    cut(file, 2 / 3)

    found, missing = held(file.parent)

    assert 100 < len(found) < 300
    assert found == [data for data in whole if data in set(found)]
    assert missing


def ros1_bag(path: Path, compression: Writer1.CompressionFormat | None = None, chunk_bytes: int = 2000) -> Path:
    writer = Writer1(path)
    writer.chunk_threshold = chunk_bytes
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = [writer.add_connection(t, "std_msgs/msg/String", typestore=ROS1) for t in ("/a", "/b")]
        for i, stamp in enumerate(STAMPS):
            text = ROS1.types["std_msgs/msg/String"](data=f"number {i} {'x' * (i * 7919 % 60)}")
            writer.write(connections[i % 2], stamp, ROS1.serialize_ros1(text, "std_msgs/msg/String"))
    return path


PACKED = [Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4]


@pytest.mark.parametrize("compression", PACKED)
def test_a_damaged_chunk_of_a_ros_1_bag_costs_its_own_messages(
    tmp_path: Path, compression: Writer1.CompressionFormat
) -> None:
    file = ros1_bag(tmp_path / "a.bag", compression)
    whole, missing = held(file)
    assert not missing
    chunks = [found.start() for found in re.finditer(b"op=\x05", file.read_bytes())]
    flip(file, chunks[2] + 150)

    found, missing = held(file)

    assert 200 < len(found) < 300
    assert found == [data for data in whole if data in set(found)]
    by_topic = [re.search(r"(\d+) messages lost", text) for text in missing]
    assert sum(int(topic[1]) for topic in by_topic if topic) == 300 - len(found)
    with pytest.raises(BagError, match=r"dataflow recover .*a\.bag"):
        held(file, strict=True)


def test_a_broken_record_in_a_plain_chunk_of_a_ros_1_bag_costs_one_message(tmp_path: Path) -> None:
    file = ros1_bag(tmp_path / "a.bag")
    whole, _ = held(file)
    at = file.read_bytes().index(b"op=\x02", file.stat().st_size // 2)
    flip(file, at)

    found, missing = held(file)

    assert len(found) == 299
    assert found == [data for data in whole if data in set(found)]
    assert any("1 message lost" in text for text in missing)


@pytest.mark.parametrize("compression", [None, *PACKED])
def test_a_ros_1_bag_that_was_cut_off_is_read_as_far_as_it_goes(
    tmp_path: Path, compression: Writer1.CompressionFormat | None
) -> None:
    file = ros1_bag(tmp_path / "a.bag", compression)
    whole, _ = held(file)
    cut(file, 0.6)

    found, _ = held(file)

    assert 100 < len(found) < 300
    assert found == whole[: len(found)]
    with pytest.raises(BagError, match="dataflow recover"):
        held(file, strict=True)


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_a_compressed_file_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path, suffix: str) -> None:
    rows = imus([STAMPS[0] + i * SECOND // 100 for i in range(1500)])
    folder = write_ros2(tmp_path / "bag", rows, "sqlite3" if suffix == ".db3" else "mcap")
    whole = (folder / f"bag{suffix}").read_bytes()
    packed = zstandard.ZstdCompressor().compress(whole)
    (tmp_path / f"a{suffix}.zstd").write_bytes(packed)
    assert len(held(tmp_path / f"a{suffix}.zstd")[0]) == 1500
    cut(tmp_path / f"a{suffix}.zstd", 0.7)

    found, missing = held(tmp_path / f"a{suffix}.zstd")

    assert 200 < len(found) < 1500
    assert any("is not a whole zstd file" in text for text in missing)
    with pytest.raises(BagError, match="not a whole zstd file"):
        held(tmp_path / f"a{suffix}.zstd", strict=True)


def two_parts(tmp_path: Path, suffix: str) -> Path:
    (tmp_path / "all").mkdir()
    for part in range(2):
        rows = imus(STAMPS[part * 150 : part * 150 + 150])
        folder = write_ros2(tmp_path / f"part{part}", rows, "sqlite3" if suffix == ".db3" else "mcap")
        (folder / f"part{part}{suffix}").rename(tmp_path / "all" / f"all_{part}{suffix}")
    return tmp_path / "all"


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
@pytest.mark.parametrize("broken", [lambda data: b"", lambda data: bytes(len(data))])
def test_a_part_of_which_nothing_is_left_is_left_out(
    tmp_path: Path, suffix: str, broken: Callable[[bytes], bytes]
) -> None:
    folder = two_parts(tmp_path, suffix)
    assert len(held(folder)[0]) == 300
    part = folder / f"all_1{suffix}"
    part.write_bytes(broken(part.read_bytes()))

    found, missing = held(folder)

    assert len(found) == 150
    assert [f"all_1{suffix} is left out" in text for text in missing] == [True]
    with pytest.raises(RecordingError, match=rf"all_1\{suffix}"):
        held(folder, strict=True)


@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_a_download_whose_second_half_is_zeros_is_read_and_fails_the_command(tmp_path: Path, suffix: str) -> None:
    rows = imus([STAMPS[0] + i * SECOND // 100 for i in range(1500)])
    if suffix == ".bag":
        file = ros1_bag(tmp_path / "a.bag")
    elif suffix == ".db3":
        file = write_ros2(tmp_path / "bag", rows, "sqlite3") / "bag.db3"
    else:
        file = mcap_of(tmp_path / "a.mcap", CompressionType.NONE)
    data = file.read_bytes()
    whole, _ = held(file)
    file.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))

    with closing(open_bag(file)) as bag:
        found = [bytes(stored.data) for stored in bag.messages(list(bag.topics))]

    assert len(whole) // 4 < len(found) < len(whole)
    assert sum(data not in whole for data in found) <= 1  # the one in which the zeros begin: it has no checksum
    assert shortfalls(bag) or any("no proper end" in note for note in bag.notes)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"\x89MCAP0\r\r\n\x01" + bytes(60), "a transfer as text has changed"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n", "pointer of Git LFS"),
        (b"<!DOCTYPE html><html><body>404", "page of the web"),
    ],
)
def test_file_that_is_no_bag_is_refused_with_what_it_holds(tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "a.mcap").write_bytes(content)

    with pytest.raises(BagError, match=told):
        open_bag(tmp_path / "a.mcap")
