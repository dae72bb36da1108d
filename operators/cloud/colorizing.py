"""Points seen by a camera: their pixels, and which of them something nearer hides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points

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
