"""Scores clouds and meshes against the true surface."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Mesh, PointCloud
from dataflow.operator import In, Operator, Param, Sampled
from operators.evaluation.surface_error import on_surface, surface_errors


class SurfaceMetrics(Operator):
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
        self._last: tuple[PointCloud | Mesh, Mesh | PointCloud] | None = None
        self._figures: dict[str, float | int | str] = {}
        self._count = 0

    def process(self, surface: PointCloud | Mesh, truth: Mesh | PointCloud) -> None:
        """Raises ValueError where the surface is in another frame than the true one."""
        if surface.frame != truth.frame:
            raise ValueError(f"the surface is in frame {surface.frame!r}, the true one in {truth.frame!r}")
        self._last = surface, truth
        self._count += 1

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew, and so does the score."""
        self.setup()

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

    def _drawn(self, surface: PointCloud | Mesh) -> NDArray[np.float64]:
        if isinstance(surface, Mesh):
            points = on_surface(surface.vertices.astype(np.float64), surface.triangles, self.points, self.rng)
        else:
            points = surface.points.astype(np.float64)
        return points[np.isfinite(points).all(axis=1)]
