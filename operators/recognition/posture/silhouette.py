"""Silhouettes: a person as a depth sensor sees it, in a window of fixed size around where it stands."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIDE = 64
"""Cells along each side of the window."""
HALF = 1.05
"""Metres from the window's middle to its sides."""
MIDDLE = 0.95
"""Metres of the window's middle over the floor."""
LEAST = 15
"""Cells that a body must cover to be judged."""
_DEEP, _NEAR = 0.6, 0.3  # metres ahead of the middle or behind it that make 1: of the body, of what is around
_CLOSEST = 0.3  # metres to the sensor


def silhouette(points: Array, own: NDArray[np.bool_], foot: Array, sensor: Array) -> NDArray[np.float32] | None:
    """Returns (3, SIDE, SIDE): where the body is, how much nearer it is than its middle, how much nearer others are.

    `points` (P, 3) are what one look of a depth sensor or LiDAR at `sensor` (3,) gave, of which `own` (P,) are the
    person's; it stands at `foot` (3,). All in a frame whose z points up, metres. The window is upright, turned to the
    sensor, and sees as it does: what is hidden is empty. Values are from -1 (behind) to 1. None where the person is
    closer than 0.3 m or covers less than `LEAST` cells.
    """
    x, y = foot[:2] - sensor[:2]
    away = math.hypot(x, y)
    if away < _CLOSEST:
        return None
    ahead, right = np.array([x, y]) / away, np.array([y, -x]) / away
    rays = points - sensor
    depth = rays[:, :2] @ ahead
    rays, own, depth = rays[depth > 0.1], own[depth > 0.1], depth[depth > 0.1]
    scale = away / depth
    across = rays[:, :2] @ right * scale
    up = rays[:, 2] * scale - (foot[2] + MIDDLE - sensor[2])
    columns = np.floor((across + HALF) * (SIDE / (2 * HALF))).astype(np.intp)
    rows = np.floor((HALF - up) * (SIDE / (2 * HALF))).astype(np.intp)
    inside = (columns >= 0) & (columns < SIDE) & (rows >= 0) & (rows < SIDE)
    cells, nearer, own = (rows * SIDE + columns)[inside], (away - depth)[inside], own[inside]
    order = np.argsort(nearer, kind="stable")  # the nearest of a cell comes last, and stays
    body, others = order[own[order]], order[~own[order]]
    found = np.zeros((3, SIDE * SIDE), np.float32)
    found[0, cells[body]] = 1
    found[1, cells[body]] = np.clip(nearer[body] / _DEEP, -1, 1)
    found[2, cells[others]] = np.clip(nearer[others] / _NEAR, -1, 1)
    return found.reshape(3, SIDE, SIDE) if np.count_nonzero(found[0]) >= LEAST else None
