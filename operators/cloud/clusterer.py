"""The things in a cloud: clusters with boxes and shapes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Boxes3D, Clusters, Diagnostics, FeatureVector, Odometry, PointCloud, Pose, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import matrix_to_quaternion
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.cloud.clustering import Shape, dbscan, kept, shape_of
from operators.cloud.filtering import Voxels, finite
from operators.cloud.gravity import gravity, told, unit
from operators.cloud.shelf_boards import Points, with_contents
from operators.status import counted_status

FEATURES = "cluster shape: volume (m³), linearity, planarity, sphericity"
"""The model's name on the port `features`."""


class Clusterer(Operator):
    """Divides a cloud into clusters of points that are near each other, and describes each: DBSCAN on its voxels.

    Meant for what a `PlaneSegmenter` leaves. Boxes stand upright on gravity, which comes from `pose` as there. With
    `core_points` 1 the clustering is Euclidean. Things in furniture touch it: a large cluster that lies mostly in level
    and upright surfaces at right angles, with a board among them, is divided into that and what stands on its boards.
    Equal input gives clusters in the same order; their numbers are no identity over time.

    Method: Ester et al., "A density-based algorithm for discovering clusters", 1996; shapes from eigenvalues as in West
    et al., "Context-driven automated target detection in 3D data", 2004.
    """

    cloud: In[PointCloud] = In(doc="points in the frame of their sensor")
    pose: Sampled[Pose | Odometry] = Sampled(required=False, doc="the sensor or its robot in a frame whose z is up")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the cloud's frame and that of the pose, where they differ"
    )
    clusters: Out[Clusters] = Out(doc="the cluster of every point of the cloud, with centroids and bounds")
    boxes: Out[Boxes3D] = Out(doc="an upright box around each cluster, in the same order, with its number of points")
    features: Out[FeatureVector] = Out(
        doc="volume of the convex hull in m³, linearity, planarity and sphericity of each cluster, in the same order"
    )
    status: Out[Diagnostics] = Out(
        doc="clusters, points in them, points in none; a warning for an empty cloud, and a pose that is not finite"
    )

    up: tuple[float, float, float] = Param((0.0, 0.0, 1.0), doc="direction up in the cloud's frame where no pose comes")
    voxel: float = Param(0.02, gt=0.001, doc="side of the voxels that are clustered", unit="m")
    reach: float = Param(0.04, gt=0, tunable=True, doc="points so near are neighbours", unit="m")
    reach_growth: float = Param(
        0.02, ge=0, tunable=True, doc="and this times their distance from the sensor, as points lie farther apart there"
    )
    core_points: int = Param(5, ge=1, tunable=True, doc="points within reach that make a core point, its own included")
    min_points: int = Param(30, ge=1, tunable=True, doc="fewest points of a cluster")
    max_points: int = Param(1_000_000, ge=1, tunable=True, doc="most points of a cluster")
    board: float = Param(
        0.25, gt=0, tunable=True, doc="least length of a board of furniture; infinite keeps furniture whole", unit="m"
    )
    state: Counts

    def setup(self) -> None:
        """Raises ValueError for an up of length 0."""
        self._up = unit(self.up)

    def process(
        self, cloud: PointCloud, pose: Pose | Odometry | None = None, extrinsics: Transforms | None = None
    ) -> dict[str, Any]:
        """Raises ValueError where no transform relates the cloud's frame to that of the pose."""
        up, _ = gravity(cloud, pose, extrinsics, self._up)
        usable = np.flatnonzero(finite(cloud.points))
        points = cloud.points[usable].astype(np.float64)
        labels = np.full(cloud.count, -1, np.int32)
        labels[usable] = self._labels(cloud.points[usable], up)
        own = labels[usable]
        shapes = [shape_of(points[own == k], up) for k in range(int(labels.max(initial=-1)) + 1)]
        sizes = np.bincount(labels[labels >= 0], minlength=len(shapes)).astype(np.int64)
        counts = {
            "points": cloud.count,
            "not finite": cloud.count - len(usable),
            "clusters": len(shapes),
            "points in clusters": int(sizes.sum()),
            "points in none": len(usable) - int(sizes.sum()),
        }
        lost = pose is not None and not told(pose)
        self.state.counts.update(
            counts | {"clouds": 1, "clouds without clusters": not shapes, "poses not finite": lost}
        )
        return {
            "clusters": _clusters(labels, shapes),
            "boxes": _boxes(sizes, shapes),
            "features": _features(cloud, shapes),
            "status": _status(cloud.stamp, counts, lost),
        }

    def _labels(self, points: NDArray[np.float32], up: NDArray[np.float64]) -> NDArray[np.int32]:
        """Returns the cluster (N,) of each point, -1 for none."""
        if not len(points):
            return np.zeros(0, np.int32)
        voxels = Voxels.by_size(points, self.voxel)
        means = voxels.means(points)
        reach = self.reach + self.reach_growth * np.linalg.norm(means, axis=1)
        of_voxel = dbscan(means, reach, self.core_points, voxels.counts)
        of_voxel = with_contents(
            of_voxel, Points(means, voxels.counts, reach), up, self.core_points, self.min_points, self.board
        )
        labels = of_voxel[voxels.of]
        sizes = np.bincount(labels[labels >= 0], minlength=int(labels.max(initial=-1)) + 1).astype(np.int64)
        return kept(labels, sizes, self.min_points, self.max_points)


def _clusters(labels: NDArray[np.int32], shapes: list[Shape]) -> Clusters:
    return Clusters(
        labels=labels,
        centroids=_rows([s.centroid for s in shapes], 3),
        lower=_rows([s.lower for s in shapes], 3),
        upper=_rows([s.upper for s in shapes], 3),
    )


def _boxes(sizes: NDArray[np.int64], shapes: list[Shape]) -> Boxes3D:
    return Boxes3D(
        class_names=("cluster",),
        centers=_rows([s.T[:3, 3] for s in shapes], 3),
        sizes=_rows([s.size for s in shapes], 3),
        orientations=matrix_to_quaternion(np.array([s.T for s in shapes]).reshape(-1, 4, 4)),
        scores=np.ones(len(shapes), np.float32),
        class_ids=np.zeros(len(shapes), np.int32),
        point_counts=sizes,
    )


def _features(cloud: PointCloud, shapes: list[Shape]) -> FeatureVector:
    return FeatureVector(
        stamp=cloud.stamp,
        frame=cloud.frame,
        model=FEATURES,
        vectors=_rows([[s.volume, s.linearity, s.planarity, s.sphericity] for s in shapes], 4).astype(np.float32),
        ids=np.arange(len(shapes), dtype=np.int64),
    )


def _rows(rows: list[Any], width: int) -> NDArray[np.float64]:
    return np.array(rows, np.float64).reshape(-1, width)


def _status(stamp: int, counts: Mapping[str, int], lost: bool) -> Diagnostics:
    usable = counts["points"] - counts["not finite"]
    text = f"{counts['clusters']} clusters of {counts['points in clusters']} points; {counts['points in none']} in none"
    if not usable:
        text = "the cloud has no finite point" if counts["points"] else "the cloud is empty"
    text += "; the pose is not finite, so up is the parameter's" if lost else ""
    return counted_status("clusterer", stamp, text, Level.WARN if lost or not usable else Level.OK, counts)
