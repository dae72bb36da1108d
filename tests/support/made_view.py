"""What a camera that is held askew sees of a room: a floor, a table top and two walls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
HEIGHT = 1.3


def turned(down: float, roll: float) -> Array:
    """Returns the rotation (3, 3) to a camera's optical frame from one with x right, y down and z ahead, all level."""
    return Rotation.from_euler("xz", [down, roll], degrees=True).as_matrix()


def room(down: float, roll: float, *, walls: bool = True, floor: bool = True) -> Array:
    """Returns what a camera sees of a floor, a table top and two walls, with noise (N, 3), in its optical frame."""
    rng = np.random.default_rng(3)
    flat = rng.uniform(-1, 1, (6000, 2))
    parts = []
    if floor:
        parts.append(np.stack([1.5 * flat[:, 0], np.full(6000, HEIGHT), 2.5 + flat[:, 1]], axis=1))
        parts.append(np.stack([0.5 * flat[:, 0], np.full(6000, HEIGHT - 0.7), 1.6 + 0.4 * flat[:, 1]], axis=1))
    if walls:
        parts.append(np.stack([1.5 * flat[:, 0], flat[:, 1], np.full(6000, 3.5)], axis=1))
        parts.append(np.stack([np.full(6000, 1.5), flat[:, 0], 2.5 + flat[:, 1]], axis=1))
    points = np.concatenate(parts) + rng.normal(0, 0.005, (len(parts) * 6000, 3))
    return points @ turned(down, roll).T
