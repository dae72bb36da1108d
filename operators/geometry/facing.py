"""Directions along which surfaces slide over themselves, so that their shape shows no motion there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEANS = 0.3  # cosine from which a surface faces along a direction: the normals of a plane err by less


def free_directions(normals: Array, share: float) -> Array:
    """Returns orthonormal directions (K, 3) along which less than a share of the surfaces faces, normals (N, 3)."""
    if not len(normals):
        return np.eye(3)
    axes = np.linalg.eigh(normals.T @ normals)[1]
    along = normals @ axes
    facing = np.where(np.abs(along) > LEANS, along**2, 0.0).mean(axis=0)
    return np.asarray(axes.T[facing < share], np.float64)
