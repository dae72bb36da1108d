"""Poses, odometry, transforms and paths as Foxglove protobufs."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseProto
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion as QuaternionProto
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from dataflow.messages import Odometry, Path, Pose, Transforms
from dataflow.recording.streams.foxglove.values import (
    Fields,
    Parts,
    frozen,
    orientation_of,
    pose_of,
    position_of,
    timestamp_of,
)


def _pose_in_frame(message: Pose | Odometry) -> bytes:
    proto = PoseInFrame(
        timestamp=timestamp_of(message.stamp),
        frame_id=message.frame,
        pose=pose_of(message.position.tolist(), message.orientation.tolist()),
    )
    return bytes(proto.SerializeToString())


def encode_pose(message: Pose) -> tuple[Parts, tuple[str, ...]]:
    lacks = (("child_frame",) if message.child_frame else ()) + (() if message.covariance is None else ("covariance",))
    return [_pose_in_frame(message)], lacks


def decode_pose(proto: PoseInFrame) -> Fields:
    return {
        "frame": proto.frame_id,
        "child_frame": "",
        "position": frozen(position_of(proto.pose.position), "<f8", (3,)),
        "orientation": frozen(orientation_of(proto.pose.orientation), "<f8", (4,)),
    }


ODOMETRY_EXTRAS = ("pose_covariance", "linear", "angular", "twist_covariance")


def encode_odometry(message: Odometry) -> tuple[Parts, tuple[str, ...]]:
    extras = tuple(name for name in ODOMETRY_EXTRAS if getattr(message, name) is not None)
    return [_pose_in_frame(message)], ("child_frame", *extras)


def encode_transforms(message: Transforms) -> tuple[Parts, tuple[str, ...]]:
    stamp = timestamp_of(message.stamp)
    proto = FrameTransforms()
    rows = zip(
        message.frames, message.child_frames, message.translations.tolist(), message.rotations.tolist(), strict=True
    )
    for frame, child, (x, y, z), (qx, qy, qz, qw) in rows:
        proto.transforms.add(
            timestamp=stamp,
            parent_frame_id=frame,
            child_frame_id=child,
            translation=Vector3(x=x, y=y, z=z),
            rotation=QuaternionProto(x=qx, y=qy, z=qz, w=qw),
        )
    return [proto.SerializeToString()], ()


def decode_transforms(proto: FrameTransforms) -> Fields:
    rows = proto.transforms
    return {
        "frames": tuple(t.parent_frame_id for t in rows),
        "child_frames": tuple(t.child_frame_id for t in rows),
        "translations": frozen([v for t in rows for v in position_of(t.translation)], "<f8", (len(rows), 3)),
        "rotations": frozen([v for t in rows for v in orientation_of(t.rotation)], "<f8", (len(rows), 4)),
    }


_WIRE_POSE = np.dtype(
    [
        ("pose", "V2"),
        ("position", "V2"),
        *((part, kind) for axis in "xyz" for part, kind in ((f"p{axis}_tag", "u1"), (f"p{axis}", "<f8"))),
        ("orientation", "V2"),
        *((part, kind) for axis in "xyzw" for part, kind in ((f"q{axis}_tag", "u1"), (f"q{axis}", "<f8"))),
    ]
)
"""A `PosesInFrame.poses` entry on the wire, every number written out, so that entries have one length."""


def _wire_poses(positions: npt.NDArray[Any], orientations: npt.NDArray[Any] | None) -> npt.NDArray[Any]:
    """The `poses` field of a `PosesInFrame`: a path of thousands of poses is one array operation, not objects."""
    rows = np.zeros(len(positions), _WIRE_POSE)
    size, position, orientation = _WIRE_POSE.itemsize - 2, 3 * 9, 4 * 9
    rows["pose"] = np.void(bytes([PosesInFrame.POSES_FIELD_NUMBER << 3 | 2, size]))
    rows["position"] = np.void(bytes([PoseProto.POSITION_FIELD_NUMBER << 3 | 2, position]))
    rows["orientation"] = np.void(bytes([PoseProto.ORIENTATION_FIELD_NUMBER << 3 | 2, orientation]))
    for i, axis in enumerate("xyzw"):
        rows[f"q{axis}_tag"] = (i + 1) << 3 | 1
        rows[f"q{axis}"] = float(axis == "w") if orientations is None else orientations[:, i]
        if axis != "w":
            rows[f"p{axis}_tag"] = (i + 1) << 3 | 1
            rows[f"p{axis}"] = positions[:, i]
    return rows


def encode_path(message: Path) -> tuple[Parts, tuple[str, ...]]:
    head = PosesInFrame(timestamp=timestamp_of(message.stamp), frame_id=message.frame).SerializeToString()
    poses = _wire_poses(message.positions, message.orientations)
    lacks = (("orientations",) if message.orientations is None else ()) + (
        () if message.stamps is None else ("stamps",)
    )
    return [head, poses.tobytes()], lacks


def decode_path(proto: PosesInFrame) -> Fields:
    count = len(proto.poses)
    return {
        "frame": proto.frame_id,
        "positions": frozen([v for p in proto.poses for v in position_of(p.position)], "<f8", (count, 3)),
        "orientations": frozen([v for p in proto.poses for v in orientation_of(p.orientation)], "<f8", (count, 4)),
    }
