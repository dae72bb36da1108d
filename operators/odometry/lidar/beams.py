"""The beams of a scan, which tell a surface from points that happen to lie in a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

_DIAGONAL = 0.7
_LOOKED_AT = np.array(  # standard deviations along and across, from the middle of a plane's points
    [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), *((i * _DIAGONAL, j * _DIAGONAL) for i in (-1, 1) for j in (-1, 1))]
)


class Beams:
    """Beams from `origin` (3,) to points (N, 3), in the map's frame, found by their directions."""

    def __init__(self, points: Array, origin: Array) -> None:
        self.origin, self._points = origin, points
        self._tree: cKDTree | None = None

    def pass_through(self, centers: Array, normals: Array, spread: Array, thickest: float) -> NDArray[np.bool_]:
        """Returns of planes (N, 3), whose points have covariances (N, 3, 3), whether a beam went on behind them.

        Of nine places among a plane's points, the beam that looks nearest to each is asked; behind is farther than
        `thickest` metres. Where scan lines cross (a wall and the ceiling of a corridor), a plane fits them that is no
        surface: it hangs in the air, moves with the sensor, and holds its pose.
        """
        if not len(centers):
            return np.zeros(0, np.bool_)
        if self._tree is None:
            self._tree = cKDTree(_unit(self._points - self.origin))
        along, across = _axes(normals, spread)
        asked = centers[:, None] + _LOOKED_AT[:, :1] * along[:, None] + _LOOKED_AT[:, 1:] * across[:, None]
        _, nearest = self._tree.query(_unit(asked - self.origin))
        beyond = np.einsum("nki,ni->nk", self._points[nearest] - centers[:, None], normals)
        away = np.sign(np.einsum("ni,ni->n", centers - self.origin, normals))
        passed: NDArray[np.bool_] = (beyond * away[:, None] > thickest).any(axis=1)
        return passed


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.maximum(np.sqrt(np.square(vectors).sum(axis=-1)), 1e-9)[..., None]
    return unit


def _axes(normals: Array, spread: Array) -> tuple[Array, Array]:
    """Returns the principal axes (N, 3) of points within their planes, one standard deviation long."""
    a = _unit(np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)]))
    b = np.cross(normals, a)
    aa, ab, bb = (np.einsum("ni,nij,nj->n", u, spread, v) for u, v in ((a, a), (a, b), (b, b)))
    angle = 0.5 * np.arctan2(2 * ab, aa - bb)
    c, s = np.cos(angle), np.sin(angle)
    long = np.sqrt(np.maximum(c * c * aa + 2 * c * s * ab + s * s * bb, 0.0))
    short = np.sqrt(np.maximum(s * s * aa - 2 * c * s * ab + c * c * bb, 0.0))
    return long[:, None] * (c[:, None] * a + s[:, None] * b), short[:, None] * (c[:, None] * b - s[:, None] * a)
