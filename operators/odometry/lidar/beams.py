"""The beams of a scan, which distinguish a surface from points that happen to lie in a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

_LEAF = 32  # beams: one scan asks a few thousand times, so a tree that is quick to build costs least
_DIAGONAL = 0.7
_LOOKED_AT = np.array(  # standard deviations along and across, from the middle of a plane's points
    [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), *((i * _DIAGONAL, j * _DIAGONAL) for i in (-1, 1) for j in (-1, 1))]
)


def passed_through(
    points: Array, origin: Array, centers: Array, normals: Array, spread: Array, thickest: Array
) -> NDArray[np.bool_]:
    """Returns of planes (N, 3), whose points have covariances (N, 3, 3), whether a beam went on behind them.

    The beams go from `origin` (3,) to points (M, 3), all in the map's frame. Of nine places among a plane's points, the
    beam that looks nearest to each is asked; behind is farther than `thickest` (N,) metres. Where scan lines cross (a
    wall and the ceiling of a corridor), a plane fits them that is no surface: it hangs in the air, moves with the
    sensor, and holds its pose.
    """
    if not len(centers):
        return np.zeros(0, np.bool_)
    beams = cKDTree(_unit(points - origin), _LEAF, compact_nodes=False, balanced_tree=False)
    along, across = _axes(normals, spread)
    asked = centers[:, None] + _LOOKED_AT[:, :1] * along[:, None] + _LOOKED_AT[:, 1:] * across[:, None]
    _, nearest = beams.query(_unit(asked - origin))
    beyond = np.einsum("nki,ni->nk", points[nearest] - centers[:, None], normals)
    away = np.sign(np.einsum("ni,ni->n", centers - origin, normals))
    passed: NDArray[np.bool_] = (beyond * away[:, None] > thickest[:, None]).any(axis=1)
    return passed


def cross(a: Array, b: Array) -> Array:
    """Returns the cross products (N, 3): several times faster than numpy's for many rows."""
    return np.stack(
        [a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1], a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
         a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]], axis=1,
    )  # fmt: skip


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.maximum(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)), 1e-9)[..., None]
    return unit


def _axes(normals: Array, spread: Array) -> tuple[Array, Array]:
    """Returns the principal axes (N, 3) of points within their planes, one standard deviation long."""
    a = _unit(cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)]))
    b = cross(normals, a)
    aa, ab, bb = (np.einsum("ni,nij,nj->n", u, spread, v) for u, v in ((a, a), (a, b), (b, b)))
    angle = 0.5 * np.arctan2(2 * ab, aa - bb)
    c, s = np.cos(angle), np.sin(angle)
    long = np.sqrt(np.maximum(c * c * aa + 2 * c * s * ab + s * s * bb, 0.0))
    short = np.sqrt(np.maximum(s * s * aa - 2 * c * s * ab + c * c * bb, 0.0))
    return long[:, None] * (c[:, None] * a + s[:, None] * b), short[:, None] * (c[:, None] * b - s[:, None] * a)
