"""Fast point feature histograms. Rusu, Blodow and Beetz, "Fast point feature histograms (FPFH)", 2009."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

BINS = 11


def histograms(points: Array, normals: Array, radius: float, neighbours: int) -> Array:
    """Returns the 33 numbers (N, 33) that describe the surface around each point; zeros where nothing is around it.

    `normals` (N, 3) are unit vectors. The histograms of the three angles between a point and the points around it, at
    most `neighbours` of them within `radius`, are joined with those of the points around, weighted by 1 / distance.
    """
    tree = cKDTree(points)
    distance, index = tree.query(points, min(neighbours + 1, len(points)), distance_upper_bound=radius)
    distance, index = distance[:, 1:], index[:, 1:]
    rows, columns = np.nonzero(np.isfinite(distance) & (distance > 1e-9))
    to, length = index[rows, columns], distance[rows, columns]
    simple = _simple(points, normals, rows, to, length)
    weights = 1 / length
    joined = np.zeros_like(simple)
    for k in range(simple.shape[1]):
        joined[:, k] = np.bincount(rows, weights * simple[to, k], len(points))
    total = np.bincount(rows, weights, len(points))
    joined = simple + joined / np.maximum(total, 1e-12)[:, None]
    blocks = joined.reshape(len(points), 3, BINS)
    return (blocks / np.maximum(blocks.sum(axis=2, keepdims=True), 1e-12)).reshape(len(points), 3 * BINS)


def _simple(points: Array, normals: Array, rows: NDArray[np.intp], to: NDArray[np.intp], length: Array) -> Array:
    """Returns the histograms (N, 33) of each point and the points around it alone."""
    u = normals[rows]
    line = (points[to] - points[rows]) / length[:, None]
    other = normals[to]
    v = np.cross(line, u)
    size = np.linalg.norm(v, axis=1)
    v = v / np.maximum(size, 1e-12)[:, None]
    w = np.cross(u, v)
    alpha = np.einsum("ij,ij->i", v, other)
    phi = np.einsum("ij,ij->i", u, line)
    theta = np.arctan2(np.einsum("ij,ij->i", w, other), np.einsum("ij,ij->i", u, other)) / np.pi
    out = np.zeros((len(points), 3 * BINS))
    for k, value in enumerate((alpha, phi, theta)):
        bins = np.clip(((value + 1) / 2 * BINS).astype(np.int64), 0, BINS - 1)
        out[:, k * BINS : (k + 1) * BINS] = np.bincount(rows * BINS + bins, minlength=len(points) * BINS).reshape(
            -1, BINS
        )
    counts = np.bincount(rows, minlength=len(points))
    return out / np.maximum(counts, 1)[:, None]
