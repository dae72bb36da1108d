"""Conversions, read back by other programs' readers: rosbags, mcap, protobuf, and the readers of the datasets."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_messages import example
from exporting import exported
from made_bags import ROS1, header, imus, ros, transform, write_ros1, write_ros2
from made_recordings import of_robot
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from dataflow.interop.export.datasets import DATASETS
from dataflow.interop.export.foxglove import export_foxglove
from dataflow.interop.export.own import export_own
from dataflow.interop.export.report import Exported
from dataflow.interop.export.ros2 import export_ros2
from dataflow.interop.export.source import ExportSource
from dataflow.interop.export.tables import export_csv, export_parquet
from dataflow.interop.opening import open_bag
from dataflow.interop.ros import CONVERSIONS
from dataflow.interop.ros.construction import typestore
from dataflow.interop.ros.to_ros2 import OUTWARD
from dataflow.messages import (
    Boxes3D,
    CameraInfo,
    DepthImage,
    Detections2D,
    Image,
    Imu,
    Measurement,
    Message,
    OccupancyGrid,
    Odometry,
    PointCloud,
    Pose,
    Tracks,
    Transforms,
)
from dataflow.recording import Recording, RecordingError

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
EXACT = {"CompressedVideo", "Pose", "Twist", "Imu", "MagneticField", "PointCloud", "Text", "Switch", "Alarm"}
EXACT |= {"Transforms"}


def frames(count: int = 4) -> dict[str, list[Message]]:
    """An RGB-D sequence with poses and calibrations."""
    rng = np.random.default_rng(0)
    K = np.array([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]])
    found: dict[str, list[Message]] = {"camera/image": [], "camera/depth": [], "camera/pose": []}
    for i in range(count):
        stamp = START + i * SECOND // 10
        found["camera/image"].append(Image(stamp=stamp, frame="c", data=rng.integers(0, 256, (12, 16, 3), np.uint8)))
        depth = np.round(rng.uniform(0.5, 5, (12, 16)), 3).astype(np.float32)
        found["camera/depth"].append(DepthImage(stamp=stamp, frame="d", data=depth))
        turn = np.array([0, 0, np.sin(0.1 * i), np.cos(0.1 * i)])
        found["camera/pose"].append(Pose(stamp=stamp, frame="world", position=np.array([i, 0, 0.5]), orientation=turn))
    for name, frame in (("camera/image_info", "c"), ("camera/depth_info", "d")):
        found[name] = [CameraInfo(stamp=START, frame=frame, width=16, height=12, K=K)]
    return found


STATIC = ("camera/image_info", "camera/depth_info", "tf")


@pytest.mark.parametrize("kind", sorted(OUTWARD, key=lambda t: t.SCHEMA), ids=lambda t: t.SCHEMA)
def test_message_survives_the_round_trip_through_ros_bytes(kind: type[Message]) -> None:
    if kind.SCHEMA == "CompressedDepth":
        pytest.skip("its example has a scale of its own; the depth formats are tested apart")
    store = typestore()
    message = example(kind).replace(stamp=START)
    if isinstance(message, CameraInfo):
        message = message.replace(width=16, height=12)  # its example is larger than ROS can say
    if isinstance(message, PointCloud):
        offsets = np.linspace(0, 0.1, message.count, dtype=np.float32)
        message = message.replace(precise=None, columns=None, time_offsets=offsets)
    if isinstance(message, Measurement):
        message = message.replace(unit="Pa")
    if isinstance(message, Transforms):
        message = message.replace(frames=("world", "a/b", "a/b"))
    unknown = {n: v for n, v in message.items() if n == "translations" or (n.endswith("covariance") and v is not None)}
    message = message.replace(**{n: np.abs(np.nan_to_num(v, posinf=1.0, neginf=2.0)) for n, v in unknown.items()})

    made = OUTWARD[kind](message)
    name = made.__msgtype__
    again = store.deserialize_cdr(store.serialize_cdr(made, name), name)
    back = CONVERSIONS[name][1](again, START)

    assert type(back) is kind
    if kind.SCHEMA in EXACT:
        assert {n for n, v in message.items() if not same(v, getattr(back, n))} <= {"child_frame", "temperature"}


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return a is not None and b is not None and np.array_equal(a, b, equal_nan=True)
    return bool(a == b)


def test_recording_becomes_a_bag_that_rosbags_reads(tmp_path: Path) -> None:
    T = np.eye(4)
    moved = []
    for i in range(5):
        T[:3, 3] = i
        moved.append(Odometry.from_matrix(T, stamp=START + i, frame="odom", child_frame="base"))
    fixed = Transforms.from_matrix(T, stamp=0, frame="base", child_frame="c")
    more = {"odometry": moved, "tf": [fixed], "tracks": [example(Tracks)]}
    path = of_robot(tmp_path / "a.mcap", frames() | more, STATIC)

    done = exported(path, export_ros2, tmp_path / "bag")

    with AnyReader([tmp_path / "bag"]) as reader:
        counts = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        read = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
    assert counts == {
        "/camera/image": ("sensor_msgs/msg/Image", 4),
        "/camera/depth": ("sensor_msgs/msg/Image", 4),
        "/camera/pose": ("geometry_msgs/msg/PoseWithCovarianceStamped", 4),
        "/camera/image_info": ("sensor_msgs/msg/CameraInfo", 1),
        "/camera/depth_info": ("sensor_msgs/msg/CameraInfo", 1),
        "/odometry": ("nav_msgs/msg/Odometry", 5),
        "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
    }
    odometry = [(t, m.pose.pose.position.x) for topic, t, m in read if topic == "/odometry"]
    assert odometry == [(START + i, float(i)) for i in range(5)]
    assert done.left_out == {"tracks": "Tracks has no counterpart in ROS"}


def test_bag_of_ros_goes_through_byte_for_byte_and_unknown_types_survive(tmp_path: Path) -> None:
    rows = imus([START + i * 1000 for i in range(5)])
    odd = ros("sensor_msgs/RelativeHumidity", header=header(START))
    rows += [("/box", START, ros("shape_msgs/SolidPrimitive", type=1)), ("/humid", START + 7, odd)]
    bag = write_ros2(tmp_path / "bag", sorted(rows, key=lambda row: row[1]))

    exported(bag, export_own, tmp_path / "own.mcap")
    with ExportSource(tmp_path / "own.mcap") as source:
        assert [t.name for t in source.untouched] == ["/box"]
        export_ros2(source, tmp_path / "again", Exported())
    exported(bag, export_ros2, tmp_path / "copy")

    def contents(path: Path, *topics: str) -> Counter[tuple[str, int, bytes]]:
        opened = open_bag(path)
        found = Counter((m.topic, m.log_time, bytes(m.data)) for m in opened.messages(topics))
        opened.close()
        return found

    assert contents(tmp_path / "copy", "/imu", "/box", "/humid") == contents(bag, "/imu", "/box", "/humid")
    assert contents(tmp_path / "again", "/box") == contents(bag, "/box")
    with AnyReader([tmp_path / "again"]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == {"/imu": 5, "/box": 1, "/humid": 1}


def test_static_transforms_of_a_bag_stay_static_in_a_recording_and_on_the_way_back(tmp_path: Path) -> None:
    rows = [
        ("/tf_static", START, ros("tf2_msgs/TFMessage", transforms=[transform(0, "base", "camera")])),
        ("/tf", START, ros("tf2_msgs/TFMessage", transforms=[transform(START, "odom", "base")])),
        ("/tf_static", START + 5, ros("tf2_msgs/TFMessage", transforms=[transform(0, "base", "lidar")])),
        ("/tf", START + 9, ros("tf2_msgs/TFMessage", transforms=[transform(START + 9, "odom", "base")])),
    ]
    bag = write_ros2(tmp_path / "bag", rows)

    exported(bag, export_own, tmp_path / "own.mcap")
    with Recording(tmp_path / "own.mcap") as recording:
        assert {name: info.static for name, info in recording.streams.items()} == {"tf": False, "tf_static": True}
        (fixed,) = [r.message for r in recording.messages(["tf_static"])]
    assert isinstance(fixed, Transforms)
    assert fixed.child_frames == ("camera", "lidar")
    assert fixed.stamp == START
    exported(tmp_path / "own.mcap", export_ros2, tmp_path / "again")

    with AnyReader([tmp_path / "again"]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == {"/tf": 2, "/tf_static": 1}
    exported(tmp_path / "again", export_own, tmp_path / "back.mcap")
    with Recording(tmp_path / "own.mcap") as one, Recording(tmp_path / "back.mcap") as other:
        assert one.digests() == other.digests()


def test_a_bag_of_static_transforms_alone_becomes_a_recording(tmp_path: Path) -> None:
    row = ("/tf_static", START, ros("tf2_msgs/TFMessage", transforms=[transform(0, "base", "camera")]))

    exported(write_ros2(tmp_path / "bag", [row]), export_own, tmp_path / "own.mcap")

    with Recording(tmp_path / "own.mcap") as recording:
        assert [r.message.child_frames for r in recording.messages()] == [("camera",)]


def test_ros_1_bag_becomes_a_ros_2_bag(tmp_path: Path) -> None:
    rows = [("/imu", START + i, ros("sensor_msgs/Imu", ROS1, header=header(START + i, "imu", ROS1))) for i in range(3)]
    exported(write_ros1(tmp_path / "a.bag", rows), export_ros2, tmp_path / "two")

    with AnyReader([tmp_path / "two"]) as reader:
        read = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()]
    assert [(m.header.frame_id, m.header.stamp.nanosec) for m in read] == [("imu", 0), ("imu", 1), ("imu", 2)]


def test_own_recording_of_a_bag_has_equal_messages(tmp_path: Path) -> None:
    with ExportSource(write_ros2(tmp_path / "bag", imus([START + i * 1000 for i in range(5)]))) as source:
        export_own(source, tmp_path / "own.mcap", Exported())
        before = [m.message.digest() for m in source.messages()]

    with Recording(tmp_path / "own.mcap") as made:
        assert [m.message.digest() for m in made.messages()] == before
        assert made.streams["imu"].metadata["topic"] == "/imu"


def test_foxglove_file_is_read_by_mcap_and_protobuf_with_boxes_and_maps(tmp_path: Path) -> None:
    kinds = {"found": Detections2D, "boxes": Boxes3D, "map": OccupancyGrid}
    path = of_robot(tmp_path / "a.mcap", frames() | {name: [example(kind)] for name, kind in kinds.items()}, STATIC)

    exported(path, export_foxglove, tmp_path / "b.mcap")

    with (tmp_path / "b.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = [(c.topic, s.name, m) for s, c, _, m in reader.iter_decoded_messages() if s is not None]
    schemas = {topic: schema for topic, schema, _ in found}
    expected = {"camera/image": "RawImage", "found": "ImageAnnotations", "boxes": "SceneUpdate", "map": "Grid"}
    assert {name: schemas[f"/{name}"].removeprefix("foxglove.") for name in expected} == expected
    boxes = next(m for topic, _, m in found if topic == "/boxes")
    assert len(boxes.entities[0].cubes) == example(Boxes3D).count


def test_csv_has_a_row_a_message_with_exact_numbers(tmp_path: Path) -> None:
    imu = [
        Imu(stamp=START + i, frame="imu", angular_velocity=[0.1 * i, 0, -0.0], linear_acceleration=np.ones(3) / 3)
        for i in range(3)
    ]
    path = of_robot(tmp_path / "a.mcap", {"imu/imu": imu} | frames(), STATIC)

    done = exported(path, export_csv, tmp_path / "out")

    rows = list(csv.DictReader((tmp_path / "out" / "imu" / "imu.csv").open()))
    assert [float(r["angular_velocity_0"]) for r in rows] == [m.angular_velocity[0] for m in imu]
    assert float(rows[0]["linear_acceleration_2"]) == 1 / 3
    assert rows[0]["orientation_0"] == ""
    assert any("data" in name for name in done.left_out)  # the pixels


def test_parquet_is_read_by_pandas(tmp_path: Path) -> None:
    pd = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    path = of_robot(tmp_path / "a.mcap", frames(), STATIC)

    exported(path, export_parquet, tmp_path / "out", ["robot1/camera/pose"])

    table = pd.read_parquet(tmp_path / "out" / "camera" / "pose.parquet")
    assert table["position_0"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert table["stamp"].dtype == np.int64


@pytest.mark.parametrize("layout", ["tum", "7scenes"])
def test_rgbd_folders_are_read_back_with_the_same_pixels_depths_and_poses(tmp_path: Path, layout: str) -> None:
    from operators.sources import RgbdFolder

    path = of_robot(tmp_path / "a.mcap", frames(), STATIC)
    exported(path, DATASETS[layout], tmp_path / "out")

    dataset = RgbdFolder(path=str(tmp_path / "out"), rate=10.0, first_stamp=START)
    dataset.setup()
    steps = list(dataset.stream())

    for step, image, depth, pose in zip(
        steps, *(frames()[f"camera/{n}"] for n in ("image", "depth", "pose")), strict=True
    ):
        assert step["image"].stamp == image.stamp
        np.testing.assert_array_equal(step["image"].data, image.data)
        np.testing.assert_allclose(step["depth"].data, depth.data, atol=6e-4)
        np.testing.assert_allclose(step["ground_truth"].position, pose.position, atol=1e-8)
        assert abs(step["ground_truth"].orientation @ pose.orientation) == pytest.approx(1)
    assert dataset.static_outputs()["depth_info"].fx == 50.0


def test_images_and_poses_without_depth_are_counted_as_lost_by_7scenes(tmp_path: Path) -> None:
    made = frames()
    made["camera/depth"] = made["camera/depth"][::3]

    done = exported(of_robot(tmp_path / "a.mcap", made, STATIC), DATASETS["7scenes"], tmp_path / "out")

    assert done.lost["camera/image"]["image of which no frame was made, left out"] == 2
    assert done.lost["camera/pose"]["pose of which no frame was made, left out"] == 2


def test_kitti_folder_is_read_back(tmp_path: Path) -> None:
    from operators.sources import KittiOdometry

    made = frames()
    stereo = {"stereo/left": made["camera/image"], "stereo/right": made["camera/image"], "pose": made["camera/pose"]}
    left, right = made["camera/image_info"][0], made["camera/depth_info"][0]
    P = np.hstack([left.K, [[-5.0], [0], [0]]])
    infos = {"stereo/left_info": [left], "stereo/right_info": [right.replace(P=P)]}
    path = of_robot(tmp_path / "a.mcap", stereo | infos, ("stereo/left_info", "stereo/right_info"))
    exported(path, DATASETS["kitti"], tmp_path / "out")

    dataset = KittiOdometry(path=str(tmp_path / "out"), first_stamp=START)
    dataset.setup()

    assert [s["left"].data.shape for s in dataset.stream()] == [(12, 16)] * 4  # image_0 is grey


def test_euroc_folder_has_readings_images_and_truth(tmp_path: Path) -> None:
    imu = [
        Imu(stamp=START + i, frame="imu", angular_velocity=[0.1, 0, 0], linear_acceleration=[0, 0, 9.81])
        for i in range(3)
    ]
    path = of_robot(tmp_path / "a.mcap", {"imu": imu, "truth": frames()["camera/pose"]})
    exported(path, DATASETS["euroc"], tmp_path / "out")

    read = np.loadtxt(tmp_path / "out/mav0/imu0/data.csv", delimiter=",")
    assert read[:, 1:].tolist() == [[0.1, 0, 0, 0, 0, 9.81]] * 3
    truth = np.loadtxt(tmp_path / "out/mav0/state_groundtruth_estimate0/data.csv", delimiter=",")
    assert truth[1, 4] == np.cos(0.1)  # w first


def test_a_choice_that_must_be_made_is_named(tmp_path: Path) -> None:
    two = frames() | {"odometry": [example(Odometry)]}
    path = of_robot(tmp_path / "a.mcap", two, STATIC)
    with pytest.raises(RecordingError, match=r"leave out with --without all but one of camera/pose, odom"):
        exported(path, DATASETS["tum"], tmp_path / "out")


@pytest.mark.data
def test_real_bags_become_ros_2_bags_with_the_same_bytes(data_dir: Path, tmp_path: Path) -> None:
    for name in ("nav2_turtlebot.mcap", "tf_example", "ros2_cdr_test.mcap", "ros2_talker.mcap"):
        bag = data_dir / "bags" / name
        exported(bag, export_ros2, tmp_path / name.partition(".")[0])
        before, after = open_bag(bag), open_bag(tmp_path / name.partition(".")[0])
        counts = [Counter((m.topic, m.log_time, bytes(m.data)) for m in b.messages(b.topics)) for b in (before, after)]
        assert counts[0] == counts[1]
        with AnyReader([tmp_path / name.partition(".")[0]]) as reader:
            assert reader.message_count == sum(counts[0].values())
