"""Bags of every format as recorded streams: in stamp order, repaired, transforms joined, static ones as one message."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from made_bags import ROS1, SECOND, header, imus, ros, transform, write_ros1, write_ros2

from dataflow.interop.bag import BagError
from dataflow.interop.opening import is_foreign, open_bag
from dataflow.interop.streams import BagStreams, MappedTopic, recorded_streams
from dataflow.messages import Imu, Text
from dataflow.recording import RecordingWriter

STAMPS = [1_700_000_000 * SECOND + i * SECOND // 100 for i in range(40)]
IMU = {"robot/imu/imu": MappedTopic("/imu", "Imu")}


def readings(streams: BagStreams) -> list[float]:
    return [m.message.angular_velocity[0] for m in streams.messages()]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("bare", [False, True])
def test_ros_2_bags_as_folder_and_as_bare_file(tmp_path: Path, storage: str, bare: bool) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), storage)
    path = next(p for p in folder.iterdir() if p.suffix in (".mcap", ".db3")) if bare else folder

    with BagStreams(path, IMU) as streams:
        assert readings(streams) == list(range(40))
        assert [m.stamp for m in streams.messages()] == STAMPS
        assert list(streams.stamps("robot/imu/imu")) == STAMPS
        info = streams.streams["robot/imu/imu"]
        assert (info.count, info.first, info.last, info.message_type) == (40, STAMPS[0], STAMPS[-1], Imu)


def test_ros_1_bag(tmp_path: Path) -> None:
    rows = [("/imu", s, ros("sensor_msgs/Imu", ROS1, header=header(s, "imu", ROS1))) for s in STAMPS]

    with BagStreams(write_ros1(tmp_path / "a.bag", rows), IMU) as streams:
        assert [(m.stamp, m.seq, m.message.frame) for m in streams.messages()] == [
            (s, i, "imu") for i, s in enumerate(STAMPS)
        ]


@pytest.mark.parametrize("metadata", [True, False])
def test_split_files_are_one_bag(tmp_path: Path, metadata: bool) -> None:
    rows = imus(STAMPS)
    first = write_ros2(tmp_path / "bag", rows[:20])
    second = write_ros2(tmp_path / "more", rows[20:])
    (first / "bag.mcap").rename(first / "bag_2.mcap")
    shutil.copy(second / "more.mcap", first / "bag_10.mcap")
    if not metadata:
        (first / "metadata.yaml").unlink()

    with BagStreams(first, IMU) as streams:
        assert [m.stamp for m in streams.messages()] == STAMPS


def test_messages_come_in_the_order_of_their_headers_with_the_span_asked_for(tmp_path: Path) -> None:
    rows = imus(STAMPS)
    rows[3], rows[8] = (rows[8][0], rows[3][1], rows[8][2]), (rows[3][0], rows[8][1], rows[3][2])
    shifted = [("/late", s + SECOND // 3, ros("sensor_msgs/Temperature", header=header(s + 1))) for s in STAMPS[:20]]
    path = write_ros2(tmp_path / "bag", sorted(rows + shifted, key=lambda row: row[1]))
    played = IMU | {"robot/t/t": MappedTopic("/late", "Number")}

    with BagStreams(path, played) as streams:
        got = [(m.stamp, m.stream) for m in streams.messages()]
        assert streams.repairs["/imu"].reordered == 5
        part = [m.stamp for m in streams.messages(["robot/imu/imu"], STAMPS[5], STAMPS[9])]
        numbers = [m.seq for m in streams.messages(["robot/imu/imu"], STAMPS[5], STAMPS[9])]

    assert got == sorted(got)
    assert len(got) == 60
    assert part == STAMPS[5:10]
    assert numbers == [5, 6, 7, 8, 9]


def test_two_readings_of_a_bag_are_equal_and_so_is_one_in_another_process(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", imus([*STAMPS, *STAMPS[:5]]))

    with BagStreams(path, IMU) as streams, recorded_streams(path, streams.opening()) as again:
        assert [m.message.digest() for m in streams.messages()] == [m.message.digest() for m in again.messages()]


def test_transforms_of_one_time_are_one_message_and_of_several_times_several(tmp_path: Path) -> None:
    def tf(time: int, *rows: object) -> tuple[str, int, object]:
        return "/tf", STAMPS[0] + time, ros("tf2_msgs/TFMessage", transforms=list(rows))

    a, b = STAMPS[1], STAMPS[2]
    path = write_ros2(
        tmp_path / "bag",
        [tf(1, transform(a, "map", "odom")), tf(2, transform(b, "odom", "base"), transform(a, "odom", "base"))],
    )

    with BagStreams(path, {"r/tf": MappedTopic("/tf", "Transforms")}) as streams:
        got = [(m.stamp, m.seq, m.message.child_frames) for m in streams.messages()]

    assert got == [(a, 0, ("odom", "base")), (b, 1, ("base",))]
    assert streams.repairs["/tf"].facts() == {"merged": 1}


def test_static_streams_are_one_message_of_all_transforms_and_the_first_calibration(tmp_path: Path) -> None:
    K = np.array([500.0, 0, 320, 0, 500, 240, 0, 0, 1])

    def info(i: int, focal: float = 500.0) -> tuple[str, int, object]:
        k = np.where(K == 500, focal, K)
        return "/info", STAMPS[i], ros("sensor_msgs/CameraInfo", header=header(STAMPS[i]), width=640, height=480, k=k)

    rows = [
        ("/tf_static", STAMPS[0], ros("tf2_msgs/TFMessage", transforms=[transform(0, "base", "camera")])),
        ("/tf_static", STAMPS[1], ros("tf2_msgs/TFMessage", transforms=[transform(0, "base", "lidar")])),
        info(2),
        info(3),
        info(4, focal=501.0),
        *imus(STAMPS[5:]),
    ]
    played = IMU | {
        "r/tf": MappedTopic("/tf_static", "Transforms", static=True),
        "r/info": MappedTopic("/info", "CameraInfo", static=True),
    }

    with BagStreams(write_ros2(tmp_path / "bag", rows), played) as streams:
        found = {m.stream: m.message for m in streams.messages() if streams.streams[m.stream].static}
        notes = streams.static_notes

    assert found["r/tf"].child_frames == ("camera", "lidar")
    assert found["r/info"].fx == 500.0
    assert notes == {"r/tf": "2 messages as one", "r/info": "the first of 3; 1 differ from it"}


def test_unreadable_bag_is_refused_with_a_reason(tmp_path: Path) -> None:
    def refused(name: str, data: bytes) -> str:
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(BagError) as caught:
            open_bag(path)
        return str(caught.value)

    assert "nor another kind of bag: it begins with 68 65" in refused("a.txt", b"hello")
    assert "it is empty" in refused("empty.mcap", b"")
    assert "rename it so that it ends in .bag" in refused("a.log", b"#ROSBAG V2.0\n")
    assert "a.bag" in refused("a.bag", b"#ROSBAG V2.0\n garbage")
    assert "Bag version 102 is not supported" in refused("old.bag", b"#ROSBAG V1.2\n")
    (tmp_path / "none").mkdir()
    with pytest.raises(BagError, match=r"holds no metadata.yaml, .mcap, .db3 or .bag file"):
        open_bag(tmp_path / "none")


def test_unknown_topic_or_type_is_refused_with_a_reason(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", imus(STAMPS))

    for played, told in (
        (MappedTopic("/gyro", "Imu"), "has no topic '/gyro'; it has /imu"),
        (MappedTopic("/imu", "Image"), "is read as Imu, not as Image"),
    ):
        with pytest.raises(BagError, match=told):
            BagStreams(path, {"r/s": played})


def test_own_recordings_are_not_foreign(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "own.mcap", metadata={}) as writer:
        writer.add_stream("imu", Imu)
    bag = write_ros2(tmp_path / "bag", imus(STAMPS))

    assert not is_foreign(tmp_path / "own.mcap")
    assert is_foreign(bag)
    assert is_foreign(bag / "bag.mcap")


@pytest.mark.data
def test_every_bag_of_others_opens(data_dir: Path) -> None:
    counts = {}
    for path in sorted((data_dir / "bags").iterdir()):
        bag = open_bag(path)
        counts[path.name] = sum(1 for _ in bag.messages(bag.topics))
        bag.close()

    assert counts == {
        "ROS_example.bag": 26_566,
        "foxglove_camera_jsonschema.mcap": 30,
        "nav2_turtlebot.mcap": 8_197,
        "ros2_cdr_test.mcap": 7,
        "ros2_talker.mcap": 20,
        "ros2_topics_and_services.mcap": 13,
        "tf_example": 518,
    }


@pytest.mark.parametrize("log", [[0] * 6, [SECOND * (i // 3) for i in range(6)]])
def test_equal_messages_of_a_log_without_times_are_not_taken_for_one(tmp_path: Path, log: list[int]) -> None:
    """Six equal texts, recorded by a log whose times are all 0, or whole seconds."""
    rows = [("/said", stamp, ros("std_msgs/String", data="on")) for stamp in log]
    bag = write_ros2(tmp_path / "bag", rows)

    with BagStreams(bag, {"/said": MappedTopic("/said", Text.SCHEMA)}) as opened:
        stamps = [found.message.stamp for found in opened.messages()]

    assert stamps == [stamp + i % (6 if log[-1] == 0 else 3) for i, stamp in enumerate(log)]
    assert opened.account.repaired == {"/said": {"moved": 6 - len(set(log))}}


def test_a_log_without_times_is_noted(tmp_path: Path) -> None:
    texts = [("/said", 0, ros("std_msgs/String", data="on"))] * 2

    assert "all messages have the log time 0" in open_bag(write_ros2(tmp_path / "bag", texts)).notes[0]
    assert not open_bag(write_ros2(tmp_path / "one", texts[:1])).notes
