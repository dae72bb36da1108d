"""Inertial sensors, scans, satellite receivers, joints, maps and single values of ROS as messages."""

from __future__ import annotations

from typing import Any

import numpy as np

import dataflow.messages as messages
from dataflow.interop.access_tracking import lose
from dataflow.interop.ros.values import covariance, optional, orientation, variance, vector
from dataflow.messages.poses import COVARIANCE_TYPES
from dataflow.messages.values import ALARM_LEVELS
from dataflow.recording.errors import RecordingError

_FIX = {-1: "no_fix", 0: "fix", 1: "sbas", 2: "gbas"}
_LEVELS = {n: name for k, name in enumerate(ALARM_LEVELS) for n in (1 << k, 10 * (k + 1))}
"""Of rosgraph_msgs/Log, which are powers of two, and of rcl_interfaces/Log, from 10 to 50."""
_ABSENT = -1.0
_SLACK, _ROUNDED = 2.5, 1e-3
"""Increments, and radians, within which the last angle of a scan follows from its increment."""


def imu(message: Any, stamp: int) -> messages.Imu:
    """sensor_msgs/Imu; without an orientation where its covariance begins with -1 (REP 145), or it is all zeros or
    no number."""
    turned = message.orientation
    values = np.array([turned.x, turned.y, turned.z, turned.w])
    known = message.orientation_covariance[0] != _ABSENT and bool(values.any() and np.isfinite(values).all())
    if not known and message.orientation_covariance[0] != _ABSENT and values.any():
        lose(message, "an orientation of NaN")
    return messages.Imu(
        stamp=stamp,
        frame=message.header.frame_id,
        angular_velocity=vector(message.angular_velocity),
        linear_acceleration=vector(message.linear_acceleration),
        orientation=orientation(turned) if known else None,
        angular_velocity_covariance=covariance(message, "angular_velocity_covariance", 3),
        linear_acceleration_covariance=covariance(message, "linear_acceleration_covariance", 3),
        orientation_covariance=covariance(message, "orientation_covariance", 3) if known else None,
    )


def laser_scan(message: Any, stamp: int) -> messages.LaserScan:
    """sensor_msgs/LaserScan; the last beam's angle follows from the increment, as does the duration of a scan where
    beams have times."""
    count = len(message.ranges)
    intensities = optional(message.intensities, "<f4")
    if intensities is not None and len(intensities) != count:
        lose(message, f"intensities, {len(intensities):,} for {count:,} ranges")
        intensities = None
    step, turn = float(message.time_increment), float(message.angle_increment)
    last = float(message.angle_min) + turn * max(count - 1, 0)
    if abs(last - float(message.angle_max)) > max(_SLACK * abs(turn), _ROUNDED):  # some count a beam more, or less
        lose(
            message, f"angle_max of {message.angle_max:.4g}, where {count:,} beams by their increment end at {last:.4g}"
        )
    return messages.LaserScan(
        stamp=stamp,
        frame=message.header.frame_id,
        angle_min=float(message.angle_min),
        angle_max=last,
        range_min=float(message.range_min),
        range_max=float(message.range_max),
        ranges=np.asarray(message.ranges, np.float32),
        intensities=intensities,
        time_offsets=(np.arange(count) * step).astype(np.float32) if step else None,
    )


def nav_sat_fix(message: Any, stamp: int) -> messages.NavSatFix:
    """sensor_msgs/NavSatFix; no fix where it has no position."""
    kind = int(message.position_covariance_type)
    placed = bool(np.isfinite([message.latitude, message.longitude]).all())
    if placed and abs(message.latitude) > 90 >= abs(message.longitude):
        raise RecordingError(
            f"a latitude of {message.latitude:g} and a longitude of {message.longitude:g} degrees: are they swapped?"
        )
    longitude = float(message.longitude)
    if 180 < longitude <= 360:
        longitude -= 360
        lose(message, "a longitude of 180 to 360 degrees (it is -180 to 0 here)")
    if not placed and int(message.status.status) >= 0:
        lose(message, "a status of a fix without a position")
    errors = covariance(message, "position_covariance", 3) if kind else None
    return messages.NavSatFix(
        stamp=stamp,
        frame=message.header.frame_id,
        status=_FIX.get(int(message.status.status), "no_fix") if placed else "no_fix",
        latitude=float(message.latitude),
        longitude=longitude,
        altitude=float(message.altitude),
        covariance_type=COVARIANCE_TYPES[kind] if errors is not None and kind < len(COVARIANCE_TYPES) else "unknown",
        covariance=errors,
    )


