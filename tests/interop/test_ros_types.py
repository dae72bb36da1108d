"""ROS messages of every mapped type become messages with what they hold."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import pytest
from made_bags import ROS1, ROS2, SECOND, header, made, ros, transform, xyz, xyzw
from made_rvl import packed_rvl
from rosbags.typesys import Stores, get_typestore

from dataflow.interop.conversions import convert
from dataflow.interop.ros import CONVERSIONS
from dataflow.interop.ros.clouds import left_out
from dataflow.interop.ros.to_ros2 import OUTWARD
from dataflow.interop.typestores import RosType
from dataflow.messages import Boxes3D, DepthImage, Image, Message, MessageError, Odometry, Path, Point, Pose
from dataflow.recording import RecordingError
from dataflow.recording.streams.codecs import SchemaText

STAMP = 5 * SECOND


def converted(message: Any) -> Any:
    return CONVERSIONS[message.__msgtype__][1](message, STAMP)


def flat(values: Any) -> np.ndarray:
    return np.frombuffer(np.ascontiguousarray(values).tobytes(), np.uint8)


def test_every_mapped_type_is_a_type_of_ros() -> None:
    known = {name for store in Stores for name in get_typestore(store).fielddefs} | set(ROS2.fielddefs)

    assert set(CONVERSIONS) - known == {"tf/msg/tfMessage"}  # of ROS before Groovy


def test_encoding_distinguishes_image_from_depth() -> None:
    bgr = {"encoding": "bgr8", "step": 3, "data": flat(np.uint8([1, 2, 3]))}
    deep = {"encoding": "16UC1", "step": 2, "data": flat(np.uint16([1500]))}
    colour, depth = (
        converted(ros("sensor_msgs/Image", header=header(1, "c"), height=1, width=1, **one)) for one in (bgr, deep)
    )

    assert (type(colour), colour.frame, colour.data.tolist()) == (Image, "c", [[[3, 2, 1]]])
    assert (type(depth), depth.data.tolist()) == (DepthImage, [[1.5]])


def test_compressed_image_decodes_to_its_pixels() -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (5, 7, 3), np.uint8)
    png = cv2.imencode(".png", pixels[..., ::-1])[1]
    message = ros("sensor_msgs/CompressedImage", format="rgb8; png compressed bgr8", data=flat(png))

    found = converted(message)

    assert found.format == "png"
    np.testing.assert_array_equal(convert(found, Image).data, pixels)


def test_compressed_depth_of_both_kinds_decodes_to_metres() -> None:
    def sent(kind: str, pixels: np.ndarray, *scale: float) -> Any:
        data = struct.pack("<iff", 0, *scale) + cv2.imencode(".png", pixels)[1].tobytes()
        return ros("sensor_msgs/CompressedImage", format=f"{kind}; compressedDepth png", data=flat(np.uint8([*data])))

    plain = converted(sent("16UC1", np.uint16([[0, 1500, 40000]]), 0.0, 0.0))
    inverse = converted(sent("32FC1", np.uint16([[0, 59]]), 100.0, 9.0))  # metres = 100 / (value - 9)

    np.testing.assert_allclose(convert(plain, DepthImage).data, [[0, 1.5, 40.0]])
    np.testing.assert_allclose(convert(inverse, DepthImage).data, [[0, 2.0]])
    with pytest.raises(RecordingError, match="RVL image of 0 pixels"):
        converted(ros("sensor_msgs/CompressedImage", format="16UC1; compressedDepth rvl", data=np.zeros(20, np.uint8)))


def test_depth_in_rvl_is_read_as_its_encoder_has_it() -> None:
    """`compressed_depth_image_transport`: int format, float A, B; columns, rows; RVL."""
    units = np.array([[0, 1500, 1501], [0, 0, 65535]], np.uint16)
    body = struct.pack("<iff", 0, 40.0, 1.5) + struct.pack("<II", 3, 2) + packed_rvl(units)

    plain = ros("sensor_msgs/CompressedImage", format="16UC1; compressedDepth rvl", data=np.frombuffer(body, np.uint8))
    inverse = ros("sensor_msgs/CompressedImage", format="32FC1; compressedDepth rvl", data=plain.data)

    np.testing.assert_array_equal(converted(plain).data, units.astype(np.float32) / np.float32(1000))
    expected = np.where(units > 0, 40.0 / np.maximum(units - 1.5, 1), 0)
    np.testing.assert_allclose(converted(inverse).data, expected, rtol=1e-6)


def info(store: Any = ROS2, **fields: Any) -> Any:
    return ros("sensor_msgs/CameraInfo", store, header=header(1, "c", store), height=480, width=640, **fields)


def test_camera_info_of_ros_1_and_2() -> None:
    K = np.array([500.0, 0, 320, 0, 501, 240, 0, 0, 1])
    P = np.hstack([K.reshape(3, 3), [[-50.0], [0], [0]]]).ravel()

    two = converted(info(k=K, d=np.array([0.1, 0, 0, 0, 0]), distortion_model="plumb_bob", r=np.eye(3).ravel(), p=P))
    one = converted(info(ROS1, K=K, D=np.zeros(0), distortion_model=""))

    assert (two.fx, two.fy, two.distortion_model, two.P[0, 3]) == (500.0, 501.0, "plumb_bob", -50.0)
    assert (one.distortion_model, one.distortion, one.R, one.P) == ("none", None, None, None)
    with pytest.raises(RecordingError, match="is not calibrated"):
        converted(info())


FIELD = "sensor_msgs/msg/PointField"


def cloud(dtype: np.dtype, points: list[tuple[Any, ...]], order: str = "<", rows: int = 1) -> Any:
    kinds = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    data = np.array(points, dtype)
    fields = [
        made(ROS2, FIELD, {"name": n, "offset": dtype.fields[n][1], "datatype": kinds[dtype[n].str[1:]], "count": 1})
        for n in dtype.names
    ]
    about = {"height": rows, "width": len(points) // rows, "is_bigendian": order == ">"}
    sizes = {"point_step": dtype.itemsize, "row_step": dtype.itemsize * len(points) // rows}
    return ros("sensor_msgs/PointCloud2", header=header(STAMP), fields=fields, data=flat(data), **about, **sizes)


def test_cloud_with_the_fields_of_a_spinning_lidar_and_others() -> None:
    names = ["x", "y", "z", "reflectivity", "ring", "t", "ambient"]
    formats, offsets = ["<f4", "<f4", "<f4", "<u2", "<u1", "<u4", "<u2"], [0, 4, 8, 16, 20, 24, 30]
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": 48})  # padded, as Ouster's
    message = cloud(layout, [(1, 2, 3, 9, 4, 1_000_000, 7), (4, 5, 6, 8, 5, 2_000_000, 7)], rows=2)

    found = converted(message)

    assert found.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert (found.intensities.tolist(), found.rings.tolist()) == ([9, 8], [4, 5])
    np.testing.assert_allclose(found.time_offsets, [0.001, 0.002], rtol=1e-6)
    assert left_out(message) == ("ambient",)


def test_cloud_with_colours_doubles_normals_and_the_other_byte_order() -> None:
    names = ["x", "y", "z", "rgb", "normal_x", "normal_y", "normal_z"]
    layout = np.dtype([(n, ">u4" if n == "rgb" else ">f8") for n in names])
    found = converted(cloud(layout, [(1, 2, 3, 0x010203, 0, 0, 1)], ">"))

    assert found.points.tolist() == [[1, 2, 3]]
    assert found.colors.tolist() == [[1, 2, 3]]
    assert found.normals.tolist() == [[0, 0, 1]]


def test_point_times_since_the_epoch_become_offsets() -> None:
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")])
    now = 1_700_000_000.25
    message = cloud(layout, [(1, 2, 3, now), (1, 2, 3, now + 0.05)])
    message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000, 250_000_000

    np.testing.assert_allclose(converted(message).time_offsets, [0.0, 0.05], atol=1e-6)


def test_cloud_without_z_is_refused_with_its_fields() -> None:
    with pytest.raises(RecordingError, match="its fields are x, y"):
        converted(cloud(np.dtype([("x", "<f4"), ("y", "<f4")]), [(1, 2)]))


def test_imu_without_orientation_and_with_unknown_covariances() -> None:
    covariances = {
        "orientation_covariance": np.array([-1.0, *[0] * 8]),
        "linear_acceleration_covariance": np.eye(3).ravel(),
    }
    found = converted(ros("sensor_msgs/Imu", orientation=xyzw(0, 0, 0, 1), **covariances))

    assert found.orientation is None
    assert found.orientation_covariance is None
    assert found.angular_velocity_covariance is None
    assert found.linear_acceleration_covariance.tolist() == np.eye(3).tolist()


def test_scan_angles_follow_from_the_increment() -> None:
    scan = {"angle_min": -1.0, "angle_max": 9.0, "angle_increment": 0.5, "range_max": 10.0, "time_increment": 0.01}
    found = converted(ros("sensor_msgs/LaserScan", ranges=np.float32([1, 2, 3]), **scan))

    assert (found.angle_min, found.angle_max, found.intensities) == (-1.0, 0.0, None)
    np.testing.assert_allclose(found.time_offsets, [0, 0.01, 0.02])


def test_satellite_fix_without_a_fix() -> None:
    status = ros("sensor_msgs/NavSatStatus", status=-1)
    fix = {"latitude": float("nan"), "longitude": float("nan"), "position_covariance_type": 2}
    found = converted(ros("sensor_msgs/NavSatFix", status=status, position_covariance=np.eye(3).ravel(), **fix))

    assert (found.status, found.covariance_type) == ("no_fix", "diagonal_known")


def test_odometry_and_poses() -> None:
    placed = ros("geometry_msgs/Pose", position=xyz(1, 2, 3, "Point"), orientation=xyzw(0, 0, 0.6, 0.8))
    with_covariance = ros("geometry_msgs/PoseWithCovariance", pose=placed, covariance=np.eye(6).ravel())
    odometry = converted(
        ros("nav_msgs/Odometry", header=header(1, "/odom"), child_frame_id="base", pose=with_covariance)
    )
    pose = converted(ros("geometry_msgs/PoseWithCovarianceStamped", header=header(1, "map"), pose=with_covariance))

    assert (odometry.frame, odometry.child_frame, odometry.orientation.tolist()) == ("odom", "base", [0, 0, 0.6, 0.8])
    assert odometry.twist_covariance is None
    assert (pose.frame, pose.position.tolist(), pose.covariance.tolist()) == ("map", [1, 2, 3], np.eye(6).tolist())
    assert convert(odometry, Pose).covariance.tolist() == np.eye(6).tolist()
    assert convert(pose, Odometry).position.tolist() == [1, 2, 3]


def test_orientation_that_is_not_set_is_the_identity_and_others_are_normalised() -> None:
    unset = converted(ros("geometry_msgs/PoseStamped"))
    long = converted(ros("geometry_msgs/Pose", orientation=xyzw(0, 0, 2, 0)))

    assert unset.orientation.tolist() == [0, 0, 0, 1]
    assert long.orientation.tolist() == [0, 0, 1, 0]


def test_a_point_comes_in_and_goes_out() -> None:
    place = ros("geometry_msgs/Point", x=1.0, y=2.0, z=3.0)
    point = converted(ros("geometry_msgs/PointStamped", header=header(7, "map"), point=place))

    back = OUTWARD[Point](point)

    assert point == Point(stamp=point.stamp, frame="map", position=np.array([1.0, 2.0, 3.0]))
    assert (back.__msgtype__, back.header.frame_id, back.point.y) == ("geometry_msgs/msg/PointStamped", "map", 2.0)
    assert converted(place).position.tolist() == [1, 2, 3]


def test_path_is_timed_where_its_stamps_increase() -> None:
    def poses(*stamps: int) -> list[Any]:
        return [ros("geometry_msgs/PoseStamped", header=header(s)) for s in stamps]

    assert converted(ros("nav_msgs/Path", poses=poses(1, 2))).stamps.tolist() == [1, 2]
    assert converted(ros("nav_msgs/Path", poses=poses(0, 0))).stamps is None
    assert converted(ros("nav_msgs/Path")).count == 0


def test_grid_rows_begin_at_the_origin() -> None:
    meta = ros("nav_msgs/MapMetaData", resolution=0.5, width=2, height=1)
    found = converted(ros("nav_msgs/OccupancyGrid", info=meta, data=np.int8([-1, 100])))

    assert (found.cells.tolist(), found.resolution, found.orientation.tolist()) == ([[-1, 100]], 0.5, [0, 0, 0, 1])


def test_transforms_of_one_child_the_last_counts_and_slashes_go() -> None:
    rows = [transform(1, "/map", "/odom", 1.0), transform(1, "map", "odom", 2.0), transform(1, "odom", "odom")]
    found = converted(ros("tf2_msgs/TFMessage", transforms=rows))

    assert (found.frames, found.child_frames, found.translations.tolist()) == (("map",), ("odom",), [[2, 0, 0]])


def hypothesis(name: str, score: float) -> Any:
    inner = ros("vision_msgs/ObjectHypothesis", class_id=name, score=score)
    return ros("vision_msgs/ObjectHypothesisWithPose", hypothesis=inner)


def test_detections_take_the_best_hypothesis() -> None:
    center = ros("vision_msgs/Pose2D", position=ros("vision_msgs/Point2D", x=10.0, y=20.0), theta=np.pi / 2)
    box = ros("vision_msgs/BoundingBox2D", center=center, size_x=4.0, size_y=8.0)
    guesses = [hypothesis("cup", 0.2), hypothesis("mug", 0.7)]
    one = ros("vision_msgs/Detection2D", results=guesses, bbox=box, id="7")
    found = converted(ros("vision_msgs/Detection2DArray", detections=[one]))
    solid = ros("vision_msgs/BoundingBox3D", size=xyz(1, 2, 3))
    boxes = converted(ros("vision_msgs/Detection3DArray", detections=[ros("vision_msgs/Detection3D", bbox=solid)]))

    np.testing.assert_allclose(found.boxes, [[6, 18, 14, 22]], atol=1e-5)  # the box lies on its side
    assert (found.labels(), found.ids.tolist()) == (("mug",), [7])
    assert found.scores.tolist() == pytest.approx([0.7])
    assert (boxes.sizes.tolist(), boxes.ids) == ([[1, 2, 3]], None)


def test_markers_that_map_and_one_that_does_not() -> None:
    pose = ros("geometry_msgs/Pose", position=xyz(1, 0, 0, "Point"), orientation=xyzw(0, 0, 1, 0))
    points = [xyz(1, 0, 0, "Point"), xyz(2, 0, 0, "Point")]
    cubes = converted(ros("visualization_msgs/Marker", type=6, pose=pose, points=points, scale=xyz(1, 1, 1), ns="box"))
    line = converted(ros("visualization_msgs/Marker", type=4, points=points))
    sphere, cube = (ros("visualization_msgs/Marker", type=kind, scale=xyz(1, 1, 1)) for kind in (2, 1))
    array = converted(ros("visualization_msgs/MarkerArray", markers=[sphere, cube]))

    assert isinstance(cubes, Boxes3D)
    np.testing.assert_allclose(cubes.centers, [[0, 0, 0], [-1, 0, 0]], atol=1e-12)  # half a turn about its pose
    assert cubes.labels() == ("box", "box")
    assert isinstance(line, Path)
    assert array.count == 1
    with pytest.raises(RecordingError, match="type 2 has no counterpart"):
        converted(sphere)


@pytest.mark.parametrize(
    ("message", "field", "value"),
    [
        (ros("std_msgs/String", data="hello"), "text", "hello"),
        (ros("std_msgs/Bool", data=True), "on", True),
        (ros("std_msgs/Int16", data=7), "value", 7.0),
        (ros("sensor_msgs/Temperature", temperature=21.5), "unit", "°C"),
        (ros("rcl_interfaces/Log", level=40, name="node", msg="no"), "level", "error"),
        (ros("sensor_msgs/MagneticField", magnetic_field=xyz(1, 2, 3)), "covariance", None),
        (ros("geometry_msgs/TwistStamped", header=header(1, "base")), "frame", "base"),
        (ros("sensor_msgs/JointState", name=["a"], position=np.ones(1)), "velocities", None),
    ],
)
def test_small_types(message: Any, field: str, value: Any) -> None:
    found = converted(message)

    assert (found.stamp, getattr(found, field)) == (STAMP, value)


def test_mapped_types_with_empty_fields_convert_or_raise() -> None:
    refused = {"Image", "CompressedImage", "CameraInfo", "PointCloud2", "OccupancyGrid", "Marker", "LaserScan"}
    refused |= {"CompressedVideo", "FFMPEGPacket"}
    for name in CONVERSIONS:
        for store in (ROS2, ROS1):
            if name not in store.fielddefs:
                continue
            try:
                assert isinstance(CONVERSIONS[name][1](made(store, name, {}), STAMP), Message)
            except (RecordingError, MessageError):
                assert name.rpartition("/")[2] in refused


TEMPERATURE = """std_msgs/Header header
float64 temperature
float64 variance
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
IDL = """module builtin_interfaces { module msg { struct Time { int32 sec; uint32 nanosec; }; }; };
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
module sensor_msgs { module msg {
  struct Temperature { std_msgs::msg::Header header; double temperature; double variance; };
}; };
"""


@pytest.mark.parametrize(
    ("name", "encoding", "text"),
    [
        ("sensor_msgs/msg/Temperature", "ros2msg", TEMPERATURE.replace("\n", "\r\n")),
        ("sensor_msgs/msg/Temperature", "ros2msg", "\ufeff" + TEMPERATURE),
        ("sensor_msgs/msg/Temperature", "ros2msg", TEMPERATURE.replace("=" * 80, "=" * 40)),
        ("sensor_msgs::msg::Temperature", "omgidl", IDL),
    ],
    ids=["lines of Windows", "byte order mark", "short rule", "IDL of Foxglove"],
)
def test_definitions_are_read_as_other_systems_write_them(name: str, encoding: str, text: str) -> None:
    sent = ros("sensor_msgs/Temperature", header=header(STAMP), temperature=21.5)

    kind = RosType(name, "cdr", SchemaText(name, encoding, text.encode()))

    assert kind.parse(ROS2.serialize_cdr(sent, sent.__msgtype__)).temperature == 21.5
    assert kind.name == "sensor_msgs/msg/Temperature"
