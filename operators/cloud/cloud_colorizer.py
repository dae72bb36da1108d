"""LiDAR points with the colours and classes that a camera sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, Clusters, Diagnostics, Image, Message, PointCloud, SegmentationMap, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import transform_points
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.cloud.filtering import selected
from operators.geometry.calibration import check_calibration
from operators.geometry.extrinsics import transform_between
from operators.status import counted_status

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sight:
    """Pixels (N,) of points as rows * width + columns, and which points (N,) the camera sees.

    `behind`, `outside` and `hidden` count the others: behind the camera or not finite, beyond the image, and behind
    something nearer.
    """

    pixels: NDArray[np.intp]
    seen: NDArray[np.bool_]
    behind: int
    outside: int
    hidden: int


def sight(
    points: NDArray[np.float32], T_camera_points: Array, K: Array, size: tuple[int, int], cell: int, slack: float
) -> Sight:
    """Projects points (N, 3) into a pinhole camera with an image of `size` (width, height).

    A point is hidden where another in its square of `cell` pixels, or in one of the eight around that, lies nearer by
    more than `slack` as a share of its depth: a LiDAR beside the camera looks past edges that the camera does not. 0
    hides nothing.
    """
    width, height = size
    finite = np.asarray(np.isfinite(points).all(axis=1))
    x, y, z = transform_points(T_camera_points, np.where(finite[:, None], points, 0).astype(np.float64)).T
    ahead = finite & (z > 1e-3)
    depth = np.where(ahead, z, 1.0)
    u = np.rint(np.clip(x / depth * K[0, 0] + K[0, 2], -1e6, 1e6)).astype(np.intp)
    v = np.rint(np.clip(y / depth * K[1, 1] + K[1, 2], -1e6, 1e6)).astype(np.intp)
    inside = ahead & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    hidden = np.zeros(len(points), np.bool_)
    if slack > 0 and inside.any():
        rows, columns = v[inside] // cell + 1, u[inside] // cell + 1
        nearest = np.full((height // cell + 3, width // cell + 3), np.inf)
        np.minimum.at(nearest, (rows, columns), z[inside])
        around = np.full_like(nearest, np.inf)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                around = np.minimum(around, np.roll(nearest, (down, right), (0, 1)))
        hidden[inside] = z[inside] > (1 + slack) * around[rows, columns]
    seen = inside & ~hidden
    pixels = np.where(seen, v * width + u, 0)
    return Sight(pixels, seen, int((~ahead).sum()), int((ahead & ~inside).sum()), int(hidden.sum()))


class CloudColorizer(Operator):
    """Colours the points of a cloud, and labels them with the classes of their pixels, through a calibrated camera.

    Points that the camera does not see are black and have no class, or are left out. The image must be free of lens
    distortion. The points are taken as measured at the image's stamp: a moving LiDAR's cloud should be deskewed.
    Occlusion is by a depth buffer, as in Katz et al., "Direct visibility of point sets", 2007, in its simplest form.
    """

    cloud: In[PointCloud] = In(doc="points in the frame of their sensor")
    image: In[Image] = In(doc="colour or grey")
    image_info: Sampled[CameraInfo] = Sampled(doc="calibration of the camera")
    extrinsics: Sampled[Transforms] = Sampled(doc="holds the transform between the cloud's frame and the camera's")
    classes: Sampled[SegmentationMap] = Sampled(
        required=False, max_age="100ms", doc="class of every pixel of the image; without, nothing is labelled"
    )
    colored: Out[PointCloud] = Out(doc="the points with colours; the other fields as they came")
    labels: Out[Clusters] = Out(
        doc="the class of every point of `colored`: clusters are the classes, `ids` their numbers; -1 is unseen or void"
    )
    status: Out[Diagnostics] = Out(doc="points seen, hidden, outside the image, behind; a warning where none is seen")

    seen_only: bool = Param(False, tunable=True, doc="leave out the points that the camera does not see")
    cell: int = Param(
        6, ge=1, tunable=True, doc="side of the squares in which the nearest point is looked for", unit="px"
    )
    slack: float = Param(
        0.1, ge=0, tunable=True, doc="share of depth behind the nearest that still counts as seen; 0: all"
    )
    state: Counts

    def process(
        self,
        cloud: PointCloud,
        image: Image,
        image_info: CameraInfo,
        extrinsics: Transforms,
        classes: SegmentationMap | None = None,
    ) -> dict[str, Message]:
        """Raises ValueError where image, classes and calibration do not fit, or no transform does."""
        check_calibration("image", image, image_info)
        if classes is not None and classes.classes.shape != image.data.shape[:2]:
            raise ValueError(f"classes have {classes.classes.shape} pixels, but the image {image.data.shape[:2]}")
        T = transform_between(extrinsics, cloud.frame, image.frame)
        size = (image.width, image.height)
        seen = sight(cloud.points, T, image_info.K, size, self.cell, self.slack)
        colors = image.data.reshape(size[0] * size[1], -1)[seen.pixels]
        colors = np.repeat(colors, 3, axis=1) if colors.shape[1] == 1 else colors
        colors[~seen.seen] = 0
        kept = seen.seen if self.seen_only else np.ones(cloud.count, np.bool_)
        colored = cloud.replace(colors=colors)
        colored = selected(colored, kept) if self.seen_only else colored
        counts = {"points": cloud.count, "seen": int(seen.seen.sum()), "hidden": seen.hidden,
                  "outside the image": seen.outside, "behind or not finite": seen.behind}  # fmt: skip
        self.state.counts.update(counts | {"clouds": 1, "clouds of which nothing is seen": not counts["seen"]})
        messages: dict[str, Message] = {"colored": colored, "status": _status(cloud.stamp, counts)}
        if classes is not None:
            messages["labels"] = _labels(colored, classes, seen, kept)
        return messages


def _labels(colored: PointCloud, classes: SegmentationMap, seen: Sight, kept: NDArray[np.bool_]) -> Clusters:
    own = classes.classes.ravel()[seen.pixels].astype(np.int64)
    known = seen.seen if classes.void is None else seen.seen & (own != classes.void)
    own, known = own[kept], known[kept]
    ids = np.unique(own[known])
    labels = np.full(len(own), -1, np.int32)
    labels[known] = np.searchsorted(ids, own[known])
    points = colored.points.astype(np.float64)
    empty = np.zeros((0, 3))
    members = [points[labels == k] for k in range(len(ids))]
    return Clusters(
        labels=labels,
        centroids=np.array([m.mean(axis=0) for m in members]) if members else empty,
        lower=np.array([m.min(axis=0) for m in members]) if members else empty,
        upper=np.array([m.max(axis=0) for m in members]) if members else empty,
        ids=ids,
    )


def _status(stamp: int, counts: Mapping[str, int]) -> Diagnostics:
    text = f"{counts['seen']} of {counts['points']} points are seen"
    if not counts["points"]:
        text = "the cloud is empty"
    return counted_status("cloud_colorizer", stamp, text, Level.OK if counts["seen"] else Level.WARN, counts)
