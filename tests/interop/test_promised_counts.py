"""Counts that a bag promises against what came: databases, write-ahead logs, metadata, two types under one name."""

from __future__ import annotations

import gzip
import shutil
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
import zstandard
from exporting import exported
from made_bags import ROS1, ROS2, SECOND, imus, ros, transform, write_ros1, write_ros2
from made_recordings import foreign
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from dataflow.interop.bag import Bag, BagError, shortfalls, surpluses
from dataflow.interop.export.foxglove import export_foxglove
from dataflow.interop.export.own import export_own
from dataflow.interop.export.report import Exported
from dataflow.interop.export.ros2 import export_ros2
from dataflow.interop.export.source import ExportSource
from dataflow.interop.opening import open_bag

STAMPS = [1_700_000_000 * SECOND + i * SECOND // 100 for i in range(20)]


Opened = Callable[[Path], Bag]


@pytest.fixture
def opened() -> Iterator[Opened]:
    """Opens bags, which are closed at the end."""
    with ExitStack() as stack:
        yield lambda path: stack.enter_context(closing(open_bag(path)))


def counted(path: Path) -> dict[str, int]:
    """Messages by topic, as they come."""
    with closing(open_bag(path)) as bag:
        found = dict.fromkeys(bag.topics, 0) | Counter(stored.topic for stored in bag.messages(list(bag.topics)))
        assert found == {name: topic.count for name, topic in bag.topics.items()}
    return found


def write_mcap(path: Path, rows: list[tuple[str, int, Any]]) -> None:
    """An MCAP of ROS 2 messages, whatever their topics are called."""
    topics = []
    for topic in dict.fromkeys(topic for topic, _, _ in rows):
        messages = [(time, message) for name, time, message in rows if name == topic]
        kind = messages[0][1].__msgtype__
        schema = (kind, "ros2msg", ROS2.generate_msgdef(kind, ros_version=2)[0].encode())
        data = [(time, bytes(ROS2.serialize_cdr(message, kind))) for time, message in messages]
        topics.append((topic, "cdr", schema, data))
    foreign(path, *topics, profile="ros2")


def changed(folder: Path, statement: str, *values: object) -> None:
    with sqlite3.connect(folder / f"{folder.name}.db3") as database:
        database.execute(statement, values)
    database.close()


@pytest.mark.parametrize("profiles", ["", "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n", "nonsense"])
def test_profiles_that_differ_between_metadata_and_database_lose_nothing(tmp_path: Path, profiles: str) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    changed(folder, "update topics set offered_qos_profiles = ?", profiles)

    assert counted(folder) == {"/imu": 20}


def test_messages_missing_from_the_database_are_reported(opened: Opened, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    changed(folder, "delete from messages where id > 12")

    bag = opened(folder)
    assert shortfalls(bag) == ["topic /imu: 20 messages are promised, 12 are there"]


@pytest.mark.parametrize("read_only", [False, True])
def test_write_ahead_log_of_a_killed_recorder_is_read(opened: Opened, tmp_path: Path, read_only: bool) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    database = sqlite3.connect(folder / "bag.db3")
    database.execute("pragma journal_mode=wal")
    database.execute("pragma wal_autocheckpoint=0")
    topic, data = database.execute("select topic_id, data from messages limit 1").fetchone()
    database.execute("insert into messages(topic_id, timestamp, data) values(?, ?, ?)", (topic, STAMPS[-1] + 1, data))
    database.commit()
    killed = tmp_path / "killed"
    shutil.copytree(folder, killed)
    database.close()
    (killed / "bag.db3-shm").unlink()
    if read_only:
        killed.chmod(0o500)

    bag = opened(killed)

    assert bag.topics["/imu"].count == 21
    assert any("bag.db3-wal" in note for note in bag.notes)
    killed.chmod(0o700)


def test_a_database_that_was_renamed_is_read_with_a_note(opened: Opened, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    (folder / "bag.db3").rename(folder / "other.db3")

    assert counted(folder) == {"/imu": 20}
    bag = opened(folder)
    assert bag.notes == ("metadata.yaml names bag.db3, which the folder lacks",)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("metadata", [True, False])
def test_files_compressed_as_a_whole_are_read(tmp_path: Path, storage: str, metadata: bool) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), storage)
    file = next(p for p in folder.iterdir() if p.suffix != ".yaml")
    file.with_name(f"{file.name}.zstd").write_bytes(zstandard.ZstdCompressor().compress(file.read_bytes()))
    file.unlink()
    if not metadata:
        (folder / "metadata.yaml").unlink()

    assert counted(folder) == {"/imu": 20}


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_messages_compressed_one_by_one_are_read(opened: Opened, tmp_path: Path, storage: StoragePlugin) -> None:
    rows = imus(STAMPS)
    kind = "sensor_msgs/msg/Imu"
    writer = Writer2(tmp_path / "bag", version=9, storage_plugin=storage)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/imu", kind, typestore=ROS2)
        for _, time, message in rows:
            writer.write(connection, time, ROS2.serialize_cdr(message, kind))

    bag = opened(tmp_path / "bag")

    assert [bytes(s.data) for s in bag.messages(["/imu"])] == [bytes(ROS2.serialize_cdr(m, kind)) for _, _, m in rows]


def test_split_databases_are_one_bag_in_the_order_of_log_times(opened: Opened, tmp_path: Path) -> None:
    rows = imus(STAMPS)
    first, second = write_ros2(tmp_path / "a", rows[10:], "sqlite3"), write_ros2(tmp_path / "b", rows[:10], "sqlite3")
    (first / "metadata.yaml").unlink()
    (first / "a.db3").rename(first / "run_1.db3")
    shutil.copy(second / "b.db3", first / "run_0.db3")

    bag = opened(first)

    assert [stored.log_time for stored in bag.messages(["/imu"])] == STAMPS


def test_metadata_that_are_no_yaml_are_noted_and_the_files_count(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    (folder / "metadata.yaml").write_text("rosbag2: [", encoding="utf-8")

    assert counted(folder) == {"/imu": 20}


def test_one_layout_under_two_names_is_one_topic_and_two_layouts_are_two(opened: Opened, tmp_path: Path) -> None:
    text = ROS1.types["std_msgs/msg/String"](data="x")
    with Writer1(tmp_path / "two.bag") as writer:
        first = writer.add_connection("/said", "std_msgs/msg/String", typestore=ROS1)
        same = writer.add_connection("/said", "old_msgs/msg/Text", msgdef=first.msgdef.data, md5sum=first.digest)
        other = writer.add_connection("/said", "std_msgs/msg/Float64", typestore=ROS1)
        for i in range(6):
            writer.write(same if i % 2 else first, STAMPS[i], ROS1.serialize_ros1(text, "std_msgs/msg/String"))
        number = ROS1.types["std_msgs/msg/Float64"](data=1.0)
        writer.write(other, STAMPS[7], ROS1.serialize_ros1(number, "std_msgs/msg/Float64"))

    assert counted(tmp_path / "two.bag") == {"/said": 6, "/said (std_msgs/msg/Float64)": 1}
    bag = opened(tmp_path / "two.bag")
    assert "two types" in bag.notes[0]
    assert shortfalls(bag) == surpluses(bag) == []


def test_a_file_without_tables_is_no_bag(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("create table other(id integer)")
    database.close()

    with pytest.raises(BagError, match="its tables are other"):
        open_bag(tmp_path / "a.db3")


def test_transforms_of_one_publisher_come_with_the_others(tmp_path: Path) -> None:
    rows = [("/tf", s, ros("tf2_msgs/TFMessage", transforms=[transform(s, "map", "base")])) for s in STAMPS]

    assert counted(write_ros2(tmp_path / "bag", rows, "sqlite3")) == {"/tf": 20}


def test_a_file_that_metadata_name_twice_is_read_once(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS))
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("  - bag.mcap\n", "  - bag.mcap\n  - bag.mcap\n", 1))

    assert counted(folder) == {"/imu": 20}


def test_more_messages_than_metadata_promise_are_noted_and_no_shortfall(opened: Opened, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS))
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("message_count: 20", "message_count: 4"))

    bag = opened(folder)
    assert bag.notes == ("topic /imu: 4 messages are promised, 20 are there",)
    assert not shortfalls(bag)


