"""Pinhole cameras: the rays of their pixels, where points fall in their images, and what they see."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from operators.simulator.shapes import Array

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]


@dataclass(frozen=True)
class Optics:
    """A pinhole camera: size in pixels, focal length and principal point in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def columns(self) -> Array:
        """x / z (W,) of every column."""
        return np.asarray((np.arange(self.width) - self.cx) / self.fx, np.float64)

    def rows(self) -> Array:
        """y / z (H,) of every row."""
        return np.asarray((np.arange(self.height) - self.cy) / self.fy, np.float64)


@lru_cache(maxsize=8)
def inverse_lengths(optics: Optics) -> F32:
    """(H, W) of the directions with z = 1."""
    x, y = optics.columns(), optics.rows()
    return np.asarray(1 / np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2), np.float32)


def camera_rays(T_world_camera: Array, optics: Optics) -> F32:
    """Origin and direction (H, W, 6) of every pixel in the world; z = 1 in the camera, so distances are depths."""
    rays = np.empty((optics.height, optics.width, 6), np.float32)
    rays[..., :3] = T_world_camera[:3, 3]
    x, y = optics.columns(), optics.rows()
    for axis in range(3):
        a, b, c = T_world_camera[axis, :3]
        np.add((a * x).astype(np.float32)[None], (b * y + c).astype(np.float32)[:, None], out=rays[..., 3 + axis])
    return rays


@dataclass(frozen=True, eq=False)
class View:
    """View of a camera, without noise.

    `depth` (H, W) metres along z, infinite where nothing is hit; `cosine` (H, W) of the angle between ray and surface
    normal; `triangle` (H, W) index of what is hit; `instances` and `classes` (H, W), 0 and `VOID` where nothing is
    hit; `color` (H, W, 3) RGB 0 to 255 and beyond, or None where it was not asked for.
    """

    depth: F32
    cosine: F32
    triangle: I32
    instances: NDArray[np.uint16]
    classes: NDArray[np.uint8]
    color: F32 | None


def rectangle(points: Array, optics: Optics, margin: float) -> tuple[int, int, int, int] | None:
    """(left, top, right, bottom) in pixels around points (N, 3) in the camera's frame, or None where none is seen.

    It is cut at `margin` image sizes outside the image.
    """
    z = points[:, 2]
    near = 0.05
    if z.max() <= near:
        return None
    w, h = optics.width, optics.height
    low_u, low_v, high_u, high_v = -margin * w, -margin * h, (1 + margin) * w, (1 + margin) * h
    if z.min() > near:
        u, v = points[:, 0] / z * optics.fx + optics.cx, points[:, 1] / z * optics.fy + optics.cy
        low_u, high_u = max(low_u, float(u.min()) - 1), min(high_u, float(u.max()) + 2)
        low_v, high_v = max(low_v, float(v.min()) - 1), min(high_v, float(v.max()) + 2)
    left, top, right, bottom = int(np.floor(low_u)), int(np.floor(low_v)), int(np.ceil(high_u)), int(np.ceil(high_v))
    return (left, top, right, bottom) if left < right and top < bottom else None
