"""Images of calibration boards through a lens, by a projection that is none of OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from operators.calibration.boards import Board, Charuco

Array = NDArray[np.float64]
PER_SQUARE = 80
"""Pixels of a square of the texture."""
MARGIN = 1
"""Squares of white around a board."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels and Brown's coefficients k1, k2, p1, p2, k3; `fisheye` takes the first four as Kannala's and
    Brandt's."""

    width: int = 480
    height: int = 360
    fx: float = 420.0
    fy: float = 424.0
    cx: float = 247.3
    cy: float = 172.8
    bend: tuple[float, ...] = (-0.21, 0.06, 0.0011, -0.0007, 0.0)
    fisheye: bool = False

    @property
    def K(self) -> Array:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def bent(self, rays: Array) -> Array:
        """Distorted coordinates (N, 2) of ideal ones (x / z, y / z)."""
        x, y = rays.T
        if self.fisheye:
            r = np.hypot(x, y)
            angle = np.arctan(r)
            powers = angle[:, None] ** np.array([3, 5, 7, 9])
            scale = (angle + powers @ np.array(self.bend[:4])) / np.maximum(r, 1e-12)
            return np.where(r[:, None] < 1e-12, rays, rays * scale[:, None])
        k1, k2, p1, p2, k3 = self.bend
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.column_stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        )

    def project(self, points: Array) -> Array:
        """Pixels (N, 2) of points (N, 3) in the camera's frame."""
        return self.bent(points[:, :2] / points[:, 2:]) * [self.fx, self.fy] + [self.cx, self.cy]

    def rays(self, pixels: Array) -> Array:
        """Ideal coordinates (N, 2) of pixels, by repeated substitution."""
        aim = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        found = aim.copy()
        for _ in range(12):
            found += aim - self.bent(found)
        return found


def turned(x: float, y: float, z: float) -> Array:
    """Rotation (3, 3) about x, then y, then z, radians."""
    (sx, sy, sz), (cx, cy, cz) = np.sin([x, y, z]), np.cos([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]]) @ about_y @ about_x


def pose(board: Board, rotation: Array, middle: tuple[float, float, float]) -> Array:
    """T_camera_board (4, 4) that puts the board's middle at a place in the camera's frame, metres."""
    T_camera_board = np.eye(4)
    T_camera_board[:3, :3] = rotation
    T_camera_board[:3, 3] = np.array(middle) - rotation @ board.points.mean(axis=0)
    return T_camera_board


def seen(board: Board, T_camera_board: Array) -> Array:
    """The corners (N, 3) of a board in the camera's frame."""
    return board.points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]


def texture(board: Board) -> NDArray[np.uint8]:
    """The board from above, `PER_SQUARE` pixels a square, with a white margin."""
    wide, high = board.columns + 1, board.rows + 1
    if isinstance(board, Charuco):
        plain = board.drawn().generateImage((wide * PER_SQUARE, high * PER_SQUARE), marginSize=0)
    else:
        y, x = np.mgrid[:high, :wide]
        plain = np.kron(np.where((x + y) % 2 == 0, 0, 255), np.ones((PER_SQUARE, PER_SQUARE))).astype(np.uint8)
    return np.pad(np.asarray(plain), MARGIN * PER_SQUARE, constant_values=255)


@lru_cache(maxsize=4)
def _image_rays(lens: Lens, over: int) -> Array:
    offsets = (np.arange(over) + 0.5) / over - 0.5
    u, v = np.meshgrid(
        (np.arange(lens.width)[:, None] + offsets).ravel(), (np.arange(lens.height)[:, None] + offsets).ravel()
    )
    return lens.rays(np.column_stack([u.ravel(), v.ravel()]))


def picture(
    board: Board, drawn: NDArray[np.uint8], lens: Lens, T_camera_board: Array, over: int = 2
) -> NDArray[np.uint8]:
    """Grey image (H, W) of a board, each pixel the mean of `over` by `over` rays; grey behind it, and noise."""
    rays = _image_rays(lens, over)
    R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
    directions = np.column_stack([rays, np.ones(len(rays))]) @ R  # in the board's frame
    origin = -R.T @ t
    places = origin[:2] - directions[:, :2] * (origin[2] / directions[:, 2])[:, None]
    cells = np.floor((places / board.square + 1 + MARGIN) * PER_SQUARE)
    inside = ((cells >= 0) & (cells < np.array(drawn.shape)[::-1])).all(axis=1)
    values = np.full(len(rays), 120.0)
    column, row = cells[inside].astype(int).T
    values[inside] = 30 + drawn[row, column] * (190 / 255)
    mean = values.reshape(lens.height, over, lens.width, over).mean(axis=(1, 3))
    noise = np.random.default_rng(7).normal(0, 2, mean.shape)
    return np.clip(np.round(mean + noise), 0, 255).astype(np.uint8)
