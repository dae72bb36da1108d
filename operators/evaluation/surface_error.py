"""Errors of a reconstructed surface against the true one, from points on both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceErrors:
    """Figures of one surface. Distances in metres, shares of the points within the distance that was asked for.

    Knapitsch et al., "Tanks and temples", 2017.
    """

    accuracy: float  # mean distance from the surface to the true one
    completeness: float  # mean distance from the true surface to this one
    precision: float  # share of this surface that is near the true one
    recall: float  # share of the true surface that is near this one

    @property
    def f_score(self) -> float:
        """The harmonic mean of precision and recall."""
        both = self.precision + self.recall
        return 2 * self.precision * self.recall / both if both else 0.0


def surface_errors(found: Array, true: Array, distance: float) -> SurfaceErrors:
    """Compares points (N, 3) and true points (M, 3) of one frame. Raises ValueError where there are none of either."""
    if not (len(found) and len(true)):
        raise ValueError(f"{len(found)} points and {len(true)} true ones: both need some")
    off, missing = cKDTree(true).query(found)[0], cKDTree(found).query(true)[0]
    return SurfaceErrors(
        accuracy=float(off.mean()),
        completeness=float(missing.mean()),
        precision=float((off <= distance).mean()),
        recall=float((missing <= distance).mean()),
    )


def on_surface(vertices: Array, triangles: NDArray[np.uint32], count: int, rng: np.random.Generator) -> Array:
    """Returns points (count, 3) drawn evenly from the triangles (T, 3) of a mesh; none where it has no area."""
    corners = vertices[triangles.astype(np.int64)].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not area.sum() > 0:
        return np.zeros((0, 3))
    chosen = corners[rng.choice(len(area), count, p=area / area.sum())]
    root, second = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return np.asarray((1 - root) * chosen[:, 0] + root * (1 - second) * chosen[:, 1] + root * second * chosen[:, 2])
