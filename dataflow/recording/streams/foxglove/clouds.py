"""Point clouds as Foxglove protobufs."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as PointCloudProto

from dataflow.messages import PointCloud
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.foxglove.values import (
    Fields,
    Parts,
    frozen,
    placed_by,
    pose_of,
    timestamp_of,
    with_field,
)

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


_CLOUD_COLUMNS: tuple[tuple[str, tuple[str, ...], str, int], ...] = (
    ("points", ("x", "y", "z"), "<f4", NUMERIC.FLOAT32),
    ("normals", ("normal_x", "normal_y", "normal_z"), "<f4", NUMERIC.FLOAT32),
    ("intensities", ("intensity",), "<f4", NUMERIC.FLOAT32),
    ("time_offsets", ("time_offset",), "<f4", NUMERIC.FLOAT32),
    ("colors", ("red", "green", "blue"), "u1", NUMERIC.UINT8),
    ("rings", ("ring",), "<u2", NUMERIC.UINT16),
)
"""Field of `PointCloud`, its packed columns in the order written, their dtype."""
CLOUD_FIELDS = {column for _, columns, _, _ in _CLOUD_COLUMNS for column in columns} | {"alpha"}
"""Names of packed columns that are read."""
OPAQUE = 255
CLOUD_EXTRAS = ("precise", "columns")


def encode_cloud(message: PointCloud) -> tuple[Parts, tuple[str, ...]]:
    names: list[str] = []
    formats: list[Any] = []
    proto = PointCloudProto(
        timestamp=timestamp_of(message.stamp),
        frame_id=message.frame,
        pose=pose_of((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
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
    lacks = tuple(name for name in CLOUD_EXTRAS if getattr(message, name) is not None)
    if names == ["points"]:
        return with_field(proto, "data", message.points), lacks
    packed = np.empty(len(message.points), np.dtype({"names": names, "formats": formats}))
    for name in names:
        packed[name] = OPAQUE if name == "alpha" else getattr(message, name)
    return with_field(proto, "data", packed.view(np.uint8)), lacks


def decode_cloud(proto: PointCloudProto) -> Fields:
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
    wide = [offsets[axis] for axis in "xyz"]
    if any(kind == NUMERIC.FLOAT64 for _, kind in wide):
        exact = _columns(proto.data, count, stride, wide, "<f8")
        if not np.array_equal(exact, found["points"], equal_nan=True):
            found["precise"] = exact
    place = placed_by(proto.pose)
    if place is not None:
        for field, shift, dtype in (
            ("points", place[:3, 3], "<f4"),
            ("precise", place[:3, 3], "<f8"),
            ("normals", np.zeros(3), "<f4"),
        ):
            if field in found:
                moved = found[field].astype(np.float64) @ place[:3, :3].T + shift
                found[field] = frozen(moved, dtype, moved.shape)
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
        return frozen([], dtype, (0,) if len(present) == 1 else (0, len(present)))
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
