"""Clouds made smaller and cleaner, with normals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, PointCloud
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param
from operators.cloud.filtering import Voxels, finite, in_box, in_range, radius_inliers, selected, statistical_inliers
from operators.cloud.normals import FEWEST, estimate_normals
from operators.status import counted_status

Corner = tuple[float, float, float]
Step = Callable[[PointCloud], PointCloud]


class CloudFilter(Operator):
    """Keeps the points of a range and a box, thins them by a voxel grid, removes outliers and estimates normals.

    The steps run in that order, each unless its parameter switches it off. A voxel's point is the mean of its points,
    as are its colour, intensity and time; laser rings have no mean and are left out. Normals face the origin of the
    cloud's frame, where the sensor is. Points with NaN or infinite coordinates are dropped and counted.

    Methods: outliers by Rusu et al., "Towards 3D point cloud based object maps", 2008; normals by Hoppe et al.,
    "Surface reconstruction from unorganized points", 1992.
    """

    cloud: In[PointCloud] = In(doc="points in the frame of their sensor")
    filtered: Out[PointCloud] = Out(doc="what is kept")
    status: Out[Diagnostics] = Out(doc="points given, dropped by every step, and kept; a warning where none is left")

    min_range: float = Param(0.0, ge=0, doc="nearest distance from the origin that is kept", unit="m")
    max_range: float = Param(100.0, gt=0, doc="farthest distance from the origin that is kept", unit="m")
    lower: Corner | None = Param(None, doc="smallest x, y, z of the box that is kept; no box if none", unit="m")
    upper: Corner | None = Param(None, doc="largest x, y, z of the box that is kept; no box if none", unit="m")
    voxel: float = Param(0.0, ge=0, tunable=True, doc="side of the voxels; 0 keeps all points", unit="m")
    outlier_neighbours: int = Param(
        0,
        ge=0,
        le=200,
        tunable=True,
        doc="neighbours whose mean distance decides on statistical outliers; 0 removes none",
    )
    outlier_ratio: float = Param(
        2.0, gt=0, tunable=True, doc="standard deviations by which that distance may exceed the cloud's mean"
    )
    radius: float = Param(0.0, ge=0, tunable=True, doc="radius in which a point needs others; 0 removes none", unit="m")
    radius_neighbours: int = Param(3, ge=1, tunable=True, doc="how many others it needs there")
    normal_neighbours: int = Param(0, ge=0, le=200, doc="points that a normal is estimated from; 0 for none")
    normal_radius: float = Param(0.3, gt=0, tunable=True, doc="they lie within this radius", unit="m")
    state: Counts

    def setup(self) -> None:
        """Raises ValueError for a range or box that can hold no point, and for too few neighbours of a normal."""
        if self.min_range >= self.max_range:
            raise ValueError(f"min_range {self.min_range} m must be below max_range {self.max_range} m")
        if (self.lower is None) != (self.upper is None):
            raise ValueError("a box needs both lower and upper")
        if self.lower is not None and self.upper is not None and not np.less(self.lower, self.upper).all():
            raise ValueError(f"the box from {self.lower} to {self.upper} holds no point: lower must be below upper")
        if 0 < self.normal_neighbours < FEWEST:
            raise ValueError(
                f"normal_neighbours is {self.normal_neighbours}: a normal needs {FEWEST} points, 0 is none"
            )

    def process(self, cloud: PointCloud) -> dict[str, Any]:
        dropped: dict[str, int] = {}
        kept = cloud
        for step, done in self._steps().items():
            before, kept = kept.count, done(kept)
            dropped[step] = before - kept.count
        if self.normal_neighbours:
            normals = estimate_normals(
                kept.points.astype(np.float64),
                neighbours=self.normal_neighbours,
                radius=self.normal_radius,
                viewpoint=np.zeros(3),
            )
            kept = kept.replace(normals=normals.astype(np.float32))
        self.state.counts.update({"clouds": 1, "clouds left empty": not kept.count})
        self.state.counts.update({"points": cloud.count, "points kept": kept.count})
        self.state.counts.update({f"dropped, {step}": count for step, count in dropped.items()})
        return {"filtered": kept, "status": _status(cloud, dropped, kept.count)}

    def _steps(self) -> dict[str, Step]:
        """Returns what is done to a cloud, by the name of the step, in order."""

        def keeping(chosen: Callable[[NDArray[np.float32]], NDArray[np.bool_]], *, wanted: bool = True) -> Step:
            def done(cloud: PointCloud) -> PointCloud:
                kept = chosen(cloud.points) if wanted else np.ones(cloud.count, np.bool_)
                return cloud if kept.all() else selected(cloud, kept)

            return done

        box = np.array(self.lower), np.array(self.upper)
        return {
            "not finite": keeping(finite),
            "range": keeping(lambda points: in_range(points, self.min_range, self.max_range)),
            "box": keeping(lambda points: in_box(points, *box), wanted=self.lower is not None),
            "voxel": lambda cloud: _thinned(cloud, self.voxel) if self.voxel and cloud.count else cloud,
            "statistical outlier": keeping(
                lambda points: statistical_inliers(points, self.outlier_neighbours, self.outlier_ratio),
                wanted=self.outlier_neighbours > 0,
            ),
            "radius outlier": keeping(
                lambda points: radius_inliers(points, self.radius, self.radius_neighbours), wanted=self.radius > 0
            ),
        }


def _thinned(cloud: PointCloud, size: float) -> PointCloud:
    """Returns one point per voxel: the mean of what is in it."""
    voxels = Voxels.by_size(cloud.points, size)
    colors = None if cloud.colors is None else np.rint(voxels.means(cloud.colors)).astype(np.uint8)
    intensities = None if cloud.intensities is None else voxels.means(cloud.intensities).astype(np.float32)
    times = None if cloud.time_offsets is None else voxels.means(cloud.time_offsets).astype(np.float32)
    return PointCloud(
        stamp=cloud.stamp,
        frame=cloud.frame,
        points=voxels.means(cloud.points).astype(np.float32),
        colors=colors,
        intensities=intensities,
        time_offsets=times,
    )


def _status(cloud: PointCloud, dropped: Mapping[str, int], kept: int) -> Diagnostics:
    if not cloud.count:
        text = "the cloud is empty"
    elif not kept:
        text = f"none of {cloud.count} points is left; most went by: {max(dropped, key=lambda step: dropped[step])}"
    else:
        text = f"{kept} of {cloud.count} points kept"
    counts = {"points": cloud.count} | {f"dropped, {step}": n for step, n in dropped.items()} | {"kept": kept}
    level = Level.OK if kept else Level.WARN
    return counted_status("cloud_filter", cloud.stamp, text, level, counts)
