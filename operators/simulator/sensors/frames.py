"""Frames of the robot: how mounts become transforms, and what the optical frame of a camera is."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from operators.simulator.settings import Mount, Mounted

Array = NDArray[np.float64]

BODY_TO_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""`T_housing_optical` (4, 4): the optical frame (z forward, x right, y down) in a housing (x forward, y left, z up)."""


@lru_cache(maxsize=64)
def mounted(mount: Mount) -> Array:
    """`T_base_sensor` (4, 4) of (x, y, z, roll, pitch, yaw): turned about fixed x, then y, then z (REP 103)."""
    x, y, z, roll, pitch, yaw = mount
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    T = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )
    T.flags.writeable = False
    return T


def place(sensor: Mounted) -> Array:
    """`T_base_sensor` (4, 4) of where a sensor really is."""
    return displaced(mounted(sensor.mount), sensor.mount_error)


def displaced(T: Array, error: Mount) -> Array:
    """A pose (4, 4) moved by an error in its own axes."""
    return T @ mounted(error) if any(error) else T


def displaced_optical(T: Array, error: Mount) -> Array:
    """The same for an optical frame: the error is that of its housing (x forward, y left, z up)."""
    return T @ BODY_TO_OPTICAL.T @ mounted(error) @ BODY_TO_OPTICAL if any(error) else T
