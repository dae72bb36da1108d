"""Direction up that is expected in a camera's optical frame before anything is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DOWN = np.radians(20.0)  # cameras look down at what is near, by as much in the mean
_PITCH, _ROLL = np.radians(25.0), np.radians(12.0)  # standard deviations
_STANDARD = 9.81  # m/s²
_TILT = np.radians(1.5)  # standard deviation of an accelerometer's vertical at rest: bias and mounting


def held() -> tuple[Array, Array]:
    """Returns up (3,) and its information (3, 3), rad^-2, of a camera that a person carries or a robot bears."""
    up = np.array([0.0, -np.cos(_DOWN), -np.sin(_DOWN)])
    ahead, right = np.array([0.0, -np.sin(_DOWN), np.cos(_DOWN)]), np.array([1.0, 0.0, 0.0])
    return up, np.outer(ahead, ahead) / _PITCH**2 + np.outer(right, right) / _ROLL**2


def accelerated(force: Array) -> tuple[Array, Array]:
    """Returns the same of a specific force (3,), m/s², in that frame: less sure the more its size is not gravity's."""
    size = float(np.linalg.norm(force))
    if size < 0.5 * _STANDARD:
        return held()
    up, motion = force / size, abs(size - _STANDARD) / _STANDARD
    return up, (np.eye(3) - np.outer(up, up)) / (_TILT**2 + motion**2)
