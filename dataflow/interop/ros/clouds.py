"""Point clouds of ROS, whose points have whatever fields their driver gives them, as messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.messages import PointCloud
from dataflow.recording.errors import RecordingError

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Of sensor_msgs/PointField."""
_INTENSITY = ("intensity", "intensities", "reflectivity", "i")
_RING = ("ring", "channel", "line", "laser_id")
_TIMES = ("time", "t", "timestamp", "time_offset", "offset_time", "time_stamp")
_COLOR = ("rgb", "rgba")
_ABSOLUTE = 1e8
"""Times of points beyond this many seconds are since the epoch, not since the stamp."""


def point_cloud(message: Any, stamp: int) -> PointCloud:
    """sensor_msgs/PointCloud2, organised ones row by row.

    Of the fields x, y, z; intensity or reflectivity; ring, channel or line; rgb or rgba; normal_x, normal_y, normal_z;
    and the time of each point as drivers give it (float seconds, or integer nanoseconds, since the stamp or the epoch)
    are carried. `carried` tells which of a cloud's fields are not.
    """
    points = _points(message)
    if points.dtype.names is None or not {"x", "y", "z"} <= set(points.dtype.names):
        raise RecordingError(
            f"a cloud without x, y and z; its fields are {', '.join(points.dtype.names or ()) or 'none'}"
        )
    names = points.dtype.names
    return PointCloud(
        stamp=stamp,
        frame=message.header.frame_id,
        points=np.column_stack([points[axis].astype(np.float32) for axis in "xyz"]).reshape(-1, 3),
        colors=_colors(points),
        intensities=_one(points, _INTENSITY, "<f4"),
        rings=_one(points, _RING, "<u2"),
        time_offsets=_time_offsets(points, int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)),
        normals=np.column_stack([points[f"normal_{axis}"].astype(np.float32) for axis in "xyz"])
        if {"normal_x", "normal_y", "normal_z"} <= set(names)
        else None,
    )


def left_out(message: Any) -> tuple[str, ...]:
    """Names of the fields of a cloud that `PointCloud` has no place for."""
    names = [f.name for f in message.fields]
    known = {"x", "y", "z", "normal_x", "normal_y", "normal_z"}
    for group in (_INTENSITY, _RING, _TIMES, _COLOR):
        known |= {name for name in group if name in names and name == _found(names, group)}
    return tuple(name for name in names if name not in known)


def _points(message: Any) -> npt.NDArray[Any]:
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for f in message.fields:
        if f.datatype not in _TYPES:
            raise RecordingError(f"a cloud whose field {f.name!r} has the unknown type {f.datatype}")
        kind = order + _TYPES[f.datatype]
        names.append(f.name)
        formats.append(kind if f.count <= 1 else (kind, (f.count,)))
        offsets.append(f.offset)
    layout: Mapping[str, Any] = {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    try:
        dtype = np.dtype(layout)  # type: ignore[call-overload]
    except ValueError as error:
        raise RecordingError(
            f"a cloud whose fields do not fit its points of {message.point_step} bytes: {error}"
        ) from None
    if not dtype.itemsize:
        raise RecordingError(f"a cloud whose points have {len(names)} fields and no bytes")
    used = message.width * message.point_step
    data = np.asarray(message.data, np.uint8)
    if message.height > 1 and message.row_step > used:
        data = np.ascontiguousarray(data[: message.height * message.row_step].reshape(message.height, -1)[:, :used])
    data = data.reshape(-1)
    wanted = used * message.height
    if len(data) < wanted:
        raise RecordingError(
            f"a cloud of {message.width}x{message.height} points needs {wanted} bytes, got {len(data)}"
        )
    return data[:wanted].view(dtype)


def _found(names: Any, wanted: tuple[str, ...]) -> str | None:
    return next((name for name in wanted if name in names), None)


def _one(points: npt.NDArray[Any], names: tuple[str, ...], dtype: str) -> npt.NDArray[Any] | None:
    name = _found(points.dtype.names, names)
    return None if name is None or points[name].ndim > 1 else points[name].astype(dtype)


def _colors(points: npt.NDArray[Any]) -> npt.NDArray[np.uint8] | None:
    name = _found(points.dtype.names, _COLOR)
    if name is None or points[name].dtype.itemsize != 4:
        return None
    packed = np.ascontiguousarray(points[name].astype(points[name].dtype.newbyteorder("<"))).view("<u4")
    return np.column_stack([(packed >> shift) & 0xFF for shift in (16, 8, 0)]).astype(np.uint8)


def _time_offsets(points: npt.NDArray[Any], stamp: int) -> npt.NDArray[np.float32] | None:
    name = _found(points.dtype.names, _TIMES)
    if name is None or points[name].ndim > 1:
        return None
    values = points[name]
    if values.dtype.kind in "iu":  # nanoseconds, as Ouster and Livox give them
        ns = values.astype(np.int64)
        return ((ns - stamp if ns.size and ns.max() > _ABSOLUTE * 1e9 else ns) * 1e-9).astype(np.float32)
    seconds = values.astype(np.float64)
    if not seconds.size or np.nanmax(np.abs(seconds)) < _ABSOLUTE:
        return seconds.astype(np.float32)
    whole = stamp // 10**9
    return ((seconds - whole) - (stamp - whole * 10**9) * 1e-9).astype(np.float32)
