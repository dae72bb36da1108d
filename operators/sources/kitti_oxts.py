"""Packets of the inertial and satellite navigation of KITTI raw (`oxts`): read, and as messages.

Geiger et al., "Vision meets robotics: the KITTI dataset", 2013; its `dataformat.txt` names the 30 numbers of a packet.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Imu, Message, NavSatFix, Odometry
from dataflow.messages.geometry import matrix_to_quaternion
from dataflow.operator import SourceError
from operators.geometry.geodesy import east_north_up

Array = NDArray[np.float64]

STATUSES = {
    0: "no_fix", 1: "no_fix", 2: "no_fix", 10: "no_fix", 11: "no_fix",
    4: "gbas", 14: "gbas", 5: "rtk_float", 15: "rtk_float", 6: "rtk_fixed", 16: "rtk_fixed",
    7: "sbas", 8: "sbas", 9: "sbas", 17: "sbas", 18: "sbas",
}  # fmt: skip
"""Kind of fix by the position mode of the primary receiver; any other is a plain `fix`."""


class Packet(NamedTuple):
    """One packet, in the order of its file: SI units and radians, latitude and longitude in degrees.

    Roll is positive with the left side up, pitch with the front down, yaw counts counterclockwise from east. Axes
    x, y, z are the vehicle's front, left and top; f, l, u are forward, left and up of the level plane.
    """

    lat: float
    lon: float
    alt: float
    roll: float
    pitch: float
    yaw: float
    vn: float
    ve: float
    vf: float
    vl: float
    vu: float
    ax: float
    ay: float
    az: float
    af: float
    al: float
    au: float
    wx: float
    wy: float
    wz: float
    wf: float
    wl: float
    wu: float
    pos_accuracy: float
    vel_accuracy: float
    navstat: float
    numsats: float
    posmode: float
    velmode: float
    orimode: float

    @property
    def R_enu_imu(self) -> Array:
        """Rotation (3, 3) from the unit's axes to east, north and up: about z by yaw, y by pitch, x by roll."""
        (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (self.roll, self.pitch, self.yaw))
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )


def read_packet(file: Path) -> Packet:
    """Reads one packet. Raises SourceError that names the number that is wrong; accuracies may be nan, not known."""
    try:
        words = file.read_text(encoding="utf-8").split()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{file}: {error}") from None
    if len(words) != len(Packet._fields):
        raise SourceError(
            f"{file} has {len(words)} numbers; {len(Packet._fields)} expected: {', '.join(Packet._fields)}"
        )
    values = []
    for name, word in zip(Packet._fields, words, strict=True):
        try:
            value = float(word)
        except ValueError:
            raise SourceError(f"{file}: {name} is {word!r}, no number") from None
        if not math.isfinite(value) and not name.endswith("accuracy"):
            raise SourceError(f"{file}: {name} is {word}; expected a finite number")
        values.append(value)
    packet = Packet(*values)
    if abs(packet.lat) > 90 or abs(packet.lon) > 180:
        raise SourceError(f"{file}: {packet.lat}, {packet.lon} is no latitude and longitude in degrees")
    return packet


def messages_of(
    packet: Packet, stamp: int, *, origin: tuple[float, float, float], frame: str, odometry_frame: str
) -> Mapping[str, Message]:
    """The packet as `imu`, `fix` and `odometry`. `origin`: latitude, longitude, altitude of the odometry's frame."""
    R = packet.R_enu_imu
    orientation = matrix_to_quaternion(R)
    angular = np.array([packet.wx, packet.wy, packet.wz])
    known = math.isfinite(packet.pos_accuracy)
    return {
        "imu": Imu(
            stamp=stamp,
            frame=frame,
            angular_velocity=angular,
            linear_acceleration=np.array([packet.ax, packet.ay, packet.az]),
            orientation=orientation,
        ),
        "fix": NavSatFix(
            stamp=stamp,
            frame=frame,
            status=STATUSES.get(int(packet.posmode), "fix"),
            latitude=packet.lat,
            longitude=packet.lon,
            altitude=packet.alt,
            satellites=int(packet.numsats) if packet.numsats >= 0 else None,
            covariance_type="approximated" if known else "unknown",
            covariance=np.eye(3) * packet.pos_accuracy**2 if known else None,
        ),
        "odometry": Odometry(
            stamp=stamp,
            frame=odometry_frame,
            child_frame=frame,
            position=east_north_up(packet.lat, packet.lon, packet.alt, origin),
            orientation=orientation,
            linear=R.T @ [packet.ve, packet.vn, packet.vu],
            angular=angular,
        ),
    }
