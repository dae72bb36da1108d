"""Messages that are odd and honest, as others' drivers write them: what is read of them, what is named as lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from made_bags import ROS2, SECOND, header, ros, transform, write_ros2, xyzw

from dataflow.interop.account import Account
from dataflow.interop.export.own import export_own
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.interop.ros.construction import with_covariance
from dataflow.messages import Message
from dataflow.recording import Recording

T = 1_700_000_037 * SECOND
RNG = np.random.default_rng(1)
GREY16 = RNG.integers(0, 1 << 16, (6, 8), np.uint16)
METRES = RNG.uniform(1, 4, (6, 8)).astype(np.float32)
COLOUR = RNG.integers(0, 256, (6, 8, 3), np.uint8)
XYZ = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]


def raw(encoding: str, width: int, height: int, step: int, size: int) -> Any:
    data = np.arange(size, dtype=np.uint8)
    about = {"encoding": encoding, "width": width, "height": height, "step": step}
    return ros("sensor_msgs/Image", header=header(T), data=data, **about)


def encoded(format_: str, data: bytes) -> Any:
    return ros("sensor_msgs/CompressedImage", header=header(T), format=format_, data=np.frombuffer(data, np.uint8))


def file(suffix: str, pixels: Any) -> bytes:
    return cv2.imencode(suffix, pixels)[1].tobytes()


def cloud(fields: list[tuple[str, int, int, int]], rows: Any, width: int | None = None, **about: Any) -> Any:
    """A cloud; `fields`: name, offset, datatype and count of each; `rows`: (N,) of the points' bytes."""
    parts = [ros("sensor_msgs/PointField", name=n, offset=o, datatype=d, count=c) for n, o, d, c in fields]
    data = np.frombuffer(rows.tobytes(), np.uint8)
    about = {"height": 1, "point_step": rows.itemsize, **about}
    return ros(
        "sensor_msgs/PointCloud2", header=header(T), fields=parts, width=len(rows) if width is None else width,
        data=data, **about,
    )  # fmt: skip


def points(count: int, *more: tuple[str, str]) -> Any:
    return np.ones(count, np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), *more]))


def timed() -> Any:
    rows = points(20, ("timestamp", "f4"))
    rows["timestamp"] = T / 1e9 + np.arange(20) * 0.005
    return cloud([*XYZ, ("timestamp", 12, 7, 1)], rows)


def organised_short() -> Any:
    """Two rows of three points, 40 bytes a row, the second without its 4 bytes of padding."""
    rows = points(3).tobytes()
    flat = np.frombuffer(rows + bytes(4) + rows, np.dtype("u1"))
    return cloud(XYZ, flat, width=3, height=2, row_step=40, point_step=12)


def camera(model: str, coefficients: int, *more: float) -> Any:
    K = np.array([50.0, 0, 32, 0, 50, 24, 0, 0, 1])
    d = np.array([0.1] * coefficients + [*more])
    about = {"width": 64, "height": 48, "distortion_model": model}
    return ros("sensor_msgs/CameraInfo", header=header(T), d=d, k=K, **about)


def path() -> Any:
    pose = ros("geometry_msgs/Pose", orientation=xyzw(0, 0, 0, 1))
    poses = [ros("geometry_msgs/PoseStamped", header=header(T + s, "sensor"), pose=pose) for s in (0, 5, 3)]
    return ros("nav_msgs/Path", header=header(T), poses=poses)


def unknown_errors() -> Any:
    odometry = ros("nav_msgs/Odometry", header=header(T), child_frame_id="base")
    odometry.pose.pose.orientation.w = 1.0
    odometry.pose.covariance[:] = np.nan
    odometry.twist.covariance[0] = -1
    return odometry


def transforms() -> Any:
    rows = [transform(T, "map", "good"), transform(T, "map", "nan", float("nan")), transform(T, "map", ""),
            transform(T, "", "lone")]  # fmt: skip
    return ros("tf2_msgs/TFMessage", transforms=rows)


def grid(width: int, cells: list[int]) -> Any:
    info = ros("nav_msgs/MapMetaData", resolution=0.1, width=width, height=2)
    return ros("nav_msgs/OccupancyGrid", header=header(T), info=info, data=np.array(cells, np.int8))


