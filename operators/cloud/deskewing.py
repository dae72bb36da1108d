"""Points of a moving LiDAR as it would see them at one moment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from operators.geometry.se3 import Vector, skew

Array = NDArray[np.float64]


def deskewed(points: Array, offsets: Array | None, velocity: Vector) -> Array:
    """Returns points (N, 3) as the sensor would see them at the stamp, if it moves at (v, w) in its own axes.

    Each point is seen from the pose exp(offset * velocity), in closed form.
    """
    if offsets is None or not velocity.any():
        return points
    v, w = velocity[:3], velocity[3:]
    rate = float(np.linalg.norm(w))
    W = skew(w)
    turn = rate * offsets
    if rate < 1e-6:
        sine, one_less_cosine, rest = offsets, offsets**2 / 2, offsets**3 / 6
    else:
        sine = np.sin(turn) / rate
        one_less_cosine = (1 - np.cos(turn)) / rate**2
        rest = (offsets - sine) / rate**2
    once = points @ W.T
    rotated = points + sine[:, None] * once + one_less_cosine[:, None] * (once @ W.T)
    moved: Array = rotated + np.outer(offsets, v) + np.outer(one_less_cosine, W @ v) + np.outer(rest, W @ W @ v)
    return moved
