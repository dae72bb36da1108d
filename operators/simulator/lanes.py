"""Strips of floor that movers keep to. Lanes that lie apart keep movers apart at all times, whatever their phases."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from operators.simulator.shapes import Array

WALKER, ROVER = 0.38, 0.31
"""Metres from its way within which a person walks, turns and swings the arms, and a robot drives."""

_SPACING = 0.02  # metres between the points that stand for a line


@dataclass(frozen=True, eq=False)
class Lane:
    """All within `radius` metres of a line (N, 2), for the thing with id `mover`."""

    mover: int
    line: Array
    radius: float

    def gap(self, points: Array) -> float:
        """Metres between the lane and the nearest of points (M, 2); negative if that is inside."""
        return float(np.min(self._off_line(points))) - self.radius

    def holds(self, points: Array) -> bool:
        """Returns whether all of the points (M, 2) lie in the lane, to within a centimetre."""
        return bool(np.max(self._off_line(points)) <= self.radius + _SPACING / 2)

    def apart(self, other: Lane) -> float:
        """Metres between two lanes; negative if they overlap."""
        return self.gap(_dense(other.line)) - other.radius

    def _off_line(self, points: Array) -> Array:
        """Metres (M,) to the line."""
        distance, _ = self._tree.query(points)
        return np.asarray(distance)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(_dense(self.line))


def _dense(line: Array) -> Array:
    """Points at most `_SPACING` apart along straight pieces."""
    pieces = [
        np.linspace(a, b, max(1, int(np.linalg.norm(b - a) / _SPACING)), endpoint=False) for a, b in pairwise(line)
    ]
    return np.concatenate([*pieces, line[-1:]])
