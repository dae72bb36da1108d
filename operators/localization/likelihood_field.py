"""The likelihood field of an occupancy grid, by which points are scored, and its free places."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import OccupancyGrid
from dataflow.messages.geometry import yaw_of

Array = NDArray[np.float64]

TAKEN, FREE = 65, 25
"""Cells of this occupancy in per cent and more are taken, known ones below `FREE` are free."""


class LikelihoodField:
    """Scores points against the nearest taken cell: a hit with Gaussian noise, or anything at all.

    Only taken cells that border on others count: nothing is seen within walls. Thrun, Burgard and Fox, "Probabilistic
    Robotics", 2005, 6.4. `sigma`: metres between a point and the taken cell it
    is of; `random`: share of points that are of nothing in the map.
    """

    def __init__(self, grid: OccupancyGrid, sigma: float = 0.08, random: float = 0.15) -> None:
        """Raises ValueError for a map without a taken or without a free cell."""
        taken, free = grid.cells >= TAKEN, (grid.cells >= 0) & (grid.cells < FREE)
        for cells, word in ((taken, "taken"), (free, "free")):
            if not cells.any():
                raise ValueError(f"the map has no {word} cell among its {grid.cells.size}: nothing can be found in it")
        self.resolution, self.sigma, self.random = grid.resolution, sigma, random
        self.frame = grid.frame
        self._origin = np.asarray(grid.position[:2])
        self._yaw = 0.0 if grid.orientation is None else float(yaw_of(grid.orientation))
        margin = max(2, math.ceil(4 * sigma / grid.resolution))
        self._margin = margin
        open_floor = np.pad(~taken, margin, constant_values=True).astype(np.uint8)
        beside = np.asarray(cv2.dilate(open_floor, np.ones((3, 3), np.uint8)), np.uint8)
        padded = 1 - (beside & (1 - open_floor))  # points are of surfaces
        near = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * grid.resolution
        self._distance = np.maximum(near - grid.resolution / 2, 0.0).astype(np.float32)
        self._sharp = self._table(sigma)
        self._broad = self._table(max(3 * sigma, 0.25))
        self._shape = (padded.shape[0], padded.shape[1])
        rows, columns = np.nonzero(free)
        self._free = np.column_stack([columns, rows]).astype(np.float64)

    def _table(self, sigma: float) -> NDArray[np.float32]:
        hit = np.exp(-0.5 * np.square(self._distance / sigma))
        return np.asarray(np.log((1.0 - self.random) * hit + self.random), np.float32).reshape(-1)

    @property
    def area(self) -> float:
        """Free floor, m²."""
        return len(self._free) * self.resolution**2

    def score(self, poses: Array, points: Array, *, broad: bool = False) -> Array:
        """Returns the mean logarithm of the likelihood (N,) of points (M, 2), seen from poses (N, 3)."""
        table = self._broad if broad else self._sharp
        return np.asarray(table[self._indices(poses, points)].mean(axis=1, dtype=np.float64))

    def distances(self, pose: Array, points: Array) -> Array:
        """Returns how far (M,) points seen from a pose (3,) are from the nearest taken cell, metres."""
        return np.asarray(self._distance.reshape(-1)[self._indices(pose[None], points)[0]], np.float64)

    def places(self, count: int, rng: np.random.Generator) -> Array:
        """Draws poses (count, 3) evenly from the free cells and all headings."""
        cells = self._free[rng.integers(0, len(self._free), count)] + rng.random((count, 2))
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        place = cells * self.resolution @ np.array([[c, s], [-s, c]]) + self._origin
        return np.column_stack([place, rng.uniform(-math.pi, math.pi, count)])

    def _indices(self, poses: Array, points: Array) -> NDArray[np.int32]:
        """Indices (N, M) into the padded grid; what lies outside of it falls on its rim."""
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        place = ((poses[:, :2] - self._origin) @ np.array([[c, -s], [s, c]]) / self.resolution + self._margin).astype(
            np.float32
        )
        turn = poses[:, 2] - self._yaw
        cosine, sine = np.cos(turn).astype(np.float32)[:, None], np.sin(turn).astype(np.float32)[:, None]
        x, y = (points / self.resolution).astype(np.float32).T
        column = cosine * x
        column -= sine * y
        column += place[:, :1]
        row = sine * x
        row += cosine * y
        row += place[:, 1:]
        rows, columns = self._shape
        np.clip(column, 0, columns - 1, out=column)
        np.clip(row, 0, rows - 1, out=row)
        cells: NDArray[np.int32] = row.astype(np.int32)
        cells *= columns
        cells += column.astype(np.int32)
        return cells
