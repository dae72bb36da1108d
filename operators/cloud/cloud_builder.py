"""Depth images as coloured point clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, DepthImage, Image, PointCloud, Transforms
from dataflow.messages.geometry import invert
from dataflow.operator import In, Operator, Out, Param, Sampled
from operators.cloud.back_projection import Rays, beside_edge, sample_colors, within_range


class CloudBuilder(Operator):
    """Back-projects a depth image into a coloured point cloud in the depth camera's optical frame.

    The images need not be registered: each point is projected into the colour camera. Without `extrinsics` the two
    cameras are taken to coincide. Points that the colour camera does not see are black. Both cameras are pinholes:
    lens distortion must have been removed.
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

    stride: int = Param(2, ge=1, live=True, doc="keep every stride-th pixel in both directions")
    min_range: float = Param(0.3, ge=0, live=True, doc="nearest depth kept", unit="m")
    max_range: float = Param(6.0, gt=0, live=True, doc="farthest depth kept", unit="m")
    edge_ratio: float = Param(
        0.05,
        ge=0,
        live=True,
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
    ) -> PointCloud:
        """Raises ValueError where an image has not the size or frame of its calibration, or no transform fits."""
        _check("depth", depth, depth_info)
        _check("image", image, image_info)
        usable = within_range(depth.data, self.stride, self.min_range, self.max_range)
        if self.edge_ratio:
            usable &= ~beside_edge(depth.data, self.stride, self.edge_ratio)
        points = self._rays_of(depth_info).back_project(depth.data, usable)
        T_image_depth = transform_between(extrinsics, depth.frame, image.frame)
        colors, _ = sample_colors(points, image.data, image_info.K, T_image_depth)
        return PointCloud(stamp=depth.stamp, frame=depth.frame, points=points, colors=colors)

    def _rays_of(self, info: CameraInfo) -> Rays:
        """The ray table, made once for each calibration and stride."""
        if self._rays is not None:
            known, rays = self._rays
            if rays.stride == self.stride and (known is info or known == info):
                return rays
        rays = Rays.through(info.K, (info.width, info.height), self.stride)
        self._rays = info, rays
        return rays


def transform_between(extrinsics: Transforms | None, depth_frame: str, image_frame: str) -> NDArray[np.float64]:
    """`T_image_depth` (4, 4): the identity where the frames are one or no extrinsics are given.

    Raises ValueError where the extrinsics do not relate the two.
    """
    if extrinsics is None or depth_frame == image_frame:
        return np.eye(4)
    known = list(zip(extrinsics.frames, extrinsics.child_frames, strict=True))
    if (image_frame, depth_frame) in known:
        T_image_depth: NDArray[np.float64] = extrinsics.matrices()[known.index((image_frame, depth_frame))]
        return T_image_depth
    if (depth_frame, image_frame) in known:
        return invert(extrinsics.matrices()[known.index((depth_frame, image_frame))])
    listed = ", ".join(f"{child} in {parent}" for parent, child in known) or "none"
    raise ValueError(f"extrinsics hold no transform between {depth_frame!r} and {image_frame!r}; they hold {listed}")


def _check(port: str, image: DepthImage | Image, info: CameraInfo) -> None:
    if (image.width, image.height) != (info.width, info.height):
        raise ValueError(
            f"{port} has {image.width}x{image.height} pixels, but {port}_info describes {info.width}x{info.height}"
        )
    if image.frame != info.frame:
        raise ValueError(f"{port} is in frame {image.frame!r}, but {port}_info in {info.frame!r}")
    if info.distortion is not None and np.any(info.distortion):
        raise ValueError(f"{port}_info has lens distortion ({info.distortion_model}); undistort the images first")
