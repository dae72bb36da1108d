"""The packets of inertial and satellite navigation (`oxts`) of a drive of KITTI raw, one a frame.

Geiger et al., "Vision meets robotics: the KITTI dataset", 2013; its `dataformat.txt` names the 30 numbers of a packet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.interop.export.frames import nearest, write_text
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.messages import Imu, Message, NavSatFix, Odometry
from dataflow.messages.geometry import quaternion_to_matrix, roll_pitch_yaw

UNKNOWN = -1
"""Of the status numbers that no message here holds."""
MODES = {"no_fix": 0, "fix": 3, "gbas": 4, "rtk_float": 5, "rtk_fixed": 6, "sbas": 7}
"""Position mode of the primary receiver by the kind of fix."""
OXTS = "oxts"
KINDS: tuple[type[Message], ...] = (Imu, NavSatFix, Odometry)
"""The messages that a packet is made of."""


def write_oxts(source: ExportSource, stamps: Sequence[int], drive: Path, times: Any, done: Exported) -> str | None:
    """Writes a packet for each of the frames' stamps, and returns the frame of the inertial unit; None without packets.

    A packet takes the reading (Imu with an orientation), the position (NavSatFix) and the velocity (Odometry in the
    unit's frame) nearest to its frame, within 20 ms. Where one of the three is missing, nothing is written, and
    `done.left_out` names it; a recording without readings and positions is not expected to have packets.
    `times`: writes stamps as KITTI does.
    """
    if not source.of_type(Imu) and not source.of_type(NavSatFix):
        return None
    found: list[list[Any]] = []
    for kind in KINDS:
        names = source.of_type(kind)
        if len(names) != 1:
            given = ", ".join(source.names[n] for n in names)
            what = f"several streams of {kind.__name__} ({given}); choose with --stream" if names else (
                f"no stream of {kind.__name__}"
            )  # fmt: skip
            done.left_out[OXTS] = f"it takes readings, positions and velocities, and there is {what}"
            return None
        found.append([recorded.message for recorded in source.messages(names)])
    rows: list[list[float]] = []
    taken: list[int] = []
    for number, stamp in enumerate(stamps):
        near = [nearest(messages, stamp) for messages in found]
        lacking = [kind.__name__ for kind, message in zip(KINDS, near, strict=True) if message is None]
        fault = f"no {lacking[0]} within 20 ms" if lacking else _fault(*near)
        if not fault and near[0].stamp in taken[-1:]:
            fault = "the same Imu as the one before"
        if fault:
            done.left_out[OXTS] = f"frame {number} has {fault}"
            return None
        rows.append(packet_of(*near))
        taken.append(near[0].stamp)
    for number, row in enumerate(rows):
        write_text(drive / OXTS / "data" / f"{number:010d}.txt", " ".join(map(_text, row)) + "\n", None)
    write_text(drive / OXTS / "timestamps.txt", times(taken), done)
    for kind, messages in zip(KINDS, found, strict=True):
        name = source.names[source.of_type(kind)[0]]
        done.written[name] = len(rows)
        if len(messages) > len(rows):
            done.left_out[name] = f"{len(messages) - len(rows)} of {len(messages)}: one packet a frame"
    return str(found[0][0].frame)


def packet_of(imu: Imu, fix: NavSatFix, odometry: Odometry) -> list[float]:
    """The 30 numbers of a packet; accuracies that are not known are nan, statuses -1."""
    assert imu.orientation is not None
    assert odometry.linear is not None
    R = quaternion_to_matrix(imu.orientation)
    roll, pitch, yaw = roll_pitch_yaw(R).tolist()
    level = np.array([[math.cos(yaw), math.sin(yaw), 0], [-math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]) @ R
    velocity = R @ odometry.linear
    accuracy = math.nan if fix.covariance is None else math.sqrt((fix.covariance[0, 0] + fix.covariance[1, 1]) / 2)
    twist = odometry.twist_covariance
    steady = math.nan if twist is None else math.sqrt((twist[0, 0] + twist[1, 1]) / 2)
    return [
        fix.latitude, fix.longitude, fix.altitude, roll, pitch, yaw,
        velocity[1], velocity[0], *(level @ odometry.linear),
        *imu.linear_acceleration, *(level @ imu.linear_acceleration),
        *imu.angular_velocity, *(level @ imu.angular_velocity),
        accuracy, steady,
        UNKNOWN, UNKNOWN if fix.satellites is None else fix.satellites, MODES[fix.status], UNKNOWN, UNKNOWN,
    ]  # fmt: skip


def _fault(imu: Imu, fix: NavSatFix, odometry: Odometry) -> str:
    """Returns what keeps these three from being a packet; empty where nothing does."""
    if imu.orientation is None:
        return "an Imu without an orientation to east, north and up"
    if odometry.linear is None:
        return "an Odometry without a velocity"
    if odometry.child_frame != imu.frame:
        return f"an Odometry of {odometry.child_frame!r} and an Imu in {imu.frame!r}: velocities are of the unit"
    if not np.isfinite([fix.latitude, fix.longitude, fix.altitude]).all():
        return "a NavSatFix without a position"
    return ""


def _text(value: float) -> str:
    return str(value) if isinstance(value, int) else repr(float(value))
