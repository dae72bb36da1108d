"""Depth pixels to 3-D points, and the colours a second camera sees them in. Pinhole cameras, float32 throughout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
