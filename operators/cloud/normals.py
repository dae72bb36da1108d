"""Surface normals of a cloud, from the nearest neighbours of every point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

FEWEST = 5
"""Points, with the point itself, that a normal is estimated from at least."""


def estimate_normals(points: Array, *, neighbours: int, radius: float, viewpoint: Array) -> Array:
    """Returns unit normals (N, 3) that face the viewpoint (3,); NaN where fewer than `FEWEST` points are near.

    The normal is the direction in which the nearest points, at most `neighbours` and none farther than `radius`, vary
    least. Hoppe et al., "Surface reconstruction from unorganized points", 1992; the viewpoint decides the sign.
    """
    normals = np.full((len(points), 3), np.nan)
    if len(points) < FEWEST:
        return normals
    tree = cKDTree(points)
    distance, index = tree.query(points, min(neighbours, len(points)), distance_upper_bound=radius)
    near = np.isfinite(distance)
    counts = near.sum(axis=1)
    enough = np.flatnonzero(counts >= FEWEST)
    members = points[np.where(near[enough], index[enough], 0)] - points[enough][:, None]
    members *= near[enough][..., None]
    counts = counts[enough]
    mean = members.sum(axis=1) / counts[:, None]
    second = np.einsum("nki,nkj->nij", members, members) / counts[:, None, None]
    _, axes = np.linalg.eigh(second - mean[:, :, None] * mean[:, None, :])
    found = axes[:, :, 0]
    towards = np.einsum("ij,ij->i", found, viewpoint - points[enough])
    normals[enough] = np.where(towards[:, None] < 0, -found, found)
    return normals
