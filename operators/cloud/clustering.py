"""Clusters of points, their boxes and their shapes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

Array = NDArray[np.float64]
Labels = NDArray[np.int32]


def dbscan(points: Array, reach: float | Array, core: int, weights: NDArray[np.intp]) -> Labels:
    """Returns the cluster (N,) of each point, -1 for noise. Clusters are numbered by their first point.

    Two points are neighbours where they are as near as the smaller `reach` of the two, one for all or (N,). A point
    with a weight of at least `core` among its neighbours, its own included, is a core point; core points that are
    neighbours share a cluster, and others join that of their nearest core point within their reach. With `core` 1 this
    is Euclidean clustering. Ester et al., "A density-based algorithm for discovering clusters", 1996; ties by distance,
    so the result does not depend on the order of the points.
    """
    count = len(points)
    labels = np.full(count, -1, np.int32)
    if not count:
        return labels
    reaches = np.broadcast_to(np.asarray(reach, np.float64), (count,))
    pairs = _neighbours(points, reaches)
    mass = weights + np.bincount(pairs[:, 0], weights[pairs[:, 1]], count)
    mass = mass + np.bincount(pairs[:, 1], weights[pairs[:, 0]], count)
    is_core = mass >= core
    cores = np.flatnonzero(is_core)
    if not len(cores):
        return labels
    part = connected(pairs[is_core[pairs].all(axis=1)], count)
    labels[cores] = part[cores]
    border = np.flatnonzero(~is_core)
    if len(border):
        distance, nearest = cKDTree(points[cores]).query(points[border])
        near = distance <= reaches[border]
        labels[border[near]] = part[cores[nearest[near]]]
    return _numbered(labels)


def connected(pairs: NDArray[np.intp], count: int) -> NDArray[np.int32]:
    """Returns the number of the part (N,) that each of `count` things is of, linked by pairs (M, 2) of them."""
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _neighbours(points: Array, reach: Array) -> NDArray[np.intp]:
    """Returns the pairs (M, 2) of points that are as near as the smaller of their `reach` (N,).

    Reaches are looked at by powers of two, so that a few far points with a long reach cost no time among near ones.
    """
    octave = np.frexp(reach)[1]
    found = []
    for power in np.unique(octave):
        own, others = np.flatnonzero(octave == power), np.flatnonzero(octave >= power)
        near = cKDTree(points[own]).sparse_distance_matrix(
            cKDTree(points[others]), float(reach[own].max()), output_type="ndarray"
        )
        i, j = own[near["i"]], others[near["j"]]
        once = (near["v"] <= np.minimum(reach[i], reach[j])) & ((octave[j] > power) | (i < j))
        found.append(np.column_stack([i[once], j[once]]))
    return np.concatenate(found)


def kept(labels: Labels, sizes: NDArray[np.int64], fewest: int, most: int) -> Labels:
    """Returns the labels without the clusters whose size (C,) is outside [fewest, most], numbered anew."""
    fits = np.append((sizes >= fewest) & (sizes <= most), False)
    return _numbered(np.where(fits[labels], labels, -1).astype(np.int32))


def _numbered(labels: Labels) -> Labels:
    """Returns the labels as 0, 1, ... in the order of their first points."""
    names, first = np.unique(labels, return_index=True)
    order = [name for _, name in sorted(zip(first.tolist(), names.tolist(), strict=True)) if name >= 0]
    table = np.full(int(labels.max(initial=-1)) + 2, -1, np.int32)
    for number, name in enumerate(order):
        table[name] = number
    return table[labels]


@dataclass(frozen=True, eq=False)
class Shape:
    """Facts about one cluster. `T` (4, 4) maps its box's axes, z along up, to the cloud's frame; `size` (3,)."""

    centroid: Array
    lower: Array
    upper: Array
    T: Array
    size: Array
    volume: float
    linearity: float
    planarity: float
    sphericity: float


def shape_of(points: Array, up: Array) -> Shape:
    """Returns the shape of a cluster (N, 3), N ≥ 1.

    The box is the one of least area around the points as seen from above, from the lowest to the highest; the volume is
    that of the convex hull, 0 where the points are flat. Linearity, planarity and sphericity are (a - b) / a, (b - c) /
    a and c / a for the eigenvalues a ≥ b ≥ c of the covariance, and add up to 1: West et al., "Context-driven automated
    target detection in 3D data", 2004. A single point has none of them: all are 0.
    """
    centroid = points.mean(axis=0)
    offset = points - centroid
    smallest, middle, largest = (max(float(v), 0.0) for v in np.linalg.eigvalsh(offset.T @ offset / len(points)))
    scale = largest if largest > 1e-12 else np.inf
    T, size = upright_box(points, up)
    return Shape(
        centroid=centroid,
        lower=points.min(axis=0),
        upper=points.max(axis=0),
        T=T,
        size=size,
        volume=_volume(points),
        linearity=(largest - middle) / scale,
        planarity=(middle - smallest) / scale,
        sphericity=smallest / scale,
    )


def level_axes(up: Array) -> Array:
    """Returns two directions (2, 3) across `up`."""
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = _cross(helper, up)
    x /= np.linalg.norm(x)
    return np.stack([x, _cross(up, x)])


def upright_box(points: Array, up: Array, level: Array | None = None) -> tuple[Array, Array]:
    """Returns the axes and place T (4, 4), z along up, and the size (3,) of the upright box of least area.

    `level` are the `level_axes` of up, where they are known.
    """
    level = level_axes(up) if level is None else level
    origin = points[0]
    flat = ((points - origin) @ level.T).astype(np.float32)
    (u, v), (width, depth), angle = cv2.minAreaRect(flat)
    heights = (points - origin) @ up
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    low, high = heights.min(), heights.max()
    T = np.eye(4)
    T[:3, :2], T[:3, 2] = (np.array([[c, s], [-s, c]]) @ level).T, up
    T[:3, 3] = origin + np.array([u, v]) @ level + (low + high) / 2 * up
    return T, np.array([width, depth, high - low])


def _cross(a: Array, b: Array) -> Array:
    """Returns the cross product (3,) of two vectors, in a tenth of the time that `np.cross` takes for a single one."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def _volume(points: Array) -> float:
    """Returns the volume of the convex hull, m³; 0 where the points lie in a plane."""
    try:
        return float(ConvexHull(points - points[0]).volume) if len(points) > 3 else 0.0
    except QhullError:
        return 0.0
