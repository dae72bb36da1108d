"""Counts that a bag promises against what came: databases, write-ahead logs, metadata, two types under one name."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest
import zstandard
from made_bags import ROS1, ROS2, SECOND, imus, ros, transform, write_ros2
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from dataflow.interop.bag import BagError, shortfalls
from dataflow.interop.opening import open_bag

STAMPS = [1_700_000_000 * SECOND + i * SECOND // 100 for i in range(20)]


def counted(path: Path) -> dict[str, int]:
    """Messages by topic, as they come."""
    bag = open_bag(path)
    found = dict.fromkeys(bag.topics, 0)
    for stored in bag.messages(list(bag.topics)):
        found[stored.topic] += 1
    assert found == {name: topic.count for name, topic in bag.topics.items()}
    bag.close()
    return found


def changed(folder: Path, statement: str, *values: object) -> None:
    with sqlite3.connect(folder / f"{folder.name}.db3") as database:
        database.execute(statement, values)
    database.close()


@pytest.mark.parametrize("profiles", ["", "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n", "nonsense"])
def test_profiles_that_differ_between_metadata_and_database_lose_nothing(tmp_path: Path, profiles: str) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    changed(folder, "update topics set offered_qos_profiles = ?", profiles)

    assert counted(folder) == {"/imu": 20}


def test_messages_that_metadata_promise_and_the_database_lacks_are_told(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    changed(folder, "delete from messages where id > 12")

    bag = open_bag(folder)

    assert shortfalls(bag) == ["topic /imu: 20 messages are promised, 12 are there"]
    bag.close()


@pytest.mark.parametrize("read_only", [False, True])
def test_what_a_killed_recorder_left_in_the_write_ahead_log_is_read(tmp_path: Path, read_only: bool) -> None:
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

    bag = open_bag(killed)

    assert bag.topics["/imu"].count == 21
    assert any("bag.db3-wal" in note for note in bag.notes)
    bag.close()
    killed.chmod(0o700)


def test_a_database_that_was_renamed_is_read_with_a_note(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    (folder / "bag.db3").rename(folder / "other.db3")

    assert counted(folder) == {"/imu": 20}
    bag = open_bag(folder)
    assert bag.notes == ("metadata.yaml names bag.db3, which the folder lacks",)
    bag.close()


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
def test_messages_compressed_one_by_one_are_read(tmp_path: Path, storage: StoragePlugin) -> None:
    rows = imus(STAMPS)
    kind = "sensor_msgs/msg/Imu"
    writer = Writer2(tmp_path / "bag", version=9, storage_plugin=storage)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/imu", kind, typestore=ROS2)
        for _, time, message in rows:
            writer.write(connection, time, ROS2.serialize_cdr(message, kind))

    bag = open_bag(tmp_path / "bag")

    assert [bytes(s.data) for s in bag.messages(["/imu"])] == [bytes(ROS2.serialize_cdr(m, kind)) for _, _, m in rows]
    bag.close()


def test_split_databases_are_one_bag_in_the_order_of_log_times(tmp_path: Path) -> None:
    rows = imus(STAMPS)
    first, second = write_ros2(tmp_path / "a", rows[10:], "sqlite3"), write_ros2(tmp_path / "b", rows[:10], "sqlite3")
    (first / "metadata.yaml").unlink()
    shutil.copy(second / "b.db3", first / "b.db3")

    bag = open_bag(first)

    assert [stored.log_time for stored in bag.messages(["/imu"])] == STAMPS
    bag.close()


def test_metadata_that_are_no_yaml_are_noted_and_the_files_count(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    (folder / "metadata.yaml").write_text("rosbag2: [", encoding="utf-8")

    assert counted(folder) == {"/imu": 20}


def test_one_layout_under_two_names_is_one_topic_and_two_layouts_are_two(tmp_path: Path) -> None:
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
    bag = open_bag(tmp_path / "two.bag")
    assert "two types" in bag.notes[0]
    bag.close()


def test_a_file_without_tables_is_no_bag(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("create table other(id integer)")
    database.close()

    with pytest.raises(BagError, match="its tables are other"):
        open_bag(tmp_path / "a.db3")


def test_transforms_of_one_publisher_come_with_the_others(tmp_path: Path) -> None:
    rows = [("/tf", s, ros("tf2_msgs/TFMessage", transforms=[transform(s, "map", "base")])) for s in STAMPS]

    assert counted(write_ros2(tmp_path / "bag", rows, "sqlite3")) == {"/tf": 20}