def joint_state(message: Any, stamp: int) -> messages.JointState:
    """sensor_msgs/JointState. Joints without names are numbered; values of another number than the joints are not
    known."""
    values = {name: optional(getattr(message, name), "<f8") for name in ("position", "velocity", "effort")}
    names = tuple(message.name)
    if not names:
        names = tuple(map(str, range(max((len(v) for v in values.values() if v is not None), default=0))))
    for name, found in values.items():
        if found is not None and len(found) != len(names):
            lose(message, f"{name}, of {len(found)} joints where {len(names)} are named")
            values[name] = None
    return messages.JointState(
        stamp=stamp, names=names, positions=values["position"], velocities=values["velocity"], efforts=values["effort"]
    )


def occupancy_grid(message: Any, stamp: int) -> messages.OccupancyGrid:
    """nav_msgs/OccupancyGrid; cells that are no probability are unknown."""
    info, cells = message.info, np.array(message.data, np.int8)
    if len(cells) != info.height * info.width:
        raise RecordingError(
            f"a grid of {info.width}x{info.height} cells needs {info.height * info.width:,}, got {len(cells):,}"
        )
    odd = (cells < -1) | (cells > 100)
    if odd.any():
        lose(message, f"cells that are neither -1 nor 0 to 100, such as {cells[odd][0]}: they are unknown here")
        cells[odd] = -1
    return messages.OccupancyGrid(
        stamp=stamp,
        frame=message.header.frame_id,
        resolution=float(info.resolution),
        cells=cells.reshape(info.height, info.width),
        position=vector(info.origin.position),
        orientation=orientation(info.origin.orientation),
    )


def diagnostics(message: Any, stamp: int) -> messages.Diagnostics:
    """diagnostic_msgs/DiagnosticArray."""
    pairs = [(i, pair) for i, status in enumerate(message.status) for pair in status.values]
    return messages.Diagnostics(
        stamp=stamp,
        names=tuple(status.name for status in message.status),
        messages=tuple(status.message for status in message.status),
        hardware_ids=tuple(status.hardware_id for status in message.status),
        keys=tuple(pair.key for _, pair in pairs),
        values=tuple(pair.value for _, pair in pairs),
        levels=np.array([int(status.level) for status in message.status], np.uint8),
        owners=np.array([i for i, _ in pairs], np.int32) if pairs else None,
    )


def log(message: Any, stamp: int) -> messages.Alarm:
    """rosgraph_msgs/Log and rcl_interfaces/Log."""
    level = int(message.level)
    return messages.Alarm(stamp=stamp, level=_LEVELS.get(level, "info"), name=message.name, text=message.msg)


def number(message: Any, stamp: int, unit: str = "") -> messages.Number:
    """std_msgs numbers."""
    value = float(message.data)
    if isinstance(message.data, int) and int(value) != message.data:
        lose(message, "digits beyond 53 bits")
    return messages.Number(stamp=stamp, value=value, unit=unit)


UNITS = {"temperature": "°C", "fluid_pressure": "Pa", "illuminance": "lx", "relative_humidity": ""}
"""By the field that holds the value."""


def measurement(message: Any, stamp: int) -> messages.Measurement:
    """sensor_msgs/Temperature, FluidPressure, Illuminance and RelativeHumidity."""
    name = next(name for name in UNITS if hasattr(message, name))
    return messages.Measurement(
        stamp=stamp,
        frame=message.header.frame_id,
        value=float(getattr(message, name)),
        unit=UNITS[name],
        variance=variance(message),
    )


def range_reading(message: Any, stamp: int) -> messages.RangeReading:
    """sensor_msgs/Range, with the variance that it has since Jazzy."""
    return messages.RangeReading(
        stamp=stamp,
        frame=message.header.frame_id,
        range=float(message.range),
        range_min=float(message.min_range),
        range_max=float(message.max_range),
        field_of_view=float(message.field_of_view),
        radiation="infrared" if int(message.radiation_type) == 1 else "ultrasound",
        variance=variance(message),
    )
