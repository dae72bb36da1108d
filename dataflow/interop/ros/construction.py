"""ROS 2 messages and the parts that many of them have."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dataflow.recording.errors import RecordingError

_VISION = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id\n",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id\n",
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
"""vision_msgs 4, which the library does not have."""

_VIDEO = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
"""foxglove_msgs/CompressedVideo, neither."""
_PACKET = """std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data
"""
"""ffmpeg_image_transport_msgs/FFMPEGPacket, neither."""


@cache
def typestore(distribution: Stores = Stores.ROS2_HUMBLE) -> Typestore:
    """The ROS 2 types that messages become, as a distribution defines them."""
    store = get_typestore(distribution)
    for name, text in _VISION.items():
        store.register(get_types_from_msg(text, name))
    store.register(get_types_from_msg(_VIDEO, "foxglove_msgs/msg/CompressedVideo"))
    store.register(get_types_from_msg(_PACKET, "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"))
    return store


def make(kind: str, /, **fields: Any) -> Any:
    """A ROS message of a type such as `geometry_msgs/Point`."""
    package, _, name = kind.partition("/")
    return typestore().types[f"{package}/msg/{name}"](**fields)


def time(stamp: int) -> Any:
    """A builtin_interfaces/Time; raises `RecordingError` for stamps that it cannot hold."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    if not -(2**31) <= seconds < 2**31:
        raise RecordingError(f"stamp {stamp} lies beyond the times of ROS, which end in 2038")
    return make("builtin_interfaces/Time", sec=seconds, nanosec=nanoseconds)


def header_of(stamp: int, frame: str) -> Any:
    """A std_msgs/Header."""
    return make("std_msgs/Header", stamp=time(stamp), frame_id=frame)


def stamped(kind: str, message: Any, /, **fields: Any) -> Any:
    """A ROS message whose header has the stamp and the frame of a message."""
    return make(kind, header=header_of(message.stamp, message.frame), **fields)


def vector(values: Any) -> Any:
    """A geometry_msgs/Vector3."""
    x, y, z = map(float, values)
    return make("geometry_msgs/Vector3", x=x, y=y, z=z)


def point(values: Any) -> Any:
    """A geometry_msgs/Point."""
    x, y, z = map(float, values)
    return make("geometry_msgs/Point", x=x, y=y, z=z)


def quaternion(values: Any) -> Any:
    """A geometry_msgs/Quaternion; the identity for None."""
    x, y, z, w = (0.0, 0.0, 0.0, 1.0) if values is None else map(float, values)
    return make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)


def placed_at(position: Any, orientation: Any) -> Any:
    """A geometry_msgs/Pose."""
    return make("geometry_msgs/Pose", position=point(position), orientation=quaternion(orientation))


def matrix(values: Any, size: int) -> Any:
    """A covariance, row by row; zeros for None."""
    return np.zeros(size * size) if values is None else np.asarray(values, np.float64).ravel()


def with_covariance(position: Any, orientation: Any, covariance: Any) -> Any:
    """A geometry_msgs/PoseWithCovariance."""
    pose = placed_at(position, orientation)
    return make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=matrix(covariance, 6))


def moving(linear: Any, angular: Any, covariance: Any = None) -> Any:
    """A geometry_msgs/TwistWithCovariance."""
    zero = np.zeros(3)
    linear, angular = (vector(zero if v is None else v) for v in (linear, angular))
    twist = make("geometry_msgs/Twist", linear=linear, angular=angular)
    return make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=matrix(covariance, 6))


def as_bytes(data: Any) -> Any:
    """The memory of an array."""
    return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
