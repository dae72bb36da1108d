"""Bags of ROS, written by the `rosbags` library."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SECOND = 1_000_000_000
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
_FURTHER = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\n"
        "string id\n"
    ),
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
        "string id\n"
    ),
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n"
    ),
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
ROS2.register({k: v for name, text in _FURTHER.items() for k, v in get_types_from_msg(text, name).items()})

Row = tuple[str, int, Any]
"""(topic, log time, ROS message)"""


def ros(kind: str, store: Any = ROS2, **fields: Any) -> Any:
    """A ROS message with some fields set, the others zero or empty: `ros("sensor_msgs/Imu", header=header(5))`."""
    package, _, name = kind.partition("/")
    return made(store, f"{package}/msg/{name}", fields)


def made(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    values = {}
    for name, description in store.fielddefs[kind][1]:
        values[name] = fields.pop(name) if name in fields else _empty(store, description)
    assert not fields, f"{kind} has no {', '.join(fields)}"
    return store.types[kind](**values)


def _empty(store: Any, description: Any) -> Any:
    node, what = int(description[0]), description[1]
    if node == 1:
        return "" if what[0] == "string" else False if what[0] == "bool" else 0.0 if "float" in what[0] else 0
    if node == 2:
        return made(store, what, {})
    (inner, size) = what
    count = size if node == 3 else 0
    if int(inner[0]) == 1 and inner[1][0] != "string":
        return np.zeros(
            count, {"bool": "bool", "byte": "u1", "char": "u1", "octet": "u1"}.get(inner[1][0], inner[1][0])
        )
    return [_empty(store, inner) for _ in range(count)]


def header(stamp: int, frame: str = "sensor", store: Any = ROS2) -> Any:
    time = made(store, "builtin_interfaces/msg/Time", {"sec": stamp // SECOND, "nanosec": stamp % SECOND})
    return made(store, "std_msgs/msg/Header", {"stamp": time, "frame_id": frame})


def xyz(x: float, y: float, z: float, kind: str = "Vector3", store: Any = ROS2) -> Any:
    return made(store, f"geometry_msgs/msg/{kind}", {"x": float(x), "y": float(y), "z": float(z)})


def xyzw(x: float, y: float, z: float, w: float, store: Any = ROS2) -> Any:
    kind = "geometry_msgs/msg/Quaternion"
    return made(store, kind, {"x": float(x), "y": float(y), "z": float(z), "w": float(w)})


def transform(stamp: int, frame: str, child: str, x: float = 0.0) -> Any:
    placed = ros("geometry_msgs/Transform", translation=xyz(x, 0, 0), rotation=xyzw(0, 0, 0, 1))
    return ros("geometry_msgs/TransformStamped", header=header(stamp, frame), child_frame_id=child, transform=placed)


def write_ros2(path: Path, rows: Iterable[Row], storage: str = "mcap", declared: Iterable[str] = ()) -> Path:
    """A ROS 2 bag folder with `sqlite3` or `mcap` storage; returns its path. `declared`: topics of images, empty."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        known: dict[str, Any] = {}
        for topic in declared:
            writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=ROS2)
        for topic, time, message in rows:
            if topic not in known:
                known[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ROS2)
            writer.write(known[topic], time, ROS2.serialize_cdr(message, message.__msgtype__))
    return path


def write_ros1(path: Path, rows: Iterable[Row]) -> Path:
    """A ROS 1 bag file; returns its path."""
    with Writer1(path) as writer:
        known: dict[str, Any] = {}
        for topic, time, message in rows:
            if topic not in known:
                known[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ROS1)
            writer.write(known[topic], time, ROS1.serialize_ros1(message, message.__msgtype__))
    return path


def imus(stamps: Sequence[int], late: int = 0) -> list[Row]:
    """An Imu for each stamp on /imu, recorded `late` ns after it, its reading the number of the message."""
    return [
        ("/imu", stamp + late, ros("sensor_msgs/Imu", header=header(stamp, "imu"), angular_velocity=xyz(i, 0, 0)))
        for i, stamp in enumerate(stamps)
    ]
