"""The account of a bag: messages passed over, fields without a place, repairs, static transforms that change."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exporting import exported
from made_bags import ROS2, SECOND, header, imus, ros, transform, write_ros2, xyz
from made_recordings import recorded
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import get_types_from_msg

from dataflow.interop.access_tracking import TrackedMessage
from dataflow.interop.bag import BagError
from dataflow.interop.export.own import export_own
from dataflow.interop.export.report import Exported
from dataflow.interop.export.ros2 import export_ros2
from dataflow.interop.export.source import ExportSource
from dataflow.interop.opening import open_bag
from dataflow.interop.playing import BagReadOptions, readable
from dataflow.interop.streams import BagStreams, MappedTopic
from dataflow.messages import Image, Image16, Measurement, Number, PointCloud, RangeReading
from dataflow.recording import Recording
from dataflow.recording.layout import BAG

STAMPS = [1_700_000_000 * SECOND + i * SECOND // 100 for i in range(6)]


def image(stamp: int, encoding: str, data: bytes, width: int, height: int, step: int) -> Any:
    about = {"width": width, "height": height, "encoding": encoding, "step": step}
    return ros("sensor_msgs/Image", header=header(stamp, "camera"), data=np.frombuffer(data, np.uint8), **about)


def converted(bag: Path, file: Path, **options: Any) -> ExportSource:
    with ExportSource(bag, **options) as source:
        export_own(source, file, Exported())
        return source


def read(file: Path, stream: str) -> list[Any]:
    with Recording(file) as recording:
        return [m.message for m in recording.messages([stream])]


@pytest.mark.parametrize("bad", [0, 3, 5])
def test_one_message_that_cannot_be_read_is_passed_over_and_counted(tmp_path: Path, bad: int) -> None:
    rows = [
        ("/img", s, image(s, "rgb8", b"", 0, 0, 0) if i == bad else image(s, "rgb8", bytes(48), 4, 4, 12))
        for i, s in enumerate(STAMPS)
    ]
    bag = write_ros2(tmp_path / "bag", rows)

    source = converted(bag, tmp_path / "o.mcap")

    assert [m.stamp for m in read(tmp_path / "o.mcap", "img")] == [s for i, s in enumerate(STAMPS) if i != bad]
    assert source.account.unread["/img"].count == 1
    with Recording(tmp_path / "o.mcap") as recording:
        assert [m.seq for m in recording.messages(["img"])] == [0, 1, 2, 3, 4]
        assert '"messages": 1' in recording.metadata[BAG]["unread"]


def test_strict_refuses_a_message_that_cannot_be_read_and_names_it(tmp_path: Path) -> None:
    rows = [("/img", s, image(s, "rgb8", bytes(48) if i else b"", 4 * bool(i), 4 * bool(i), 12 * bool(i)))
            for i, s in enumerate(STAMPS)]  # fmt: skip
    bag = write_ros2(tmp_path / "bag", rows)

    with pytest.raises(BagError, match="'/img', message 0"):
        converted(bag, tmp_path / "o.mcap", wishes=BagReadOptions(strict=True))


def test_a_message_that_is_cut_off_is_counted_while_times_are_looked_for(tmp_path: Path) -> None:
    with Writer2(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=ROS2)
        for i, (_, time, message) in enumerate(imus(STAMPS)):
            data = ROS2.serialize_cdr(message, "sensor_msgs/msg/Imu")
            writer.write(connection, time, bytes(data)[: 6 if i == 2 else None])

    with BagStreams(tmp_path / "bag", {"imu": MappedTopic("/imu", "Imu")}) as streams:
        assert len(list(streams.messages())) == 5
        assert streams.account.unread["/imu"].count == 1


def test_unmapped_fields_are_named_with_their_count(tmp_path: Path) -> None:
    scan = {"ranges": np.ones(5, np.float32), "angle_increment": 0.1, "angle_max": 0.4, "range_max": 9.0}
    rows = [
        ("/scan", s, ros("sensor_msgs/LaserScan", header=header(s, "laser"), scan_time=0.1 * (i > 2), **scan))
        for i, s in enumerate(STAMPS)
    ]
    bag = write_ros2(tmp_path / "bag", rows)

    account = converted(bag, tmp_path / "o.mcap").account

    assert account.lost["/scan"] == {"scan_time": 3}
    assert "/scan: no place for scan_time (in 3 messages)" in account.lines()


def test_bytes_behind_the_last_row_of_an_image_are_named(tmp_path: Path) -> None:
    rows = [("/img", s, image(s, "rgb8", bytes(48 + 16), 4, 4, 12)) for s in STAMPS]

    account = converted(write_ros2(tmp_path / "bag", rows), tmp_path / "o.mcap").account

    assert account.lost["/img"] == {"16 bytes behind the last of 4 rows (is step right?)": 6}


def test_transforms_of_a_frame_to_itself_and_further_parents_are_named(tmp_path: Path) -> None:
    rows = []
    for s in STAMPS:
        placed = [transform(s, parent, "base") for parent in ("a", "b", "base")]
        rows.append(("/tf", s, ros("tf2_msgs/TFMessage", transforms=placed)))

    account = converted(write_ros2(tmp_path / "bag", rows), tmp_path / "o.mcap").account

    assert account.lost["/tf"] == {"a parent of base: a beside b": 6, "a transform of base to itself": 6}
    assert account.repaired["/tf"] == {"merged": 6}
    assert [m.frames for m in read(tmp_path / "o.mcap", "tf")] == [("b",)] * 6


def test_a_topic_without_a_message_is_named(tmp_path: Path) -> None:
    bag = write_ros2(tmp_path / "bag", imus(STAMPS), declared=("/camera",))

    account = converted(bag, tmp_path / "o.mcap").account

    assert "declared without a message: /camera" in account.lines()


def test_a_fix_whose_latitude_is_a_longitude_is_named_so(tmp_path: Path) -> None:
    rows = [("/fix", s, ros("sensor_msgs/NavSatFix", header=header(s), latitude=116.4, longitude=39.9)) for s in STAMPS]

    (line,) = converted(write_ros2(tmp_path / "bag", rows), tmp_path / "o.mcap").account.notes

    assert "a latitude of 116.4 and a longitude of 39.9 degrees: are they swapped?" in line


def test_a_field_that_a_newer_definition_has_more_is_named_and_the_rest_is_read(tmp_path: Path) -> None:
    text = "std_msgs/Header header\ngeometry_msgs/Vector3 vector_more\nfloat64 temperature\nfloat64 variance\n"
    types = get_types_from_msg(text, "sensor_msgs/msg/Temperature")
    store = type(ROS2)()
    store.fielddefs, store.types = dict(ROS2.fielddefs), dict(ROS2.types)
    del store.fielddefs["sensor_msgs/msg/Temperature"], store.types["sensor_msgs/msg/Temperature"]
    store.register(types)
    kind = "sensor_msgs/msg/Temperature"
    message = store.types[kind](header=header(STAMPS[0], "t"), vector_more=xyz(1, 2, 3), temperature=21.5, variance=0.5)
    with Writer2(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/t", kind, typestore=store)
        writer.write(connection, STAMPS[0], store.serialize_cdr(message, kind))

    account = converted(tmp_path / "bag", tmp_path / "o.mcap").account

    (found,) = read(tmp_path / "o.mcap", "t")
    assert (found.value, found.unit, found.variance, found.frame) == (21.5, "°C", 0.5, "t")
    assert set(account.lost["/t"]) == {"vector_more.x", "vector_more.y", "vector_more.z"}


def test_fields_that_were_read_or_hold_nothing_are_not_named() -> None:
    seen = TrackedMessage(ros("sensor_msgs/Range", header=header(5, "sonar"), range=1.5, max_range=4.0))

    assert seen.range == 1.5
    assert seen.unread() == ("max_range",)
    assert seen.max_range == 4.0
    assert "max_range" not in seen.unread()


def test_16_bit_images_ranges_and_measurements_survive_the_round_trip(tmp_path: Path) -> None:
    warm = (7000 + np.arange(24, dtype=np.uint16)).reshape(4, 6)
    wide = np.array([[500_000.01, 5_000_000.02, 3.0], [500_000.02, 5_000_000.03, 4.0]])
    cells = np.zeros(4, np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8")]))
    for axis, values in zip("xyz", np.vstack([wide, wide]).T, strict=True):
        cells[axis] = values
    fields = [ros("sensor_msgs/PointField", name=n, offset=8 * k, datatype=8, count=1) for k, n in enumerate("xyz")]
    at = header(STAMPS[0], "sensor")
    rows = [
        ("/thermal", STAMPS[0], image(STAMPS[0], "mono16", warm.tobytes(), 6, 4, 12)),
        ("/sonar", STAMPS[0], ros("sensor_msgs/Range", header=at, radiation_type=1, field_of_view=0.2, min_range=0.1,
                                  max_range=4.0, range=1.5)),
        ("/p", STAMPS[0], ros("sensor_msgs/FluidPressure", header=at, fluid_pressure=101325.0, variance=4.0)),
        ("/cloud", STAMPS[0], ros("sensor_msgs/PointCloud2", header=at, width=2, height=2, fields=fields,
                                  point_step=24, row_step=48, data=np.frombuffer(cells.tobytes(), np.uint8))),
    ]  # fmt: skip
    bag = write_ros2(tmp_path / "bag", rows)

    account = converted(bag, tmp_path / "o.mcap").account
    exported(tmp_path / "o.mcap", export_ros2, tmp_path / "back")
    again = converted(tmp_path / "back", tmp_path / "again.mcap").account

    assert not account.lost
    assert not again.lost
    (thermal,), (sonar,), (pressure,), (cloud,) = (read(tmp_path / "again.mcap", s) for s in ("thermal", "sonar", "p", "cloud"))  # fmt: skip  # noqa: E501
    assert isinstance(thermal, Image16)
    assert isinstance(cloud, PointCloud)
    np.testing.assert_array_equal(thermal.data, warm)
    assert sonar == RangeReading(stamp=STAMPS[0], frame="sensor", range=1.5, range_min=sonar.range_min, range_max=4.0,
                                 field_of_view=sonar.field_of_view, radiation="infrared")  # fmt: skip
    assert pressure == Measurement(stamp=STAMPS[0], frame="sensor", value=101325.0, unit="Pa", variance=4.0)
    assert cloud.columns == 2
    np.testing.assert_array_equal(cloud.precise, np.vstack([wide, wide]))


def test_16_bit_images_are_8_bits_or_depth_where_that_is_asked_for(tmp_path: Path) -> None:
    deep = np.full((4, 6), 1234, np.uint16)
    bag = write_ros2(tmp_path / "bag", [("/d", s, image(s, "mono16", deep.tobytes(), 6, 4, 12)) for s in STAMPS])

    converted(bag, tmp_path / "lossy.mcap", wishes=BagReadOptions(lossy=True))
    converted(bag, tmp_path / "depth.mcap", wishes=BagReadOptions(depth={"/d": 1000}))

    assert type(read(tmp_path / "lossy.mcap", "d")[0]) is Image
    assert read(tmp_path / "depth.mcap", "d")[0].data[0, 0] == np.float32(1.234)


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_depth_is_of_the_units_that_are_given_and_doubtful_ones_are_named(tmp_path: Path, encoding: str) -> None:
    deep = np.full((16, 16), 15_000, np.uint16)
    bag = write_ros2(tmp_path / "bag", [("/d", s, image(s, encoding, deep.tobytes(), 16, 16, 32)) for s in STAMPS])

    as_they_are = converted(bag, tmp_path / "mm.mcap", wishes=BagReadOptions(depth={"/d": 1000}))
    given = converted(bag, tmp_path / "units.mcap", wishes=BagReadOptions(depth={"/d": 5000}))

    assert "with 5000 units a metre it is 3 to 3 m" in as_they_are.account.doubted["/d"]
    assert not given.account.doubted
    assert read(tmp_path / "units.mcap", "d")[0].data[0, 0] == 3.0


def test_depth_in_metres_has_no_units(tmp_path: Path) -> None:
    deep = np.full((4, 6), 1.23456, np.float32)
    bag = write_ros2(tmp_path / "bag", [("/d", s, image(s, "32FC1", deep.tobytes(), 6, 4, 24)) for s in STAMPS])

    account = converted(bag, tmp_path / "d.mcap", wishes=BagReadOptions(depth={"/d": 5000})).account

    assert "not of 16-bit units" in account.unread["/d"].reason


def test_changing_static_transforms_are_noted(tmp_path: Path) -> None:
    rows = [("/tf_static", STAMPS[i], ros("tf2_msgs/TFMessage", transforms=[transform(0, "base", "laser", x)]))
            for i, x in ((0, 0.1), (2, 0.1), (4, 9.9))]  # fmt: skip
    bag = write_ros2(tmp_path / "bag", [*rows, *imus(STAMPS)])

    account = converted(bag, tmp_path / "o.mcap").account

    assert "laser" in account.static["/tf_static"]


def test_topics_keep_their_names_and_numbers_their_units_both_ways(tmp_path: Path) -> None:
    rows = [(f"/vicon/{c}", s, transform(s, "world", c)) for s in STAMPS for c in "ab"]
    bag = write_ros2(tmp_path / "bag", rows)
    converted(bag, tmp_path / "o.mcap")
    recorded(tmp_path / "n.mcap", [("speed", Number(stamp=STAMPS[0], value=3.0, unit="m/s"))])

    for name in ("o", "n"):
        exported(tmp_path / f"{name}.mcap", export_ros2, tmp_path / name)
    converted(tmp_path / "n", tmp_path / "again.mcap")

    with closing(open_bag(tmp_path / "o")) as back:
        held = {topic.name: topic.schema.name for topic in back.topics.values()}
    assert held == dict.fromkeys(("/vicon/a", "/vicon/b"), "geometry_msgs/msg/TransformStamped")
    assert read(tmp_path / "again.mcap", "speed")[0].unit == "m/s"


def test_all_of_a_bag_in_simulated_time_is_on_one_clock(tmp_path: Path) -> None:
    wall = STAMPS[0]
    rows = [("/odom", wall + i * SECOND, ros("nav_msgs/Odometry", header=header((900 + i) * SECOND, "odom")))
            for i in range(5)]  # fmt: skip
    rows += [("/grip", wall + i * SECOND, ros("geometry_msgs/Polygon")) for i in range(5)]
    bag = write_ros2(tmp_path / "bag", sorted(rows, key=lambda row: row[1]))

    converted(bag, tmp_path / "o.mcap")

    with Recording(tmp_path / "o.mcap") as recording:
        times = [t for info in recording.streams.values() for t in (info.first, info.last) if t is not None]
    assert max(times) - min(times) == 4 * SECOND
    assert min(times) == 900 * SECOND


def test_depth_topic_of_another_type_is_refused_with_its_type(tmp_path: Path) -> None:
    bag = write_ros2(tmp_path / "bag", imus(STAMPS))

    with closing(open_bag(bag)) as opened, pytest.raises(BagError, match="read as Imu, which cannot be depth"):
        readable(opened, bag, wishes=BagReadOptions(depth={"/imu": 1000}))


def test_a_topic_of_two_types_keeps_both_there_and_back(tmp_path: Path) -> None:
    with Writer2(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for kind, value in (("String", "a"), ("Float64", 2.0)):
            name = f"std_msgs/msg/{kind}"
            connection = writer.add_connection("/x", name, typestore=ROS2)
            for stamp in STAMPS[: 4 if kind == "String" else 2]:
                writer.write(connection, stamp, ROS2.serialize_cdr(ROS2.types[name](data=value), name))

    converted(tmp_path / "bag", tmp_path / "o.mcap")
    for name in ("bag", "o.mcap"):
        exported(tmp_path / name, export_ros2, tmp_path / f"of_{name}")
        with closing(open_bag(tmp_path / f"of_{name}")) as back:
            held = {(topic.name, topic.schema.name): topic.count for topic in back.topics.values()}
        assert held == {("/x", "std_msgs/msg/String"): 4, ("/x (std_msgs/msg/Float64)", "std_msgs/msg/Float64"): 2}


def test_a_topic_of_a_known_type_that_cannot_be_read_is_kept_and_named(tmp_path: Path) -> None:
    rows = [("/odd", s, image(s, "yv12", bytes(24), 4, 4, 6)) for s in STAMPS]

    account = converted(write_ros2(tmp_path / "bag", rows), tmp_path / "o.mcap").account

    assert "topic /odd stays as it is, since it cannot be read: image encoding 'yv12'" in account.notes[0]
    with Recording(tmp_path / "o.mcap") as recording:
        assert recording.streams["/odd"].count == 6


def test_numbers_beyond_a_double_are_counted(tmp_path: Path) -> None:
    rows = [("/n", s, ros("std_msgs/Int64", data=2**62 + 1)) for s in STAMPS]

    account = converted(write_ros2(tmp_path / "bag", rows), tmp_path / "o.mcap").account

    assert account.lost["/n"] == {"digits beyond 53 bits": 6}