def fix() -> Any:
    return ros("sensor_msgs/NavSatFix", header=header(T), latitude=42.0, longitude=274.25, altitude=5.0)


ODD: dict[str, tuple[Any, Callable[[Any], bool], str]] = {
    "padding": (
        cloud([*XYZ, ("_", 12, 7, 1), ("_", 16, 7, 1)], points(4, ("a", "f4"), ("b", "f4"))),
        lambda m: m.count == 4,
        "the field _ of the points",
    ),
    "more": (cloud(XYZ, points(50), 20), lambda m: m.count == 20, "360 bytes behind the last of 20x1 points"),
    "float32_epoch": (timed(), lambda m: m.time_offsets is None, "32 bits hold times of the epoch in steps of 128 s"),
    "short_cloud": (organised_short(), lambda m: m.count == 6 and (m.points == 1).all(), ""),
    "scan": (
        ros("sensor_msgs/LaserScan", header=header(T), ranges=np.ones(20, "f4"), intensities=np.ones(10, "f4"),
            angle_increment=0.1, range_max=9.0),
        lambda m: m.intensities is None,
        "intensities, 10 for 20 ranges",
    ),
    "tiff_depth": (
        encoded("32FC1; tiff compressed", file(".tiff", METRES)), lambda m: np.array_equal(m.data, METRES), ""
    ),
    "tiff_grey": (
        encoded("mono16; tiff compressed", file(".tiff", GREY16)), lambda m: np.array_equal(m.data, GREY16), ""
    ),
    "bmp": (encoded("bmp", file(".bmp", COLOUR)), lambda m: np.array_equal(m.data, COLOUR[..., ::-1]), ""),
    "bare_depth": (
        encoded("16UC1; compressedDepth png", file(".png", GREY16)),
        lambda m: m.data.tobytes() == file(".png", GREY16) and m.scale == 0.001,
        "",
    ),
    "depth_in_capitals": (
        encoded("16UC1; CompressedDepth PNG", bytes(12) + file(".png", GREY16)),
        lambda m: m.data.tobytes() == file(".png", GREY16), "",
    ),
    "short_image": (raw("mono8", 6, 3, 8, 22), lambda m: m.data[2].tolist() == [16, 17, 18, 19, 20, 21], ""),
    "wrong_step": (
        raw("rgb8", 4, 3, 4, 36), lambda m: m.data[1, 0].tolist() == [12, 13, 14], "a step of 4, where rows have 12"
    ),
    "plumb_bob_8": (
        camera("plumb_bob", 8), lambda m: m.distortion_model == "rational_polynomial", "no 8 coefficients"
    ),
    "plumb_bob_2": (
        camera("plumb_bob", 2), lambda m: (m.distortion_model, *m.distortion) == ("plumb_bob", 0.1, 0.1, 0, 0), ""
    ),
    "equidistant_5": (
        camera("equidistant", 4, 0.0), lambda m: (m.distortion_model, *m.distortion) == ("equidistant", *[0.1] * 4), ""
    ),
    "rational_polynomial_5": (
        camera("rational_polynomial", 5),
        lambda m: (m.distortion_model, *m.distortion) == ("rational_polynomial", *[0.1] * 5, 0, 0, 0),
        "",
    ),
    "distortion": (
        camera("plumb_bob", 4, float("nan")), lambda m: m.distortion is None, "a distortion that is not finite"
    ),
    "pose": (with_covariance(np.zeros(3), None, np.eye(6)), lambda m: (m.covariance == np.eye(6)).all(), ""),
    "path": (path(), lambda m: m.stamps is None, "the times of its poses"),
    "odometry": (
        unknown_errors(),
        lambda m: m.pose_covariance is None and m.twist_covariance is None,
        "covariance that is not finite",
    ),
    "temperature": (
        ros("sensor_msgs/Temperature", header=header(T), variance=float("nan")), lambda m: m.variance is None,
        "variance that is not finite",
    ),
    "tf": (transforms(), lambda m: m.child_frames == ("good",), "a transform to nan that is not finite"),
    "scan_in_degrees": (
        ros("sensor_msgs/LaserScan", header=header(T), ranges=np.ones(20, "f4"), angle_min=-1.0, angle_max=1.0,
            angle_increment=1.0, range_max=9.0),
        lambda m: m.angle_max == 18.0,
        "angle_max of 1, where 20 beams by their increment end at 18",
    ),
    "scan_of_a_beam_more": (
        ros("sensor_msgs/LaserScan", header=header(T), ranges=np.ones(20, "f4"), angle_min=-1.0, angle_max=1.0,
            angle_increment=0.1, range_max=9.0),
        lambda m: len(m.ranges) == 20,
        "",
    ),
    "grid": (
        grid(3, [0, 100, -1, 101, -128, 7]), lambda m: m.cells.tolist() == [[0, 100, -1], [-1, -1, 7]],
        "cells that are neither -1 nor 0 to 100, such as 101",
    ),
    "whole_numbers": (
        cloud([(n, 2 * k, 3, 1) for k, n in enumerate("xyz")], np.ones(4, [("x", "i2"), ("y", "i2"), ("z", "i2")])),
        lambda m: (m.points == 1).all(),
        "the unit of x, y, z, whole numbers",
    ),
    "negative_variances": (
        with_covariance(np.zeros(3), None, -0.5 * np.eye(6)), lambda m: m.covariance is None,
        "covariance with a negative variance",
    ),
    "fisheye": (camera("fisheye", 4), lambda m: m.distortion_model == "equidistant", "the name 'fisheye'"),
    "radtan": (camera("radtan", 4), lambda m: m.distortion_model == "plumb_bob", "the name 'radtan'"),
    "pinhole": (camera("pinhole", 0), lambda m: m.distortion_model == "none", "the name 'pinhole'"),
    "fix": (fix(), lambda m: m.longitude == 274.25 - 360, "a longitude of 180 to 360 degrees"),
}  # fmt: skip
"""By topic: the message, what has to be so of what is read, and words of what is lost."""


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Message], Account]:
    folder = tmp_path_factory.mktemp("odd")
    bag = write_ros2(folder / "bag", [(f"/{name}", T, message) for name, (message, _, _) in ODD.items()])
    with ExportSource(bag) as source:
        export_own(source, folder / "o.mcap", Exported())
        account = source.account
    with Recording(folder / "o.mcap") as recording:
        return {m.stream: m.message for m in recording.messages()}, account


