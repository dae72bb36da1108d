"""Depth images as coloured point clouds."""

from __future__ import annotations

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, Message, PointCloud, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.operator import In, Operator, Out, Param, Sampled
from operators.cloud.back_projection import Rays, beside_edge, sample_colors, within_range
from operators.geometry.calibration import check_calibration, told_again
from operators.geometry.extrinsics import transform_between
from operators.status import counted_status


class CloudBuilder(Operator):
    """Back-projects a depth image into a coloured point cloud in the depth camera's optical frame.

    The images need not be registered: each point is projected into the colour camera. Without `extrinsics` the two
    cameras are taken to coincide. Points that the colour camera does not see are black. Both cameras are pinholes:
    lens distortion must have been removed.

    Method: the pinhole camera and its inverse, Hartley and Zisserman, "Multiple view geometry", 2004, chapter 6.
    """

    stateless = True

    depth: In[DepthImage] = In(doc="depth, metres")
    image: In[Image] = In(doc="colour or grey, of the same stamp")
    depth_info: Sampled[CameraInfo] = Sampled(doc="calibration of the depth camera")
    image_info: Sampled[CameraInfo] = Sampled(doc="calibration of the colour camera")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the two cameras' frames, in either direction"
    )
    cloud: Out[PointCloud] = Out(doc="points with colours, row by row")
    status: Out[Diagnostics] = Out(
        doc="pixels, points, points that the colour camera sees; a warning where there is none"
    )

    stride: int = Param(2, ge=1, tunable=True, doc="keep every stride-th pixel in both directions")
    min_range: float = Param(0.3, ge=0, tunable=True, doc="nearest depth kept", unit="m")
    max_range: float = Param(6.0, gt=0, tunable=True, doc="farthest depth kept", unit="m")
    edge_ratio: float = Param(
        0.05,
        ge=0,
        tunable=True,
        doc="drop pixels whose depth differs from a neighbour's by more than this share: they fly between foreground "
        "and background; 0 keeps them",
    )

    _rays: tuple[CameraInfo, Rays] | None = None

    def process(
        self,
        depth: DepthImage,
        image: Image,
        depth_info: CameraInfo,
        image_info: CameraInfo,
        extrinsics: Transforms | None = None,
    ) -> dict[str, Message]:
        """Raises ValueError where an image has not the size or frame of its calibration, or no transform fits."""
        check_calibration("depth", depth, depth_info)
        check_calibration("image", image, image_info)
        usable = within_range(depth.data, self.stride, self.min_range, self.max_range)
        if self.edge_ratio:
            usable &= ~beside_edge(depth.data, self.stride, self.edge_ratio)
        points = self._rays_of(depth_info).back_project(depth.data, usable)
        T_image_depth = transform_between(extrinsics, depth.frame, image.frame)
        colors, seen = sample_colors(points, image.data, image_info.K, T_image_depth)
        return {
            "cloud": PointCloud(stamp=depth.stamp, frame=depth.frame, points=points, colors=colors),
            "status": _status(depth.stamp, usable.size, len(points), int(np.count_nonzero(seen))),
        }

    def _rays_of(self, info: CameraInfo) -> Rays:
        """The ray table, made once for each calibration and stride."""
        if self._rays is not None:
            known, rays = self._rays
            if rays.stride == self.stride and told_again(known, info):
                return rays
        rays = Rays.through(info.K, (info.width, info.height), self.stride)
        self._rays = info, rays
        return rays


def _status(stamp: int, pixels: int, points: int, seen: int) -> Diagnostics:
    text, level = f"{points} points of {pixels} pixels", Level.OK
    if not points:
        text, level = "no depth in range", Level.WARN
    elif not seen:
        text, level = f"{text}; the colour camera sees none of them", Level.WARN
    return counted_status("cloud_builder", stamp, text, level, {"pixels": pixels, "points": points, "seen": seen})
