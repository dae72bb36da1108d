"""Rigid motions between points that are paired, and the distances that such a motion keeps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def fitted_motions(source: Array, target: Array, weights: Array) -> Array:
    """Returns the motions (K, 4, 4) that lay points (K, N, 3) onto others by weights (K, N) of sum 1. Umeyama, 1991."""
    a, b = (np.einsum("kn,kni->ki", weights, points) for points in (source, target))
    spread = np.einsum("kn,kni,knj->kij", weights, target - b[:, None], source - a[:, None])
    u, _, vt = np.linalg.svd(spread)
    flip = np.ones((len(source), 3))
    flip[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    R = (u * flip[:, None, :]) @ vt
    T = np.tile(np.eye(4), (len(source), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = b - np.einsum("kij,kj->ki", R, a)
    return T


def distances(points: Array) -> Array:
    """Returns how far points (M, 3) are from each other, (M, M)."""
    square = np.square(points).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(square[:, None] + square - 2 * points @ points.T, 0.0)), np.float64)
