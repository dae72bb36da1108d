"""Scores clouds and meshes against the true surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dataflow.messages import Mesh, PointCloud
from dataflow.operator import In, Operator, Param, Sampled
from operators.evaluation.figures import Figures

Array = NDArray[np.float64]


class SurfaceMetrics(Figures, Operator):
    """Scores the last cloud or mesh of a stream against the true surface: accuracy, completeness and F-score.

    A mesh counts as points that are drawn evenly from it. All of the true surface counts, whether a sensor has come by
    or not, so that completeness grows with the way that was driven; accuracy does not depend on it.

    Method: Knapitsch et al., "Tanks and temples", 2017.
    """

    surface: In[PointCloud | Mesh] = In(doc="the surface as it is known so far; the last one is scored")
    truth: Sampled[Mesh | PointCloud] = Sampled(doc="the true surface, in the same frame")

    distance: float = Param(0.05, gt=0, doc="points so near to the other surface are right", unit="m")
    points: int = Param(50_000, ge=100, le=5_000_000, doc="points that are drawn from a mesh")

    def setup(self) -> None:
        super().setup()
        self._last: tuple[PointCloud | Mesh, Mesh | PointCloud] | None = None
        self._count = 0

    def process(self, surface: PointCloud | Mesh, truth: Mesh | PointCloud) -> None:
        """Raises ValueError where the surface is in another frame than the true one."""
        if surface.frame != truth.frame:
            raise ValueError(f"the surface is in frame {surface.frame!r}, the true one in {truth.frame!r}")
        self._last = surface, truth
        self._count += 1

    def finish(self) -> None:
        """Scores the last surface."""
        if self._last is None:
            return
        found, true = (self._drawn(one) for one in self._last)
        if not (len(found) and len(true)):
            self._figures = {"f_score": f"not computed: {len(found)} points of the surface, {len(true)} true ones"}
            return
        errors = surface_errors(found, true, self.distance)
        self._figures = {
            "f_score": errors.f_score,
            "precision": errors.precision,
            "recall": errors.recall,
            "accuracy_m": errors.accuracy,
            "completeness_m": errors.completeness,
        }

    def summary(self) -> Mapping[str, float | int | str]:
        return {"surfaces": self._count} | (self._figures or {"f_score": "not computed: no surface came"})

    def _drawn(self, surface: PointCloud | Mesh) -> Array:
        if isinstance(surface, Mesh):
            points = on_surface(surface.vertices.astype(np.float64), surface.triangles, self.points, self.rng)
        else:
            points = surface.points.astype(np.float64)
        return points[np.isfinite(points).all(axis=1)]


@dataclass(frozen=True)
class SurfaceErrors:
    """Figures of one surface. Distances in metres, shares of the points within the distance that was asked for."""

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
