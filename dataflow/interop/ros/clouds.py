"""Point clouds of ROS, whose points have whatever fields their driver gives them, as messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.interop.access_tracking import lose
from dataflow.messages import PointCloud
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.pixels import rows_without_padding

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Of sensor_msgs/PointField."""
_INTENSITY = ("intensity", "intensities", "reflectivity", "i")
_RING = ("ring", "channel", "line", "laser_id")
_TIMES = ("time", "t", "timestamp", "time_offset", "offset_time", "time_stamp")
_COLOR = ("rgb", "rgba")
TYPICAL_PERIOD = 0.1
"""Seconds from cloud to cloud where the recording does not show it."""


def point_cloud(message: Any, stamp: int, period: float = TYPICAL_PERIOD) -> PointCloud:
    """sensor_msgs/PointCloud2, organised ones row by row. `period`: seconds from cloud to cloud.

    Carried are x, y, z, with all their bits; intensity or reflectivity; ring, channel or line; rgb; normal_x, normal_y,
    normal_z; and the time of each point, whatever unit its driver gives it in (`point_times`). Other fields are lost.
    """
    points = _points(message)
    for name in left_out(message):
        lose(message, f"the field {name} of the points")
    names = points.dtype.names or ()
    if (rgb := _found(names, _COLOR)) is not None and points[rgb].dtype.itemsize != 4:
        lose(message, f"the field {rgb} of the points, which is no packed colour")
    if not set("xyz") <= set(names):
        raise RecordingError(f"a cloud without x, y and z; its fields are {', '.join(names) or 'none'}")
    if many := [axis for axis in "xyz" if points[axis].ndim > 1]:
        raise RecordingError(
            f"a cloud whose field {many[0]} has {points[many[0]].shape[1]} values a point, 1 is wanted"
        )
    if whole := [axis for axis in "xyz" if points[axis].dtype.kind in "iu"]:
        lose(message, f"the unit of {', '.join(whole)}, whole numbers, which are read as metres")
    times = _found(names, _TIMES)
    offsets, odd = None, ""
    if times is not None and points[times].ndim == 1:
        measured = int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
        offsets, odd = point_times(points[times], measured, period)
    if odd:
        lose(message, f"the field {times} of the points: {odd}")
    exact = np.column_stack([points[axis].astype(np.float64) for axis in "xyz"]).reshape(-1, 3)
    with np.errstate(over="ignore"):
        rounded = exact.astype(np.float32)
    return PointCloud(
        stamp=stamp,
        frame=message.header.frame_id,
        points=rounded,
        precise=None if np.array_equal(rounded, exact, equal_nan=True) else exact,
        columns=int(message.width) if message.height > 1 and message.width else None,
        colors=_colors(points),
        intensities=_kept(message, points, _INTENSITY, "<f4"),
        rings=_kept(message, points, _RING, "<u2"),
        time_offsets=offsets,
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
    for number, f in enumerate(message.fields):
        if f.datatype not in _TYPES:
            raise RecordingError(f"a cloud whose field {f.name!r} has the unknown type {f.datatype}")
        kind = order + _TYPES[f.datatype]
        names.append(f.name if f.name and f.name not in names else f"{f.name} ({number})")  # padding shares a name
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
    step = max(used, int(message.row_step)) if message.height > 1 else used
    data = np.asarray(message.data, np.uint8)
    wanted = step * message.height
    if len(data) < wanted - (step - used):
        raise RecordingError(
            f"a cloud of {message.width}x{message.height} points needs {wanted} bytes, got {len(data)}"
        )
    if len(data) > wanted:
        lose(message, f"{len(data) - wanted:,} bytes behind the last of {message.width}x{message.height} points")
    return rows_without_padding(data, message.height, step, used).view(dtype)


def _found(names: Any, wanted: tuple[str, ...]) -> str | None:
    return next((name for name in wanted if name in names), None)


def _kept(message: Any, points: npt.NDArray[Any], names: tuple[str, ...], dtype: str) -> npt.NDArray[Any] | None:
    """A field as the type that it has here; None for one that has several values a point."""
    name = _found(points.dtype.names, names)
    if name is None:
        return None
    values = points[name]
    if values.ndim > 1:
        lose(message, f"the field {name} of the points, which has {values.shape[1]} values")
        return None
    with np.errstate(invalid="ignore", over="ignore"):
        kept = values.astype(dtype)
        same = np.array_equal(kept.astype(values.dtype), values, equal_nan=values.dtype.kind == "f")
    if not same:
        lose(message, f"digits of the field {name} beyond {dtype[1:]}")
    return kept


def _colors(points: npt.NDArray[Any]) -> npt.NDArray[np.uint8] | None:
    name = _found(points.dtype.names, _COLOR)
    if name is None or points[name].dtype.itemsize != 4:
        return None
    packed = np.ascontiguousarray(points[name].astype(points[name].dtype.newbyteorder("<"))).view("<u4")
    return np.column_stack([(packed >> shift) & 0xFF for shift in (16, 8, 0)]).astype(np.uint8)


_UNITS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
_EPOCH = {"ns": 1e17, "µs": 1e14, "ms": 1e11, "s": 1e8}
"""Values beyond are since the epoch, in that unit: 1973 and later."""
LONGEST = 60.0
"""Seconds that the points of one cloud may lie from its stamp."""
SHORTEST = 0.03
"""Of the time from cloud to cloud, the least that a sweep takes."""


def point_times(
    values: npt.NDArray[Any], stamp: int, period: float = TYPICAL_PERIOD
) -> tuple[npt.NDArray[np.float32] | None, str]:
    """Returns when points were measured, seconds since the stamp (ns) of their cloud, and what is odd about it.

    Drivers give seconds, or whole nanoseconds, since the stamp or the epoch; some microseconds or milliseconds. The
    unit is the usual one of the type of number unless the points of a cloud then take longer than it is until the next
    (`period`, s), or hardly any time of it. None where no unit makes sense.
    """
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if not finite.size:
        return np.zeros(0, np.float32) if not values.size else None, "" if not values.size else "no number"
    whole = values.dtype.kind in "iu"
    low, high = float(finite.min()), float(finite.max())
    since = next((unit for unit, least in _EPOCH.items() if low > least and not (whole and unit == "s")), None)
    if since is not None:
        if not whole and (step := float(np.spacing(finite.max())) * _UNITS[since]) > SHORTEST * period:
            return None, f"{8 * values.dtype.itemsize} bits hold times of the epoch in steps of {step:g} s"
        offsets = _since_epoch(values, since, stamp)
        if np.nanmax(np.abs(offsets)) <= LONGEST:
            return offsets.astype(np.float32), ""
        odd = "it is of another clock than the stamps; counted from the first point"
        return (offsets - np.nanmin(offsets)).astype(np.float32), odd
    unit = _likeliest(high - low, max(abs(low), abs(high)), whole, period)
    if unit is None:
        return None, f"values from {low:g} to {high:g} make no sense in any unit"
    return (values.astype(np.float64) * _UNITS[unit]).astype(np.float32), ""


def _since_epoch(values: npt.NDArray[Any], unit: str, stamp: int) -> npt.NDArray[np.float64]:
    """Seconds since the stamp. Seconds, milliseconds and microseconds are split so that no digit is lost."""
    if values.dtype.kind in "iu" and unit == "ns":
        return np.asarray((values.astype(np.int64) - stamp) * 1e-9, np.float64)
    each = round(1e9 * _UNITS[unit])
    base = stamp // each
    offsets: npt.NDArray[np.float64] = (values.astype(np.float64) - base) - (stamp - base * each) / each
    return offsets * np.float64(_UNITS[unit])


def _likeliest(span: float, farthest: float, whole: bool, period: float) -> str | None:
    """The unit of times since the stamp."""
    possible = [u for u, s in _UNITS.items() if span * s <= 1.5 * max(period, 1e-3) and farthest * s <= LONGEST]
    usual = "ns" if whole else "s"
    if whole:
        possible = [u for u in possible if u != "s"]
        if usual in possible and span * _UNITS[usual] < 0.01 * period and span:
            return possible[0]
    elif span:  # shares of a sweep, from 0 to 1, are no milliseconds
        possible = [u for u in possible if u == usual or span * _UNITS[u] > SHORTEST * period]
    return usual if usual in possible else possible[0] if possible else None
