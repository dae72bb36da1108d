"""Rectangles as a LiDAR sees them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CORRIDOR = [  # axis, place, and what the rectangle spans of the other two axes
    (2, -0.6, (-60, 60), (-1, 1)), (2, 2.0, (-60, 60), (-1, 1)), (1, -1, (-60, 60), (-1, 2)), (1, 1, (-60, 60), (-1, 2))
]  # fmt: skip


def beams(rings: int = 24, columns: int = 240) -> Array:
    """Directions (N, 3), column after column, as a LiDAR turns."""
    azimuth, elevation = np.meshgrid(np.arange(columns) * 2 * np.pi / columns, np.linspace(-0.4, 0.4, rings),
                                     indexing="ij")  # fmt: skip
    a, e = azimuth.ravel(), elevation.ravel()
    return np.column_stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def cast(world: list[Any], origins: Array, directions: Array, limit: float = 30.0) -> Array:
    """Distance (N,) of the first rectangle on each ray; infinite where there is none within the limit."""
    nearest = np.full(len(origins), np.inf)
    for axis, place, *spans in world:
        others = [k for k in range(3) if k != axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (place - origins[:, axis]) / directions[:, axis]
            hit = origins + t[:, None] * directions
        inside = (t > 1e-6) & (t < limit)
        for k, (low, high) in zip(others, spans, strict=True):
            inside &= (hit[:, k] >= low) & (hit[:, k] <= high)
        nearest = np.where(inside & (t < nearest), t, nearest)
    return nearest
