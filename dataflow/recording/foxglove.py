"""The well-known message types as Foxglove protobuf messages: each type's fields there, and what those lack.

An `encode` function returns the protobuf as parts (large arrays are not copied into it) and `lacks`: the names of the
fields that the protobuf does not hold exactly. They go into the companion. A `decode` function returns the fields that
the protobuf holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage as CompressedImageProto
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan as LaserScanProto
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as PointCloudProto
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseProto
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion as QuaternionProto
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from dataflow.messages import (
    Alarm,
    CameraInfo,
    CompressedImage,
    DepthImage,
    Image,
    LaserScan,
    Message,
    NavSatFix,
    Odometry,
    Path,
    PointCloud,
    Pose,
    Transforms,
)
from dataflow.recording.errors import RecordingError

Parts = list[bytes | memoryview]
Fields = dict[str, Any]
Encode = Callable[[Any], tuple[Parts, tuple[str, ...]]]
Decode = Callable[[Any], Fields]

UINT32_MAX = 2**32 - 1
NUMERIC = PackedElementField
_NUMERIC_DTYPES: dict[int, np.dtype[Any]] = {
    NUMERIC.UINT8: np.dtype("u1"),
    NUMERIC.INT8: np.dtype("i1"),
    NUMERIC.UINT16: np.dtype("<u2"),
    NUMERIC.INT16: np.dtype("<i2"),
    NUMERIC.UINT32: np.dtype("<u4"),
    NUMERIC.INT32: np.dtype("<i4"),
    NUMERIC.FLOAT32: np.dtype("<f4"),
    NUMERIC.FLOAT64: np.dtype("<f8"),
}
LOG_LEVELS = ("info", "debug", "info", "warning", "error", "fatal")
"""In the order of `Log.Level`; an unknown one is read as info."""
COVARIANCE_TYPES = ("unknown", "approximated", "diagonal_known", "known")
"""In the order of `LocationFix.PositionCovarianceType`."""


@dataclass(frozen=True, slots=True)
class FoxgloveSchema:
    """Mapping of one message type to a Foxglove protobuf."""

    message: type[Message]
    proto: type[Any]
    encode: Encode
    decode: Decode
    companion: tuple[str, ...] = ()
    """Every field that may have to go into the companion."""

    @property
    def name(self) -> str:
        return str(self.proto.DESCRIPTOR.full_name)

    def parse(self, data: Any) -> Any:
        """The protobuf object; raises `RecordingError`."""
        parsed = self.proto()
        try:
            parsed.ParseFromString(data)
        except DecodeError as error:
            raise RecordingError(f"not a {self.name}: {error}") from error
        return parsed


def file_descriptor_set(proto: type[Any]) -> bytes:
    """The self-contained schema of a protobuf class, as MCAP wants it."""
    files = FileDescriptorSet()
    seen: set[str] = set()

    def add(descriptor: Any) -> None:
        if descriptor.name in seen:
            return
        seen.add(descriptor.name)
        for dependency in descriptor.dependencies:
            add(dependency)
        descriptor.CopyToProto(files.file.add())

    add(proto.DESCRIPTOR.file)
    return bytes(files.SerializeToString(deterministic=True))


def stamp_of(timestamp: Timestamp) -> int:
    """Nanoseconds since the epoch."""
    return int(timestamp.seconds) * 10**9 + int(timestamp.nanos)


def _timestamp(stamp: int) -> Timestamp:
    return Timestamp(seconds=stamp // 10**9, nanos=stamp % 10**9)


def _with_field(proto: Any, field: str, data: npt.NDArray[Any]) -> Parts:
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


def _frozen(values: Iterable[float], dtype: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    data = np.array(values if isinstance(values, np.ndarray) else list(values), dtype).reshape(shape)
    data.flags.writeable = False
    return data


def _as_doubles(data: npt.NDArray[Any]) -> npt.NDArray[Any]:
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one; `_bits_survive` tells
        return data.astype("<f8")


def _bits_survive(data: npt.NDArray[Any], wider: npt.NDArray[Any]) -> bool:
    """Tells whether `wider` cast back has the bits of `data`."""
    return wider.astype(data.dtype).tobytes() == data.tobytes()


# ---------------------------------------------------------------------------------------------------------- images


def _raw_image(message: Image | DepthImage, encoding: str) -> tuple[Parts, tuple[str, ...]]:
    data = message.data
    height, width = data.shape[:2]
    proto = RawImage(
        timestamp=_timestamp(message.stamp),
        frame_id=message.frame,
        width=width,
        height=height,
        encoding=encoding,
        step=width * (data.itemsize * (3 if data.ndim == 3 else 1)),
    )
    return _with_field(proto, "data", data), ()


def _encode_image(message: Image) -> tuple[Parts, tuple[str, ...]]:
    return _raw_image(message, "rgb8" if message.data.ndim == 3 else "mono8")


def _encode_depth(message: DepthImage) -> tuple[Parts, tuple[str, ...]]:
    return _raw_image(message, "32FC1")


def rows_of(proto: RawImage, dtype: str, channels: int) -> npt.NDArray[Any]:
    """The pixels (H, W) or (H, W, C) of a raw image, its row padding removed; raises `RecordingError`."""
    itemsize = np.dtype(dtype).itemsize
    used = proto.width * channels * itemsize
    step = proto.step or used
    if step < used or len(proto.data) < step * proto.height:
        raise RecordingError(
            f"RawImage of {proto.width}x{proto.height} {proto.encoding} needs rows of {used} bytes, "
            f"got step {proto.step} and {len(proto.data)} bytes"
        )
    shape = (proto.height, proto.width) if channels == 1 else (proto.height, proto.width, channels)
    data = np.frombuffer(proto.data, np.uint8)[: step * proto.height]
    if step != used:
        data = np.ascontiguousarray(data.reshape(proto.height, step)[:, :used]).reshape(-1)
    pixels = data.view(dtype).reshape(shape)
    pixels.flags.writeable = False
    return pixels


def _decode_image(proto: RawImage) -> Fields:
    channels = {"rgb8": 3, "mono8": 1, "8UC1": 1}.get(proto.encoding)
    if channels is None:
        raise RecordingError(f"RawImage encoding {proto.encoding!r} is no Image; those known are rgb8 and mono8")
    return {"frame": proto.frame_id, "data": rows_of(proto, "u1", channels)}


def _decode_depth(proto: RawImage) -> Fields:
    if proto.encoding != "32FC1":
        raise RecordingError(f"RawImage encoding {proto.encoding!r} is no DepthImage; the one known is 32FC1")
    return {"frame": proto.frame_id, "data": rows_of(proto, "<f4", 1)}


def _encode_compressed(message: CompressedImage) -> tuple[Parts, tuple[str, ...]]:
    proto = CompressedImageProto(timestamp=_timestamp(message.stamp), frame_id=message.frame, format=message.format)
    return _with_field(proto, "data", message.data), ()


def _decode_compressed(proto: CompressedImageProto) -> Fields:
    data = np.frombuffer(proto.data, np.uint8)
    return {"frame": proto.frame_id, "format": proto.format, "data": data}


# ---------------------------------------------------------------------------------------------------------- camera


def _encode_camera(message: CameraInfo) -> tuple[Parts, tuple[str, ...]]:
    rectification = np.eye(3) if message.R is None else message.R
    projection = np.hstack([message.K, np.zeros((3, 1))]) if message.P is None else message.P
    named = message.distortion_model != "none"
    proto = CameraCalibration(
        timestamp=_timestamp(message.stamp),
        frame_id=message.frame,
        width=min(message.width, UINT32_MAX),
        height=min(message.height, UINT32_MAX),
        distortion_model=message.distortion_model if named else "",
        D=[] if message.distortion is None else message.distortion.tolist(),
        K=message.K.ravel().tolist(),
        R=rectification.ravel().tolist(),
        P=projection.ravel().tolist(),
    )
    lacks = [name for name in ("R", "P") if getattr(message, name) is None]
    if message.distortion is not None and not message.distortion.size:
        lacks.append("distortion")
    if message.distortion_model == "":
        lacks.append("distortion_model")
    lacks += [name for name in ("width", "height") if getattr(message, name) != getattr(proto, name)]
    return [proto.SerializeToString()], tuple(lacks)


def _decode_camera(proto: CameraCalibration) -> Fields:
    return {
        "frame": proto.frame_id,
        "width": proto.width,
        "height": proto.height,
        "distortion_model": proto.distortion_model or "none",
        "distortion": _frozen(proto.D, "<f8", (-1,)) if proto.D else None,
        "K": _matrix(proto.K, "K", (3, 3)),
        "R": _matrix(proto.R, "R", (3, 3)) if proto.R else None,
        "P": _matrix(proto.P, "P", (3, 4)) if proto.P else None,
    }


def _matrix(values: Sequence[float], name: str, shape: tuple[int, int]) -> npt.NDArray[Any]:
    if len(values) != shape[0] * shape[1]:
        raise RecordingError(f"{name} must have {shape[0] * shape[1]} elements, got {len(values)}")
    return _frozen(values, "<f8", shape)


# ---------------------------------------------------------------------------------------------------------- clouds

_CLOUD_COLUMNS: tuple[tuple[str, tuple[str, ...], str, int], ...] = (
    ("points", ("x", "y", "z"), "<f4", NUMERIC.FLOAT32),
    ("normals", ("normal_x", "normal_y", "normal_z"), "<f4", NUMERIC.FLOAT32),
    ("intensities", ("intensity",), "<f4", NUMERIC.FLOAT32),
    ("time_offsets", ("time_offset",), "<f4", NUMERIC.FLOAT32),
    ("colors", ("red", "green", "blue"), "u1", NUMERIC.UINT8),
    ("rings", ("ring",), "<u2", NUMERIC.UINT16),
)
"""Field of `PointCloud`, its packed columns in the order written, their dtype."""
OPAQUE = 255


def _encode_cloud(message: PointCloud) -> tuple[Parts, tuple[str, ...]]:
    names: list[str] = []
    formats: list[Any] = []
    proto = PointCloudProto(
        timestamp=_timestamp(message.stamp), frame_id=message.frame, pose=_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    )
    offset = 0
    for field, columns, dtype, numeric in _CLOUD_COLUMNS:
        if getattr(message, field) is None:
            continue
        names.append(field)
        formats.append((dtype, (len(columns),)) if len(columns) > 1 else dtype)
        for column in columns:
            proto.fields.add(name=column, offset=offset, type=numeric)
            offset += np.dtype(dtype).itemsize
        if field == "colors":
            names.append("alpha")
            formats.append("u1")
            proto.fields.add(name="alpha", offset=offset, type=NUMERIC.UINT8)
            offset += 1
    proto.point_stride = offset
    if names == ["points"]:
        return _with_field(proto, "data", message.points), ()
    packed = np.empty(len(message.points), np.dtype({"names": names, "formats": formats}))
    for name in names:
        packed[name] = OPAQUE if name == "alpha" else getattr(message, name)
    return _with_field(proto, "data", packed.view(np.uint8)), ()


def _decode_cloud(proto: PointCloudProto) -> Fields:
    offsets = {f.name: (f.offset, int(f.type)) for f in proto.fields}
    stride = proto.point_stride
    if not stride or len(proto.data) % stride:
        raise RecordingError(f"PointCloud data of {len(proto.data)} bytes is no multiple of its stride {stride}")
    count = len(proto.data) // stride
    found: Fields = {"frame": proto.frame_id}
    for field, columns, dtype, _ in _CLOUD_COLUMNS:
        present = [offsets[c] for c in columns if c in offsets]
        if len(present) == len(columns):
            found[field] = _columns(proto.data, count, stride, present, dtype)
    if "points" not in found:
        raise RecordingError(f"PointCloud needs the fields x, y and z, got {', '.join(offsets) or 'none'}")
    return found


def _columns(data: bytes, count: int, stride: int, present: list[tuple[int, int]], dtype: str) -> npt.NDArray[Any]:
    """(N,) or (N, C) out of packed points."""
    target = np.dtype(dtype)
    for offset, numeric in present:
        source = _NUMERIC_DTYPES.get(numeric)
        if source is None or offset + source.itemsize > stride:
            raise RecordingError(f"PointCloud field at offset {offset} of type {numeric} does not fit stride {stride}")
    offset, numeric = present[0]
    if not count:
        return _frozen([], dtype, (0,) if len(present) == 1 else (0, len(present)))
    together = [(offset + i * target.itemsize, numeric) for i in range(len(present))] == present
    if together and _NUMERIC_DTYPES[numeric] == target:
        view: npt.NDArray[Any] = np.ndarray(
            (count, len(present)), target, data, offset, strides=(stride, target.itemsize)
        )
        result = np.ascontiguousarray(view) if stride != len(present) * target.itemsize else view
        if result is view and not view.flags.aligned:
            result = view.copy()
    else:
        result = np.empty((count, len(present)), target)
        for i, (at, kind) in enumerate(present):
            result[:, i] = np.ndarray((count,), _NUMERIC_DTYPES[kind], data, at, strides=(stride,))
    if len(present) == 1:
        result = result.reshape(count)
    result.flags.writeable = False
    return result


# ----------------------------------------------------------------------------------------------------------- poses


def _pose(position: Sequence[float], orientation: Sequence[float]) -> PoseProto:
    x, y, z = position
    qx, qy, qz, qw = orientation
    return PoseProto(position=Vector3(x=x, y=y, z=z), orientation=QuaternionProto(x=qx, y=qy, z=qz, w=qw))


def _position(proto: Any) -> list[float]:
    return [proto.x, proto.y, proto.z]


def _orientation(proto: Any) -> list[float]:
    return [proto.x, proto.y, proto.z, proto.w]


def _pose_in_frame(message: Pose | Odometry) -> bytes:
    proto = PoseInFrame(
        timestamp=_timestamp(message.stamp),
        frame_id=message.frame,
        pose=_pose(message.position.tolist(), message.orientation.tolist()),
    )
    return bytes(proto.SerializeToString())


def _encode_pose(message: Pose) -> tuple[Parts, tuple[str, ...]]:
    lacks = (("child_frame",) if message.child_frame else ()) + (() if message.covariance is None else ("covariance",))
    return [_pose_in_frame(message)], lacks


def _decode_pose(proto: PoseInFrame) -> Fields:
    return {
        "frame": proto.frame_id,
        "child_frame": "",
        "position": _frozen(_position(proto.pose.position), "<f8", (3,)),
        "orientation": _frozen(_orientation(proto.pose.orientation), "<f8", (4,)),
    }


_ODOMETRY_EXTRAS = ("pose_covariance", "linear", "angular", "twist_covariance")


def _encode_odometry(message: Odometry) -> tuple[Parts, tuple[str, ...]]:
    extras = tuple(name for name in _ODOMETRY_EXTRAS if getattr(message, name) is not None)
    return [_pose_in_frame(message)], ("child_frame", *extras)


def _encode_transforms(message: Transforms) -> tuple[Parts, tuple[str, ...]]:
    stamp = _timestamp(message.stamp)
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


def _decode_transforms(proto: FrameTransforms) -> Fields:
    rows = proto.transforms
    return {
        "frames": tuple(t.parent_frame_id for t in rows),
        "child_frames": tuple(t.child_frame_id for t in rows),
        "translations": _frozen([v for t in rows for v in _position(t.translation)], "<f8", (len(rows), 3)),
        "rotations": _frozen([v for t in rows for v in _orientation(t.rotation)], "<f8", (len(rows), 4)),
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


def _encode_path(message: Path) -> tuple[Parts, tuple[str, ...]]:
    head = PosesInFrame(timestamp=_timestamp(message.stamp), frame_id=message.frame).SerializeToString()
    poses = _wire_poses(message.positions, message.orientations)
    lacks = (("orientations",) if message.orientations is None else ()) + (
        () if message.stamps is None else ("stamps",)
    )
    return [head, poses.tobytes()], lacks


def _decode_path(proto: PosesInFrame) -> Fields:
    count = len(proto.poses)
    return {
        "frame": proto.frame_id,
        "positions": _frozen([v for p in proto.poses for v in _position(p.position)], "<f8", (count, 3)),
        "orientations": _frozen([v for p in proto.poses for v in _orientation(p.orientation)], "<f8", (count, 4)),
    }


# --------------------------------------------------------------------------------------------------- scans and fixes


_SCAN_EXTRAS = ("range_min", "range_max", "time_offsets", "ranges", "intensities")


def _encode_scan(message: LaserScan) -> tuple[Parts, tuple[str, ...]]:
    proto = LaserScanProto(
        timestamp=_timestamp(message.stamp),
        frame_id=message.frame,
        pose=_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        start_angle=message.angle_min,
        end_angle=message.angle_max,
    )
    lacks = [] if message.range_min == 0.0 and np.copysign(1.0, message.range_min) > 0 else ["range_min"]
    if message.range_max != np.inf:
        lacks.append("range_max")
    if message.time_offsets is not None:
        lacks.append("time_offsets")
    ranges = _as_doubles(message.ranges)
    if not _bits_survive(message.ranges, ranges):
        lacks.append("ranges")
    parts = _with_field(proto, "ranges", ranges)
    if message.intensities is not None:
        intensities = _as_doubles(message.intensities)
        if not intensities.size or not _bits_survive(message.intensities, intensities):
            lacks.append("intensities")
        parts += _with_field(LaserScanProto(), "intensities", intensities)
    return parts, tuple(lacks)


def _decode_scan(proto: LaserScanProto) -> Fields:
    return {
        "frame": proto.frame_id,
        "angle_min": proto.start_angle,
        "angle_max": proto.end_angle,
        "range_min": 0.0,
        "range_max": float("inf"),
        "ranges": _frozen(np.fromiter(proto.ranges, "<f8", len(proto.ranges)), "<f4", (-1,)),
        "intensities": _frozen(np.fromiter(proto.intensities, "<f8", len(proto.intensities)), "<f4", (-1,))
        if proto.intensities
        else None,
    }


def _encode_fix(message: NavSatFix) -> tuple[Parts, tuple[str, ...]]:
    proto = LocationFix(
        timestamp=_timestamp(message.stamp),
        frame_id=message.frame,
        latitude=message.latitude,
        longitude=message.longitude,
        altitude=message.altitude,
        position_covariance=[] if message.covariance is None else message.covariance.ravel().tolist(),
        position_covariance_type=COVARIANCE_TYPES.index(message.covariance_type),  # type: ignore[arg-type]
    )
    lacks = (("status",) if message.status != "fix" else ()) + (() if message.satellites is None else ("satellites",))
    return [proto.SerializeToString()], lacks


def _decode_fix(proto: LocationFix) -> Fields:
    if not 0 <= proto.position_covariance_type < len(COVARIANCE_TYPES):
        raise RecordingError(f"LocationFix has the unknown covariance type {proto.position_covariance_type}")
    return {
        "frame": proto.frame_id,
        "status": "fix",
        "latitude": proto.latitude,
        "longitude": proto.longitude,
        "altitude": proto.altitude,
        "covariance_type": COVARIANCE_TYPES[proto.position_covariance_type],
        "covariance": _matrix(proto.position_covariance, "position_covariance", (3, 3))
        if proto.position_covariance
        else None,
    }


def _encode_alarm(message: Alarm) -> tuple[Parts, tuple[str, ...]]:
    level = LOG_LEVELS.index(message.level, 1)
    stamp = _timestamp(message.stamp)
    proto = Log(timestamp=stamp, level=level, message=message.text, name=message.name)  # type: ignore[arg-type]
    return [proto.SerializeToString()], ()


def _decode_alarm(proto: Log) -> Fields:
    if not 0 <= proto.level < len(LOG_LEVELS):
        raise RecordingError(f"Log has the unknown level {proto.level}")
    return {"level": LOG_LEVELS[proto.level], "name": proto.name, "text": proto.message}


FOXGLOVE_SCHEMAS: dict[type[Message], FoxgloveSchema] = {
    schema.message: schema
    for schema in (
        FoxgloveSchema(Image, RawImage, _encode_image, _decode_image),
        FoxgloveSchema(DepthImage, RawImage, _encode_depth, _decode_depth),
        FoxgloveSchema(CompressedImage, CompressedImageProto, _encode_compressed, _decode_compressed),
        FoxgloveSchema(
            CameraInfo,
            CameraCalibration,
            _encode_camera,
            _decode_camera,
            ("width", "height", "distortion_model", "distortion", "R", "P"),
        ),
        FoxgloveSchema(PointCloud, PointCloudProto, _encode_cloud, _decode_cloud),
        FoxgloveSchema(Pose, PoseInFrame, _encode_pose, _decode_pose, ("child_frame", "covariance")),
        FoxgloveSchema(Odometry, PoseInFrame, _encode_odometry, _decode_pose, ("child_frame", *_ODOMETRY_EXTRAS)),
        FoxgloveSchema(Transforms, FrameTransforms, _encode_transforms, _decode_transforms),
        FoxgloveSchema(Path, PosesInFrame, _encode_path, _decode_path, ("orientations", "stamps")),
        FoxgloveSchema(LaserScan, LaserScanProto, _encode_scan, _decode_scan, _SCAN_EXTRAS),
        FoxgloveSchema(NavSatFix, LocationFix, _encode_fix, _decode_fix, ("status", "satellites")),
        FoxgloveSchema(Alarm, Log, _encode_alarm, _decode_alarm),
    )
}
"""How the well-known types are written. Every other type is JSON."""
