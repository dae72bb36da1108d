"""The RGB-D camera's geometry: two pinhole cameras and the motion between them; no registered images."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.geometry.pinhole import Pixels, Points, project, unproject
from operators.geometry.se3 import Matrix


@dataclass(frozen=True, eq=False)
class RgbdCamera:
    """Undistorted; K_color and K_depth (3, 3) in pixels of each image, T_depth_color (4, 4) in metres."""

    K_color: Matrix
    K_depth: Matrix
    T_depth_color: Matrix = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        for name, shape in (("K_color", (3, 3)), ("K_depth", (3, 3)), ("T_depth_color", (4, 4))):
            value = np.array(getattr(self, name), np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"RgbdCamera.{name} must be a finite {shape} matrix, got shape {value.shape}")
            object.__setattr__(self, name, value)
        for name in ("K_color", "K_depth"):
            K = getattr(self, name)
            if K[0, 0] <= 0 or K[1, 1] <= 0:
                raise ValueError(f"RgbdCamera.{name} must have positive focal lengths, got {K[0, 0]} and {K[1, 1]}")
        R = self.T_depth_color[:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
            raise ValueError("RgbdCamera.T_depth_color must be a rigid motion: its rotation block is not a rotation")
        object.__setattr__(self, "T_color_depth", invert(self.T_depth_color))

    T_color_depth: Matrix = field(init=False)

    def check_same(self, other: "RgbdCamera") -> None:
        """Raises ValueError unless another has the same geometry: views are comparable only within one calibration."""
        for name in ("K_color", "K_depth", "T_depth_color"):
            if not np.array_equal(getattr(self, name), getattr(other, name)):
                raise ValueError(f"the calibration changed ({name} is another): one camera, one calibration")

    def depth_at(
        self, pixels_color: Pixels, depth: NDArray[np.float32], near: float, far: float
    ) -> tuple[Points, NDArray[np.bool_]]:
        """Intersect the rays of colour pixels (N, 2) with the depth image.

        Returns the points (N, 3) in the depth camera's frame and which of them are known. A ray's depth is
        found by fixed point: project its point into the depth image, read the depth there, move the point to
        it. A pixel beside a depth edge is unknown, for which side it saw is a coin's toss.
        """
        K, (height, width) = self.K_depth, depth.shape
        rays = unproject(pixels_color, self.K_color) @ self.T_depth_color[:3, :3].T
        origin = self.T_depth_color[:3, 3]
        centred = not origin.any()
        z = np.full(len(rays), 2.0)
        for _ in range(1 if centred else 4):
            uv = project(origin + rays * (z / rays[:, 2])[:, None], K)
            u, v = np.rint(uv).astype(np.int64).T
            inside = (u >= 1) & (v >= 1) & (u < width - 1) & (v < height - 1)
            u, v = np.where(inside, u, 1), np.where(inside, v, 1)
            seen = depth[v, u]
            known = inside & (seen >= near) & (seen <= far)
            settled = known & (np.abs(seen - z) < 0.03 * z)
            z = np.where(known, seen - origin[2], z).astype(np.float64)
        around = np.stack([depth[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
        around = np.where((around >= near) & (around <= far), around, np.nan)
        known &= (np.isfinite(around).sum(axis=0) >= 6) & (centred | settled)
        ranked = np.sort(np.where(known, around, 1.0), axis=0)  # what is no depth comes last
        count, column = np.isfinite(ranked).sum(axis=0), np.arange(len(known))
        low, high = ranked[0], ranked[count - 1, column]
        known &= high - low < 0.04 * low + 0.01
        median = (ranked[(count - 1) // 2, column] + ranked[count // 2, column]) / 2
        z = median - origin[2]
        return origin + rays * (z / rays[:, 2])[:, None], known