@pytest.mark.parametrize("name", ODD)
def test_an_odd_message_is_read_as_far_as_it_makes_sense_and_the_rest_is_named(
    read: tuple[dict[str, Message], Account], name: str
) -> None:
    messages, account = read
    _, right, lost = ODD[name]

    assert right(messages[name])
    found = account.lost.get(f"/{name}", {})
    assert any(lost in text for text in found) if lost else not found


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (cloud([("x", 0, 7, 3), *XYZ[1:]], points(6)), "whose field x has 3 values a point"),
        (
            encoded("32FC3; tiff compressed", file(".tiff", COLOUR.astype(np.float32))),
            "holds float32 of 6x8x3, which no",
        ),
        (encoded("16UC1; tiff compressed", file(".tiff", COLOUR.astype(np.uint16))), "holds uint16 of 6x8x3, which no"),
        (encoded("tiff", file(".tiff", METRES.astype(np.int32))), "holds int32 of 6x8, which no"),
        (camera("equidistant", 5), "a distortion of 5 coefficients, of which equidistant has 4 at most"),
        (encoded("h264", b"\0\0\0\x1f\x65\x88" + bytes(40)), "without a start code"),
        (grid(4, [0] * 5), "a grid of 4x2 cells needs 8, got 5"),
        (ros("visualization_msgs/Marker", header=header(T), type=1, action=2), "a marker that deletes"),
    ],
    ids=["values", "float colours", "colours as depth", "int32", "coefficients", "AVCC", "cells", "deletion"],
)
def test_a_message_that_makes_no_sense_is_left_as_it_is_with_its_reason(
    tmp_path: Path, message: Any, reason: str
) -> None:
    bag = write_ros2(tmp_path / "bag", [("/odd", T, message), ("/fix", T, fix())])

    with ExportSource(bag) as source:
        assert [t.name for t in source.untouched] == ["/odd"]
        assert any(reason in note for note in source.account.notes)
        assert bytes(next(iter(source.stored(["/odd"]))).data) == ROS2.serialize_cdr(message, message.__msgtype__)
