"""Objects of an image in space, as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import (
    Boxes3D,
    CameraInfo,
    Clusters,
    Detections2D,
    Diagnostics,
    Odometry,
    PointCloud,
    Pose,
    SegmentationMap,
    Tracks,
    Transforms,
)
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import matrix_to_quaternion, transform_points
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.cloud.filtering import in_range
from operators.cloud.gravity import gravity, unit
from operators.geometry.extrinsics import transform_between
from operators.geometry.pinhole import project
from operators.labels import LabelSpace, labels_file
from operators.scene.lifting.frustums import Lifted, LiftSettings, ProjectedCloud, lift
from operators.status import counted_status

_MOST_GRAIN = 4.0  # pixels


class ObjectLifter(Operator):
    """Finds the points of a cloud that belong to the boxes of an image and puts upright 3-D boxes around them.

    The cloud may be a depth camera's or a lidar's. The points of a box's frustum are divided into clusters (DBSCAN),
    and that one is the object whose image overlaps the box best; the overlap is part of its score. Where the
    detections have masks, only points on these count; with masks of the same image's classes, only points of the box's
    class. Boxes hold what is seen of an object, not its far side.

    Method: frustums as in Qi et al., "Frustum PointNets for 3D object detection", 2018, with clusters for the network.
    """

    detections: In[Detections2D] = In(
        doc="boxes in the image of a pinhole camera without distortion, and masks, if any"
    )
    cloud: In[PointCloud] = In(doc="points of the same time, in the frame of their sensor")
    image_info: Sampled[CameraInfo] = Sampled(doc="calibration of the image")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the frames of cloud and image, and of the pose's robot"
    )
    segmentation: Sampled[SegmentationMap] = Sampled(
        required=False, doc="class of every pixel of the same image; one of another stamp is not used"
    )
    pose: Sampled[Pose | Odometry] = Sampled(
        required=False, doc="the cloud's sensor or its robot; gives the upward direction"
    )
    tracks: Sampled[Tracks] = Sampled(
        required=False,
        doc="which tracks the detections of the same stamp are of: the ids of boxes and images, -1 for none",
    )
    boxes: Out[Boxes3D] = Out(doc="objects in the cloud's frame, with their numbers of points")
    images: Out[Detections2D] = Out(doc="the image's boxes of the objects, in the order of the boxes")
    clusters: Out[Clusters] = Out(doc="the object of every point of the cloud, in the order of the boxes")
    status: Out[Diagnostics] = Out(doc="detections with and without an object; a warning where all are without")

    min_score: float = Param(0.3, ge=0, le=1, tunable=True, doc="weaker detections are not lifted")
    labels: str = Param("coco", doc="label space: coco, simulator, or a YAML file; gives the roles of classes")
    min_body_score: float = Param(0.2, ge=0, le=1, tunable=True, doc="weaker detections of persons with masks are not")
    min_points: int = Param(8, ge=5, tunable=True, doc="fewest points of an object")
    min_overlap: float = Param(0.3, gt=0, le=1, tunable=True, doc="least IoU of an object's image with its box")
    max_range: float = Param(6.0, gt=0, tunable=True, doc="farther points are not used", unit="m")
    reach: float = Param(0.04, gt=0, doc="points so near are one cluster", unit="m")
    reach_growth: float = Param(0.012, ge=0, doc="share of their distance by which that grows; more for a lidar")
    gap: float = Param(0.3, gt=0, doc="parts of one object are no farther apart", unit="m")
    up: tuple[float, float, float] = Param(
        (0.0, -1.0, 0.0), doc="direction up in the cloud's frame where no pose comes"
    )

    state: Counts

    def setup(self) -> None:
        """Raises ValueError for an up of length 0, FileNotFoundError or ValueError for a bad label space."""
        self._labels = LabelSpace.read(self.use_file(labels_file(self.labels)))
        self._up = unit(self.up)

    def process(
        self,
        detections: Detections2D,
        cloud: PointCloud,
        image_info: CameraInfo,
        extrinsics: Transforms | None = None,
        segmentation: SegmentationMap | None = None,
        pose: Pose | Odometry | None = None,
        tracks: Tracks | None = None,
    ) -> dict[str, Any]:
        """Raises ValueError where the calibration is of another image or no transform relates the frames."""
        _check(detections, image_info)
        if tracks is not None:
            detections = detections.replace(ids=_track_ids(detections, tracks))
        up, _ = gravity(cloud, pose, extrinsics, self._up)
        usable = np.flatnonzero(in_range(cloud.points, 0.0, self.max_range))
        points = cloud.points[usable].astype(np.float64)
        masks = self._masks(detections, segmentation)
        T_image_cloud = transform_between(extrinsics, cloud.frame, detections.frame)
        seen = _seen(points, T_image_cloud, image_info, masks, up)
        names = detections.labels()
        body = np.array([masks is not None and "person" in self._labels.roles(name) for name in names], bool)
        least = np.where(body, np.float32(self.min_body_score), np.float32(self.min_score))
        rows = np.flatnonzero(detections.scores >= least)
        known = {} if masks is None else {name: k for k, name in enumerate(masks.class_names)}
        background = [k for name, k in known.items() if name not in detections.class_names]
        settings = LiftSettings(
            reach=self.reach,
            reach_growth=self.reach_growth,
            gap=self.gap,
            min_points=self.min_points,
            min_overlap=self.min_overlap,
        )
        boxes, bodies = detections.boxes[rows].astype(np.float64), frozenset(np.flatnonzero(body[rows]).tolist())
        classes = [known.get(names[k], -1) for k in rows]
        instances = (
            None if detections.masks is None else [m for k in rows if (m := detections.mask(int(k))) is not None]
        )
        found = lift(seen, boxes, classes, background, settings, bodies, instances)
        labels = np.full(cloud.count, -1, np.int32)
        for number, each in enumerate(found):
            labels[usable[each.points]] = number
        counts = {
            "detections": len(rows),
            "lifted": len(found),
            "without an object": len(rows) - len(found),
            "points": len(usable),
            "masks not used": int(segmentation is not None and masks is None),
        }
        self.state.counts.update(counts | {"images": 1})
        return {
            "boxes": _boxes(cloud, detections, rows, found),
            "images": _images(cloud.stamp, detections, rows, found),
            "clusters": _clusters(cloud, labels, found, points),
            "status": _status(cloud.stamp, counts),
        }

    def _masks(self, detections: Detections2D, segmentation: SegmentationMap | None) -> SegmentationMap | None:
        if segmentation is None or segmentation.stamp != detections.stamp or not segmentation.class_names:
            return None
        size = (segmentation.classes.shape[1], segmentation.classes.shape[0])
        if size != (detections.width, detections.height) or segmentation.frame != detections.frame:
            raise ValueError(
                f"masks of {size[0]}x{size[1]} pixels in {segmentation.frame!r} are not of the detections' image, "
                f"{detections.width}x{detections.height} in {detections.frame!r}"
            )
        return segmentation


def _track_ids(detections: Detections2D, tracks: Tracks) -> NDArray[np.int64]:
    """Returns the track (N,) of each detection, -1 where it is of none or the tracks are of another image."""
    ids = np.full(detections.count, -1, np.int64)
    if tracks.stamp == detections.stamp and tracks.detections is not None:
        matched = tracks.detections >= 0
        ids[tracks.detections[matched]] = tracks.ids[matched]
    return ids


def _check(detections: Detections2D, info: CameraInfo) -> None:
    if (detections.width, detections.height, detections.frame) != (info.width, info.height, info.frame):
        raise ValueError(
            f"detections are of a {detections.width}x{detections.height} image in {detections.frame!r}, but image_info "
            f"describes {info.width}x{info.height} in {info.frame!r}"
        )
    if info.distortion is not None and np.any(info.distortion):
        raise ValueError(f"image_info has lens distortion ({info.distortion_model}); undistort the images first")


def _seen(
    points: NDArray[np.float64], T_image_cloud: Any, info: CameraInfo, masks: SegmentationMap | None, up: Any
) -> ProjectedCloud:
    in_image = transform_points(T_image_cloud, points)
    pixels = project(in_image, info.K)
    u, v = np.ascontiguousarray(pixels.T)
    inside = (u > -0.5) & (v > -0.5) & (u < info.width - 0.5) & (v < info.height - 0.5) & (in_image[:, 2] > 0)
    classes = None
    if masks is not None:
        classes = np.full(len(points), -1, np.int32)
        column, row = np.rint(u[inside]).astype(np.intp), np.rint(v[inside]).astype(np.intp)
        classes[inside] = masks.classes[row, column]
    spacing = np.sqrt(info.width * info.height / max(int(inside.sum()), 1))
    grain = min(0.5 * float(spacing) + (masks is not None), _MOST_GRAIN)
    return ProjectedCloud(points, pixels + 0.5, inside, up, classes, grain)  # boxes count from the image's edge


def _boxes(cloud: PointCloud, detections: Detections2D, rows: NDArray[np.intp], found: list[Lifted]) -> Boxes3D:
    own = rows[[f.detection for f in found]] if found else rows[:0]
    return Boxes3D(
        stamp=cloud.stamp,
        frame=cloud.frame,
        class_names=detections.class_names,
        centers=np.array([f.T[:3, 3] for f in found]).reshape(-1, 3),
        sizes=np.array([f.size for f in found]).reshape(-1, 3),
        orientations=matrix_to_quaternion(np.array([f.T for f in found]).reshape(-1, 4, 4)),
        scores=detections.scores[own] * np.array([np.sqrt(f.overlap) for f in found], np.float32),
        class_ids=detections.class_ids[own],
        ids=None if detections.ids is None else detections.ids[own],
        point_counts=np.array([len(f.points) for f in found], np.int64),
    )


def _images(stamp: int, detections: Detections2D, rows: NDArray[np.intp], found: list[Lifted]) -> Detections2D:
    own = rows[[f.detection for f in found]] if found else rows[:0]
    return Detections2D(
        stamp=stamp,
        frame=detections.frame,
        width=detections.width,
        height=detections.height,
        class_names=detections.class_names,
        boxes=detections.boxes[own],
        scores=detections.scores[own],
        class_ids=detections.class_ids[own],
        ids=None if detections.ids is None else detections.ids[own],
    )


def _clusters(
    cloud: PointCloud, labels: NDArray[np.int32], found: list[Lifted], points: NDArray[np.float64]
) -> Clusters:
    own = [points[f.points] for f in found]
    columns = [np.ascontiguousarray(p.T) for p in own]  # along which extremes are found many times as fast
    return Clusters(
        stamp=cloud.stamp,
        frame=cloud.frame,
        labels=labels,
        centroids=np.array([p.mean(axis=0) for p in own]).reshape(-1, 3),
        lower=np.array([c.min(axis=1) for c in columns]).reshape(-1, 3),
        upper=np.array([c.max(axis=1) for c in columns]).reshape(-1, 3),
    )


def _status(stamp: int, counts: Mapping[str, int]) -> Diagnostics:
    text = f"{counts['lifted']} of {counts['detections']} detections have an object among {counts['points']} points"
    bad = counts["points"] == 0 or (counts["detections"] > 0 and counts["lifted"] == 0)
    return counted_status("object_lifter", stamp, text, Level.WARN if bad else Level.OK, counts)
