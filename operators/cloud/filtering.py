"""Choosing and thinning the points of a cloud: range, crop box, voxel grid, outliers. Points are (N, 3), metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dataflow.messages import PointCloud

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FARTHEST = 1e4  # metres: no sensor of a robot sees so far, so that is no measurement
_LIMIT = 1 << 20  # voxels along one axis on either side of the origin; three such indices fit one int64


FIELDS = ("colors", "intensities", "rings", "time_offsets", "normals", "precise")
"""Fields of a cloud that hold a value for each point, beside its place."""


def selected(cloud: PointCloud, chosen: Mask, *, fields: Sequence[str] = FIELDS) -> PointCloud:
    """Returns the chosen points (N,) with some fields of theirs, without the others and no longer in rows of pixels."""
    known = {name: getattr(cloud, name) if name in fields else None for name in FIELDS}
    kept = {name: None if values is None else values[chosen] for name, values in known.items()}
    return cloud.replace(points=cloud.points[chosen], columns=None, **kept)


def finite(points: NDArray[np.float32]) -> Mask:
    """Returns which points have three finite coordinates, none of them `FARTHEST` or more."""
    return np.asarray((np.abs(points) < np.float32(FARTHEST)).all(axis=1))


def in_range(points: NDArray[np.float32], near: float, far: float) -> Mask:
    """Returns which points lie at a distance in [near, far] from the origin of their frame."""
    x, y, z = points.T.astype(np.float64, order="C")
    square = x * x + z * z + y * y
    inside: Mask = (square >= near * near) & (square <= far * far)
    return inside


def in_box(points: NDArray[np.float32], lower: Array, upper: Array) -> Mask:
    """Returns which points lie in the axis-parallel box [lower, upper] of their frame."""
    return np.asarray(((points >= lower) & (points <= upper)).all(axis=1))


@dataclass(frozen=True, eq=False)
class Voxels:
    """A partition of points by the cubes of a grid: `of` (N,) is the voxel of each point, `counts` (V,) their points.

    Voxels are numbered by their place in the grid, so the partition does not depend on the order of the points.
    """

    of: NDArray[np.intp]
    counts: NDArray[np.intp]

    @classmethod
    def by_size(cls, points: NDArray[np.float32], size: float) -> Voxels:
        """Raises ValueError where the cloud is more than about a million voxels wide."""
        cell = np.floor(points.astype(np.float64) / size)
        if len(cell) and np.abs(cell).max() >= _LIMIT:
            raise ValueError(f"a cloud that reaches {np.abs(points).max():.0f} m has too many voxels of {size} m")
        index = (cell.astype(np.int64) + _LIMIT) @ np.array([1 << 42, 1 << 21, 1], np.int64)
        _, of, counts = np.unique(index, return_inverse=True, return_counts=True)
        return cls(of, counts)

    def means(self, values: NDArray[np.generic]) -> Array:
        """Returns the mean (V, ...) of values (N,) or (N, C) over every voxel."""
        columns = np.asarray(values, np.float64).reshape(len(values), -1)
        sums = [np.bincount(self.of, column, len(self.counts)) for column in columns.T]
        means: Array = np.stack(sums, axis=1) / self.counts[:, None]
        return means if values.ndim > 1 else means[:, 0]


def statistical_inliers(points: NDArray[np.float32], neighbours: int, ratio: float) -> Mask:
    """Returns which points are near their neighbours, compared with the rest of the cloud.

    A point is an outlier where the mean distance to its nearest neighbours exceeds the cloud's mean of that distance by
    more than `ratio` standard deviations. Rusu et al., "Towards 3D point cloud based object maps", 2008, section 4.1.
    """
    if len(points) <= neighbours:
        return np.ones(len(points), np.bool_)
    distance, _ = cKDTree(points).query(points, neighbours + 1)
    mean = distance[:, 1:].mean(axis=1)
    inliers: Mask = mean <= mean.mean() + ratio * mean.std()
    return inliers


def radius_inliers(points: NDArray[np.float32], radius: float, neighbours: int) -> Mask:
    """Returns which points have at least so many others within a radius."""
    if not len(points):
        return np.zeros(0, np.bool_)
    tree = cKDTree(points)
    inliers: Mask = tree.query_ball_point(points, radius, return_length=True) > neighbours
    return inliers
