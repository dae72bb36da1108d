"""The pinhole camera: optical frame (z forward, x right, y down), pixels (u, v), intrinsics K (3, 3) in pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from operators.geometry.se3 import Matrix

Points = NDArray[np.float64]
Pixels = NDArray[np.float64]


def unproject(pixels: Pixels, K: Matrix) -> Points:
    """Returns rays (N, 3) with z = 1 through pixels (N, 2)."""
    return np.column_stack(
        [(pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[1, 1], np.ones(len(pixels))]
    )


def project(points: Points, K: Matrix) -> Pixels:
    """Returns pixels (N, 2) of points (N, 3), metres; points at or behind the camera land far outside any image."""
    z = points[:, 2]
    before = z > 1e-3
    safe = np.where(before, z, 1e-9)
    pixels = np.empty((len(points), 2))
    for axis in range(2):
        place = points[:, axis] / safe * K[axis, axis] + K[axis, 2]
        pixels[:, axis] = np.where(before, place, -1e6).clip(-1e6, 1e6)
    return pixels


def project_clamped(points: Points, K: Matrix, near: float) -> Pixels:
    """Returns pixels (N, 2) of points (N, 3), metres; nearer ones as if at the depth `near`."""
    z = np.maximum(points[:, 2], near)
    return np.column_stack([K[0, 0] * points[:, 0] / z + K[0, 2], K[1, 1] * points[:, 1] / z + K[1, 2]])


def projection_jacobian(points: Points, K: Matrix, near: float) -> NDArray[np.float64]:
    """Returns d pixel / d point (N, 2, 3), that of nearer points as if at the depth `near`."""
    z = np.maximum(points[:, 2], near)
    D = np.zeros((len(points), 2, 3))
    D[:, 0, 0], D[:, 0, 2] = K[0, 0] / z, -K[0, 0] * points[:, 0] / z**2
    D[:, 1, 1], D[:, 1, 2] = K[1, 1] / z, -K[1, 1] * points[:, 1] / z**2
    return D
