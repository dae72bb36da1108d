"""Laser scans, satellite fixes and alarms as Foxglove protobufs."""

from __future__ import annotations

import numpy as np
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan as LaserScanProto
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log

from dataflow.messages import Alarm, LaserScan, NavSatFix
from dataflow.recording.errors import RecordingError
from dataflow.recording.foxglove.values import (
    Fields,
    Parts,
    as_doubles,
    bits_survive,
    frozen,
    matrix,
    placed_by,
    pose_of,
    timestamp_of,
    with_field,
)

LOG_LEVELS = ("info", "debug", "info", "warning", "error", "fatal")
"""In the order of `Log.Level`; an unknown one is read as info."""
COVARIANCE_TYPES = ("unknown", "approximated", "diagonal_known", "known")
"""In the order of `LocationFix.PositionCovarianceType`."""


SCAN_EXTRAS = ("range_min", "range_max", "time_offsets", "ranges", "intensities")


def encode_scan(message: LaserScan) -> tuple[Parts, tuple[str, ...]]:
    proto = LaserScanProto(
        timestamp=timestamp_of(message.stamp),
        frame_id=message.frame,
        pose=pose_of((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        start_angle=message.angle_min,
        end_angle=message.angle_max,
    )
    lacks = [] if message.range_min == 0.0 and np.copysign(1.0, message.range_min) > 0 else ["range_min"]
    if message.range_max != np.inf:
        lacks.append("range_max")
    if message.time_offsets is not None:
        lacks.append("time_offsets")
    ranges = as_doubles(message.ranges)
    if not bits_survive(message.ranges, ranges):
        lacks.append("ranges")
    parts = with_field(proto, "ranges", ranges)
    if message.intensities is not None:
        intensities = as_doubles(message.intensities)
        if not intensities.size or not bits_survive(message.intensities, intensities):
            lacks.append("intensities")
        parts += with_field(LaserScanProto(), "intensities", intensities)
    return parts, tuple(lacks)


def decode_scan(proto: LaserScanProto) -> Fields:
    turn = 0.0
    place = placed_by(proto.pose)
    if place is not None:
        turn = float(np.arctan2(place[1, 0], place[0, 0]))
        if place[:3, 3].any() or abs(place[2, 2] - 1) > 1e-9:
            raise RecordingError(
                f"its pose in {proto.frame_id!r} is more than a turn about z, and a LaserScan has no place for it: "
                "give the scanner a frame, and say by a transform where it is"
            )
    return {
        "frame": proto.frame_id,
        "angle_min": proto.start_angle + turn,
        "angle_max": proto.end_angle + turn,
        "range_min": 0.0,
        "range_max": float("inf"),
        "ranges": frozen(np.fromiter(proto.ranges, "<f8", len(proto.ranges)), "<f4", (-1,)),
        "intensities": frozen(np.fromiter(proto.intensities, "<f8", len(proto.intensities)), "<f4", (-1,))
        if proto.intensities
        else None,
    }


def encode_fix(message: NavSatFix) -> tuple[Parts, tuple[str, ...]]:
    proto = LocationFix(
        timestamp=timestamp_of(message.stamp),
        frame_id=message.frame,
        latitude=message.latitude,
        longitude=message.longitude,
        altitude=message.altitude,
        position_covariance=[] if message.covariance is None else message.covariance.ravel().tolist(),
        position_covariance_type=COVARIANCE_TYPES.index(message.covariance_type),  # type: ignore[arg-type]
    )
    lacks = (("status",) if message.status != "fix" else ()) + (() if message.satellites is None else ("satellites",))
    return [proto.SerializeToString()], lacks


def decode_fix(proto: LocationFix) -> Fields:
    if not 0 <= proto.position_covariance_type < len(COVARIANCE_TYPES):
        raise RecordingError(f"LocationFix has the unknown covariance type {proto.position_covariance_type}")
    return {
        "frame": proto.frame_id,
        "status": "fix",
        "latitude": proto.latitude,
        "longitude": proto.longitude,
        "altitude": proto.altitude,
        "covariance_type": COVARIANCE_TYPES[proto.position_covariance_type],
        "covariance": matrix(proto.position_covariance, "position_covariance", (3, 3))
        if proto.position_covariance
        else None,
    }


def encode_alarm(message: Alarm) -> tuple[Parts, tuple[str, ...]]:
    level = LOG_LEVELS.index(message.level, 1)
    stamp = timestamp_of(message.stamp)
    proto = Log(timestamp=stamp, level=level, message=message.text, name=message.name)  # type: ignore[arg-type]
    return [proto.SerializeToString()], ()


def decode_alarm(proto: Log) -> Fields:
    if not 0 <= proto.level < len(LOG_LEVELS):
        raise RecordingError(f"Log has the unknown level {proto.level}")
    return {"level": LOG_LEVELS[proto.level], "name": proto.name, "text": proto.message}
