"""Broken bags: what is left of a database without its end, and of a ROS 1 bag without its index."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from made_bags import ROS1, SECOND, header, imus, ros, write_ros1, write_ros2
from rosbags.rosbag1 import Writer as Writer1

from dataflow.editing.recover_bag import recover_bag
from dataflow.interop.bag import BagError
from dataflow.interop.opening import open_bag
from dataflow.interop.salvage import salvage
from dataflow.recording import RecordingError

STAMPS = [1_700_000_000 * SECOND + i * SECOND // 100 for i in range(300)]


def saved(path: Path) -> list[tuple[str, int, bytes]]:
    wreck = salvage(path)
    names = {number: topic.name for number, topic in wreck.topics()}
    return [(names[number], time, data) for time, number, data in wreck.rows(list(names))]


def held(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    with closing(open_bag(path)) as bag:
        found: dict[str, list[tuple[int, bytes]]] = {name: [] for name in bag.topics}
        for stored in bag.messages(list(bag.topics)):
            found[stored.topic].append((stored.log_time, bytes(stored.data)))
    return found


def test_a_database_is_salvaged_whole_where_nothing_is_missing(tmp_path: Path) -> None:
    big = ros("sensor_msgs/Image", header=header(STAMPS[0]), data=np.arange(20_000).astype(np.uint8))
    folder = write_ros2(tmp_path / "bag", [*imus(STAMPS), ("/big", STAMPS[-1] + 1, big)], "sqlite3")

    assert salvage(folder / "bag.db3").lost == 0
    whole = held(folder)
    expected = [(topic, time, data) for topic in ("/imu", "/big") for time, data in whole[topic]]
    assert saved(folder / "bag.db3") == expected


def test_truncated_database_yields_messages_before_the_cut(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    data = (folder / "bag.db3").read_bytes()
    (tmp_path / "cut.db3").write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(BagError, match=r"dataflow recover .*cut\.db3"):
        open_bag(tmp_path / "cut.db3", strict=True)

    done = recover_bag(tmp_path / "cut.db3", tmp_path / "saved.mcap")

    found = held(tmp_path / "saved.mcap")["/imu"]
    assert 100 < len(found) == done.saved.messages < 300
    assert set(found) <= set(held(folder)["/imu"])
    assert found == held(tmp_path / "cut.db3")["/imu"]
    assert not done.whole


@pytest.mark.parametrize("compression", [None, Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4])
def test_a_ros_1_bag_without_an_index_gives_its_messages(
    tmp_path: Path, compression: Writer1.CompressionFormat | None
) -> None:
    whole = tmp_path / "a.bag"
    writer = Writer1(whole)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connection = writer.add_connection("/said", "std_msgs/msg/String", typestore=ROS1)
        for i, stamp in enumerate(STAMPS):
            text = ROS1.types["std_msgs/msg/String"](data=f"number {i}")
            writer.write(connection, stamp, ROS1.serialize_ros1(text, "std_msgs/msg/String"))
    data = whole.read_bytes()
    index = int.from_bytes(data[data.index(b"index_pos=") + 10 :][:8], "little")
    broken = tmp_path / "broken.bag"
    broken.write_bytes(data[:index].replace(index.to_bytes(8, "little"), bytes(8)))
    with pytest.raises(BagError, match="dataflow recover"):
        open_bag(broken, strict=True)

    recover_bag(broken, tmp_path / "saved.mcap")

    assert held(tmp_path / "saved.mcap") == held(whole) == held(broken)


def test_nothing_is_written_of_a_file_without_a_whole_message(tmp_path: Path) -> None:
    file = write_ros1(tmp_path / "a.bag", [])
    (tmp_path / "other.txt").write_bytes(b"hello")

    with pytest.raises(RecordingError, match="no whole message"):
        recover_bag(file, tmp_path / "o.mcap")
    with pytest.raises(RecordingError, match="neither a SQLite database"):
        salvage(tmp_path / "other.txt")
    assert not (tmp_path / "o.mcap").exists()