def test_a_missing_numbered_file_is_noted(opened: Opened, tmp_path: Path) -> None:
    for number in (0, 1, 3):
        part = write_ros2(tmp_path / f"drive_{number}", imus(STAMPS[number : number + 1]))
        (tmp_path / f"drive_{number}.mcap").write_bytes((part / f"drive_{number}.mcap").read_bytes())

    bag = opened(tmp_path)

    assert bag.notes == ("the files are numbered, and 2 is not there",)


def test_unfinished_transaction_of_a_killed_recorder_is_rolled_back(opened: Opened, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    before = (folder / "bag.db3").read_bytes()
    database = sqlite3.connect(folder / "bag.db3", isolation_level=None)
    database.execute("pragma cache_size = 2")  # pages go to the file before the end of the transaction
    database.execute("begin")
    database.execute("update messages set data = zeroblob(9000)")
    for name in ("bag.db3", "bag.db3-journal"):
        shutil.copyfile(folder / name, tmp_path / name)
    database.close()
    assert (tmp_path / "bag.db3").read_bytes() != before

    bag = opened(tmp_path / "bag.db3")

    sizes = [len(ROS2.serialize_cdr(message, message.__msgtype__)) for _, _, message in imus(STAMPS)]
    assert [len(stored.data) for stored in bag.messages(["/imu"])] == sizes
    assert bag.notes == ("bag.db3 was not closed by its recorder: what it wrote last is taken back",)


@pytest.mark.parametrize("column", ["timestamp", "data"])
def test_rows_that_are_no_messages_are_counted(opened: Opened, tmp_path: Path, column: str) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    changed(folder, f"update messages set {column} = ? where id = 3", "text")

    assert counted(folder) == {"/imu": 19}
    bag = opened(folder)
    assert bag.notes == ("bag.db3: rows without a whole time or bytes, which are no messages: 1",)
    assert shortfalls(bag)


def test_messages_that_are_zstd_frames_without_their_size_are_read(opened: Opened, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    packer = zstandard.ZstdCompressor(write_content_size=False)
    with sqlite3.connect(folder / "bag.db3") as database:
        for number, data in database.execute("select id, data from messages").fetchall():
            database.execute("update messages set data = ? where id = ?", (packer.compress(data), number))
    database.close()
    text = (folder / "metadata.yaml").read_text().replace("compression_mode: ''", "compression_mode: MESSAGE")
    (folder / "metadata.yaml").write_text(text.replace("compression_format: ''", "compression_format: zstd"))

    bag = opened(folder)

    message = imus(STAMPS)[0][2]
    assert next(iter(bag.messages(["/imu"]))).data == ROS2.serialize_cdr(message, message.__msgtype__)


def numbers(file: Path, values: range) -> None:
    write_ros1(file, [("/n", STAMPS[k], ros("std_msgs/Float64", ROS1, data=float(k))) for k in values])


def test_a_chunk_of_a_connection_that_the_bag_does_not_describe_promises_nothing(
    opened: Opened, tmp_path: Path
) -> None:
    numbers(tmp_path / "n.bag", range(4))
    content = (tmp_path / "n.bag").read_bytes()
    assert content.endswith(struct.pack("<II", 0, 4))  # connection and count of the last chunk's
    (tmp_path / "n.bag").write_bytes(content[:-8] + struct.pack("<II", 7, 4))

    bag = opened(tmp_path / "n.bag")
    assert (bag.promised, len(list(bag.messages(["/n"])))) == ({}, 4)


def test_the_parts_of_a_split_ros_1_recording_are_one_bag(opened: Opened, tmp_path: Path) -> None:
    numbers(tmp_path / "drive_2023-01-01-10-00-30_1.bag", range(4, 9))
    numbers(tmp_path / "drive_2023-01-01-10-00-00_0.bag", range(4))

    bag = opened(tmp_path)

    assert [(s.number, s.log_time) for s in bag.messages(["/n"])] == list(enumerate(STAMPS[:9]))
    assert bag.kind == "ROS 1 bag, 2 files"


def test_ros_1_bags_of_other_names_are_separate_recordings(tmp_path: Path) -> None:
    numbers(tmp_path / "drive_0.bag", range(2))
    numbers(tmp_path / "office_1.bag", range(2))

    with pytest.raises(BagError, match="files, which are separate recordings"):
        open_bag(tmp_path)


def test_messages_missing_from_the_index_of_a_ros_1_bag_are_reported(opened: Opened, tmp_path: Path) -> None:
    numbers(tmp_path / "x.bag", range(5))
    data = bytearray((tmp_path / "x.bag").read_bytes())
    info = data.rfind(b"op=\x06")
    counted_at = data.find((0).to_bytes(4, "little") + (5).to_bytes(4, "little"), info) + 4
    data[counted_at : counted_at + 4] = (9).to_bytes(4, "little")
    (tmp_path / "x.bag").write_bytes(data)

    bag = opened(tmp_path / "x.bag")

    assert shortfalls(bag) == ["topic /n: 9 messages are promised, 5 are there"]


def test_a_topic_of_two_definitions_goes_to_ros_2_as_both(opened: Opened, tmp_path: Path) -> None:
    with Writer1(tmp_path / "x.bag") as writer:
        for count in (1, 2):
            text = "".join(f"float64 v{i}\n" for i in range(count))
            connection = writer.add_connection("/n", "my/msg/T", msgdef=text, md5sum=str(count) * 32)
            for stamp in STAMPS[:count]:
                writer.write(connection, stamp, bytes(8 * count))

    exported(tmp_path / "x.bag", export_ros2, tmp_path / "out")

    bag = opened(tmp_path / "out")
    assert {name: topic.count for name, topic in bag.topics.items()} == {"/n": 2, "/n (my/msg/T)": 1}
    assert [len(stored.data) for stored in bag.messages(["/n"])] == [4 + 16] * 2


@pytest.mark.parametrize("form", ["own", "ros2", "foxglove"])
def test_topics_whose_names_differ_by_a_slash_stay_apart(opened: Opened, tmp_path: Path, form: str) -> None:
    topics = ("/a/b", "a/b", "/a/b/", "/c: #d")
    rows = [(name, stamp, ros("std_msgs/String", data=name)) for name in topics for stamp in STAMPS[:3]]
    write_mcap(tmp_path / "x.mcap", rows)
    out = tmp_path / ("out" if form == "ros2" else "out.mcap")

    with ExportSource(tmp_path / "x.mcap") as source:
        {"own": export_own, "ros2": export_ros2, "foxglove": export_foxglove}[form](source, out, Exported())

    assert sorted(counted(out).values()) == [3, 3, 3, 3]
    if form == "own":
        assert source.account.notes == [
            "topic /a/b is the stream a/b_2, since a/b is taken",
            "topic /a/b/ is the stream a/b_3, since a/b is taken",
        ]
    bag = opened(out)
    assert not bag.notes


def test_a_folder_of_bags_names_them_and_an_archive_is_to_be_unpacked(tmp_path: Path) -> None:
    write_ros2(tmp_path / "one", imus(STAMPS[:1]))
    (tmp_path / "bag.mcap.gz").write_bytes(gzip.compress((tmp_path / "one" / "one.mcap").read_bytes()))
    (tmp_path / "samples").mkdir()

    with pytest.raises(BagError, match="its folders one do: name one"):
        open_bag(tmp_path)
    with pytest.raises(BagError, match="are read by sources of a graph"):
        open_bag(tmp_path / "samples")
    with pytest.raises(BagError, match="it is a gzip file, to be unpacked first"):
        open_bag(tmp_path / "bag.mcap.gz")
