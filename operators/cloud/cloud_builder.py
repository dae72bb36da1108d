"""Depth images as coloured point clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, Message, PointCloud, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.operator import In, Operator, Out, Param, Sampled
from operators.geometry.calibration import check_calibration, told_again
from operators.geometry.extrinsics import transform_between
from operators.status import counted_status

Depth = NDArray[np.float32]
Points = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays with z = 1 through every stride-th pixel of a depth camera: directions (rows, columns, 2) float32."""

    directions: NDArray[np.float32]
    stride: int

    @classmethod
    def through(cls, K: NDArray[np.float64], size: tuple[int, int], stride: int) -> Rays:
        """`K` (3, 3) in pixels, `size` (width, height). Pixel centres have whole coordinates."""
        u, v = np.arange(0, size[0], stride), np.arange(0, size[1], stride)
        x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
        return cls(np.ascontiguousarray(grid, np.float32), stride)

    def back_project(self, depth: Depth, usable: NDArray[np.bool_]) -> Points:
        """Points (N, 3), row by row, of a depth image (H, W) in metres at the strided pixels that are usable."""
        where = np.flatnonzero(usable)
        z = depth[:: self.stride, :: self.stride].ravel()[where]
        points = np.empty((z.size, 3), np.float32)
        np.multiply(self.directions.reshape(-1, 2)[where], z[:, None], out=points[:, :2])
        points[:, 2] = z
        return points


def within_range(depth: Depth, stride: int, near: float, far: float) -> NDArray[np.bool_]:
    """Returns which strided pixels have a depth in [near, far]; 0 and NaN never do."""
    z = depth[::stride, ::stride]
    usable: NDArray[np.bool_] = (z >= np.float32(near)) & (z <= np.float32(far)) & (z > 0)
    return usable


def beside_edge(depth: Depth, stride: int, ratio: float) -> NDArray[np.bool_]:
    """Returns which strided pixels differ from a direct neighbour with a return by over `ratio` of the nearer depth.

    Such pixels mix foreground and background and fly between both. Neighbours are those of the full image.
    """
    height, width = depth.shape
    rows, columns = np.arange(0, height, stride), np.arange(0, width, stride)
    if np.isinf(depth).any():  # as some cameras say that there was no return
        depth = np.where(np.isinf(depth), np.float32(0), depth)
    z = depth[::stride, ::stride]
    edge = np.zeros(z.shape, np.bool_)
    for dv, du in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        neighbour_rows = np.clip(rows + dv, 0, height - 1)
        neighbour_columns = np.clip(columns + du, 0, width - 1)
        other = depth[neighbour_rows][:, neighbour_columns]
        edge |= (other > 0) & (np.abs(other - z) > np.float32(ratio) * np.minimum(other, z))
    return edge


def sample_colors(
    points: Points, image: NDArray[np.uint8], K: NDArray[np.float64], T_camera_points: NDArray[np.float64]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The nearest pixel of `image` (H, W, 3) or (H, W) for each point (N, 3), and which points it can see.

    `K` is the image's, `T_camera_points` (4, 4) maps the points into its frame. Points outside the image are black.
    Occlusion between the two viewpoints is not tested: it is a matter of a few pixels for the baseline of one device.
    """
    if not np.array_equal(T_camera_points, np.eye(4)):
        points = _transform(T_camera_points.astype(np.float32), points)
    height, width = image.shape[:2]
    x, y, z = points.T
    ahead = z > 0
    safe = np.where(ahead, z, np.float32(1))
    u = np.rint(x / safe * np.float32(K[0, 0]) + np.float32(K[0, 2]))
    v = np.rint(y / safe * np.float32(K[1, 1]) + np.float32(K[1, 2]))
    seen = ahead & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    pixel = np.where(seen, v, 0).astype(np.int32) * width + np.where(seen, u, 0).astype(np.int32)
    colors = image.reshape(height * width, -1)[pixel]
    colors = colors if colors.shape[1] == 3 else np.repeat(colors, 3, axis=1)
    colors[~seen] = 0
    return colors, seen


def _transform(T: NDArray[np.float32], points: Points) -> Points:
    """Written out, because a BLAS product of three terms may round differently with its number of threads."""
    x, y, z = points.T
    return np.stack([T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3] for i in range(3)], axis=1)


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
