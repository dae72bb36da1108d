"""The two directions that the walls of a building have in common, as walls that were seen tell of them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered

Array = NDArray[np.float64]

_FADES = 0.9  # share of what walls said before that a cloud leaves
_ENOUGH = 1.0  # m² of wall
_AGREED = 0.9  # length of the mean of unit vectors at four times the angle: half of them within 4 degrees


class WallDirections(Remembered):
    """Averages the normals of walls, which turn by 90 degrees from one to the next in most buildings.

    Angles are those of a frame whose z is up, and that stays. Where walls do not agree, there is no common direction.
    Coughlan and Yuille, "Manhattan world", 1999.
    """

    _sum: complex
    _weight: float

    def __init__(self) -> None:
        self._sum, self._weight = 0j, 0.0

    def add(self, normals: Array, areas: Array) -> None:
        """Takes the normals (N, 3) of walls, in the frame that stays, and their areas (N,), m²."""
        self._sum, self._weight = _FADES * self._sum, _FADES * self._weight
        angles = np.arctan2(normals[:, 1], normals[:, 0])
        self._sum += complex((areas * np.exp(4j * angles)).sum())
        self._weight += float(areas.sum())

    @property
    def axes(self) -> Array | None:
        """The two directions (2, 3), level and across each other; None where walls are few or do not agree."""
        if self._weight < _ENOUGH or abs(self._sum) < _AGREED * self._weight:
            return None
        angle = math.atan2(self._sum.imag, self._sum.real) / 4
        c, s = math.cos(angle), math.sin(angle)
        return np.array([[c, s, 0.0], [-s, c, 0.0]])
