"""Values that several Foxglove protobufs share: stamps, poses, arrays as they go into a protobuf and come out of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseProto
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion as QuaternionProto
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from dataflow.messages.checks import QUATERNION_TOLERANCE
from dataflow.messages.geometry import transform_matrix
from dataflow.recording.errors import RecordingError

Parts = list[bytes | memoryview]
Fields = dict[str, Any]


def stamp_of(timestamp: Timestamp) -> int:
    """Nanoseconds since the epoch."""
    return int(timestamp.seconds) * 10**9 + int(timestamp.nanos)


def timestamp_of(stamp: int) -> Timestamp:
    return Timestamp(seconds=stamp // 10**9, nanos=stamp % 10**9)


def with_field(proto: Any, field: str, data: npt.NDArray[Any]) -> Parts:
    """`proto` serialised, followed by a bytes or packed field that is not copied: fields may come in any order."""
    number: int = proto.DESCRIPTOR.fields_by_name[field].number
    head = proto.SerializeToString()
    if not data.size:
        return [head]
    return [head + _varint(number << 3 | 2) + _varint(data.nbytes), data.reshape(-1).view(np.uint8).data]


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def frozen(values: Iterable[float], dtype: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    data = np.array(values if isinstance(values, np.ndarray) else list(values), dtype).reshape(shape)
    data.flags.writeable = False
    return data


def as_doubles(data: npt.NDArray[Any]) -> npt.NDArray[Any]:
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one, which `bits_survive` detects
        return data.astype("<f8")


def bits_survive(data: npt.NDArray[Any], wider: npt.NDArray[Any]) -> bool:
    """Returns whether `wider` cast back has the bits of `data`."""
    return wider.astype(data.dtype).tobytes() == data.tobytes()


def matrix(values: Sequence[float], name: str, shape: tuple[int, int]) -> npt.NDArray[Any]:
    if len(values) != shape[0] * shape[1]:
        raise RecordingError(f"{name} must have {shape[0] * shape[1]} elements, got {len(values)}")
    return frozen(values, "<f8", shape)


def pose_of(position: Sequence[float], orientation: Sequence[float]) -> PoseProto:
    x, y, z = position
    qx, qy, qz, qw = orientation
    return PoseProto(position=Vector3(x=x, y=y, z=z), orientation=QuaternionProto(x=qx, y=qy, z=qz, w=qw))


def placed_by(pose: PoseProto) -> npt.NDArray[np.float64] | None:
    """The pose as a matrix (4, 4); None for the identity, and for a rotation that is not set (all zeros).

    Raises `RecordingError` for one that is no pose.
    """
    position, orientation = position_of(pose.position), orientation_of(pose.orientation)
    turned = any(orientation[:3])
    if not (turned or any(position)):
        return None
    norm = float(np.linalg.norm(orientation))
    if not np.isfinite([*position, norm]).all():
        raise RecordingError(f"its pose is no pose: position {position}, orientation {orientation}")
    return transform_matrix(position, np.array(orientation) / norm if turned else (0.0, 0.0, 0.0, 1.0))


def position_of(proto: Any) -> list[float]:
    return [proto.x, proto.y, proto.z]


def orientation_of(proto: Any) -> list[float]:
    """x, y, z, w: of one that is not set (all zeros) the identity, any other of length 1; messages of ours have it."""
    found = [proto.x, proto.y, proto.z, proto.w]
    norm = math.hypot(*found)
    if norm == 0.0:
        return [0.0, 0.0, 0.0, 1.0]
    if not math.isfinite(norm) or abs(norm - 1.0) <= QUATERNION_TOLERANCE:
        return found
    return [value / norm for value in found]
