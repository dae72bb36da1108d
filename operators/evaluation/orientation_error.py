"""The error of orientations, divided into heading and inclination as Laidig et al. (BROAD, 2021) divide it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataflow.messages.geometry import normalize, quaternion_from_yaw, quaternion_multiply

Array = NDArray[np.float64]
Heading = Literal["absolute", "relative"]


def differences(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Returns the rotations (N, 4), in the world's axes, from true to estimated orientations (N, 4); x, y, z, w."""
    q = np.asarray(truth, np.float64)
    return normalize(quaternion_multiply(normalize(estimate), q * [-1, -1, -1, 1]))


def without_mean_heading(difference: Array) -> Array:
    """Returns rotations (N, 4) less the heading that they have in common: that by which their sum is turned."""
    _, _, z, w = difference.T
    # Twice the heading's half angle, averaged as directions: signs of quaternions do not matter.
    common = np.angle(np.sum((w + 1j * z) ** 2))
    return quaternion_multiply(quaternion_from_yaw(-common), difference)


def errors(difference: Array) -> tuple[Array, Array, Array]:
    """Returns total error, heading error and inclination error (N,) of rotations (N, 4), radians, all ≥ 0."""
    x, y, z, w = np.abs(difference.T)
    total = 2 * np.arctan2(np.sqrt(x * x + y * y + z * z), w)
    return total, 2 * np.arctan2(z, w), 2 * np.arctan2(np.hypot(x, y), np.hypot(z, w))
