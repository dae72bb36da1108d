"""One surface of the map: the voxels in which it was seen, and the plane and the box that they give."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.scene.map.trajectory import Correction
from operators.scene.map.voxels import VoxelSet, standing_box
from operators.scene.relations import TABLETOP

Array = NDArray[np.float64]

FLOOR, WALL, CEILING = "floor", "wall", "ceiling"
SURFACES = (FLOOR, WALL, TABLETOP, CEILING)
"""Classes of surfaces."""

SIDE = 0.1
"""Side of their voxels, m."""

MOST_EVIDENCE = 6.0
_THICKNESS = 0.02  # metres, of a surface's box
_EDGE = 2.0  # percent of the points of an upright surface beyond each end of its box
_PLAIN = ("id", "label", "evidence", "born", "seen", "views", "most", "yaw")
_ARRAYS = ("facing", "center", "size")


@dataclass
class MapSurface:
    """A level or upright surface. Times in nanoseconds; `facing` (3,) is the side that it was seen from.

    `most` is the largest number of voxels that it had, `middle` (3,) and `normal` (3,) are those
    of its plane; centre, full size (3,) and heading are of the thin upright box of what was seen of it, as `settle`
    left them.
    """

    id: int
    label: str
    voxels: VoxelSet
    facing: Array
    evidence: float
    born: int
    seen: int
    views: int = 1
    most: int = 0
    center: Array = field(default_factory=lambda: np.zeros(3))
    size: Array = field(default_factory=lambda: np.zeros(3))
    yaw: float = 0.0

    def __post_init__(self) -> None:
        self.fit()

    def fit(self) -> None:
        """Fits the plane to the voxels, each as often as it was seen: level, or upright."""
        weights, points = self.voxels.hits / max(float(self.voxels.hits.sum()), 1e-9), self.voxels.points
        self.middle = weights @ points
        if self.level:
            self.middle[2] = _median(points[:, 2], weights)
            self.normal = np.array([0.0, 0.0, math.copysign(1.0, float(self.facing[2]))])
            return
        flat = points[:, :2] - self.middle[:2]
        _, axes = np.linalg.eigh((flat * weights[:, None]).T @ flat)
        across = axes[:, 0] * (1.0 if axes[:, 0] @ self.facing[:2] >= 0 else -1.0)
        self.normal = np.array([*across, 0.0])
        self.middle[:2] += across * _median(flat @ across, weights)

    @property
    def level(self) -> bool:
        return self.label != WALL

    @property
    def score(self) -> float:
        """Probability that the surface is there."""
        return 1 / (1 + math.exp(-self.evidence))

    @property
    def area(self) -> float:
        """Area that was seen of it, m²: that of the squares of the grid that hold points."""
        axes = np.array([[1.0, 0, 0], [0, 1, 0]]) if self.level else np.array([self._along, [0, 0, 1]])
        column, row = np.floor((self.voxels.points - self.middle) @ axes.T / SIDE).astype(np.int64).T
        return len(np.unique((column << 32) + row)) * SIDE * SIDE

    @property
    def _along(self) -> Array:
        return np.array([-self.normal[1], self.normal[0], 0.0])

    def away(self, points: Array) -> float:
        """Returns the median distance of points (N, 3) from the plane."""
        return float(np.median(np.abs((points - self.middle) @ self.normal)))

    @property
    def box(self) -> tuple[Array, Array, float]:
        return self.center, self.size, self.yaw

    def settle(self, heading: float | None) -> None:
        """Puts the box around what was seen; a level one lies along `heading`, that of most things around."""
        self.center, self.size, self.yaw = self._lying(heading) if self.level else self._standing()

    def _standing(self) -> tuple[Array, Array, float]:
        ends = np.percentile((self.voxels.points - self.middle) @ self._along, [_EDGE, 100 - _EDGE])
        low, high = np.percentile(self.voxels.points[:, 2], [_EDGE, 100 - _EDGE])
        center = self.middle + self._along * ends.mean()
        center[2] = (low + high) / 2
        yaw = math.atan2(float(self._along[1]), float(self._along[0]))
        return center, np.array([float(np.ptp(ends)), _THICKNESS, float(high - low)]), yaw

    def _lying(self, heading: float | None) -> tuple[Array, Array, float]:
        if heading is None:
            center, size, yaw = standing_box(self.voxels.points)
        else:
            turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
            turned = self.voxels.points[:, :2] @ turn
            low, high = turned.min(axis=0), turned.max(axis=0)
            center, size, yaw = np.array([*(turn @ (low + high) / 2), 0.0]), np.array([*(high - low), 0.0]), heading
        center[2], size[2] = self.middle[2] - math.copysign(_THICKNESS / 2, float(self.facing[2])), _THICKNESS
        return center, size, yaw

    def take(self, other: MapSurface) -> None:
        """Takes in what was seen of a surface that is the same."""
        self.voxels.add(other.voxels)
        self.facing = self.facing + other.facing
        self.evidence = min(self.evidence + other.evidence, MOST_EVIDENCE)
        self.born, self.seen = min(self.born, other.born), max(self.seen, other.seen)
        self.views += other.views
        self.most = max(self.most, len(self.voxels))
        self.fit()

    def correct(self, correction: Correction) -> None:
        """Moves each voxel with the place from which it was seen."""
        if not len(self.voxels):
            return
        self.facing = correction.at(round(float(self.voxels.times.mean())))[:3, :3] @ self.facing
        self.voxels.correct(correction)
        self.most = min(self.most, len(self.voxels))
        self.fit()

    # snapshot and restore are written out: saved maps hold what they give, and those of earlier versions are read

    def snapshot(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in (*_PLAIN, *_ARRAYS)} | {"cells": self.voxels.snapshot()}

    @classmethod
    def restored(cls, state: Mapping[str, Any]) -> MapSurface:
        voxels = VoxelSet(SIDE)
        voxels.restore(state["cells"])
        fields: dict[str, Any] = {name: np.array(state[name], np.float64) for name in _ARRAYS}
        return cls(voxels=voxels, **{name: state[name] for name in _PLAIN}, **fields)


def _median(values: Array, weights: Array) -> float:
    """Returns the value at which half of the weight is reached."""
    order = np.argsort(values, kind="stable")
    return float(values[order[np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())]])
