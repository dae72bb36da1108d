"""A made-up room with a few objects, ray-cast into colour and depth: placeholder data with exactly known geometry.

World frame: origin on the middle of the floor, z up. Cameras are pinhole with optical axes (z forward, y down).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HALF_SIZE = np.array([2.5, 2.0, 1.3])  # metres; the room is centred at CENTRE
CENTRE = np.array([0.0, 0.0, 1.3])
LAMP = np.array([0.4, 0.3, 2.4])
TEXELS = 512
WALL_TEXEL, OBJECT_TEXEL = 0.01, 0.0025  # metres
_WALL_COLORS = [(176, 150, 128), (120, 150, 172), (150, 168, 128), (184, 164, 120), (148, 120, 96), (222, 220, 214)]


@dataclass(frozen=True)
class Ball:
    label: str
    color: tuple[int, int, int]
    center: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class Block:
    """An axis-parallel box."""

    label: str
    color: tuple[int, int, int]
    low: tuple[float, float, float]
    high: tuple[float, float, float]


OBJECTS: tuple[Ball | Block, ...] = (
    Block("table", (150, 104, 62), (-0.55, -0.40, 0.0), (0.55, 0.40, 0.45)),
    Ball("ball", (206, 44, 40), (-0.25, 0.12, 0.61), 0.16),
    Block("box", (40, 92, 190), (0.10, -0.25, 0.45), (0.38, 0.02, 0.75)),
    Ball("ball", (232, 190, 36), (0.30, 0.24, 0.56), 0.11),
    Block("cabinet", (70, 130, 84), (1.75, -1.95, 0.0), (2.45, -1.05, 1.20)),
    Block("box", (196, 120, 176), (-2.40, 1.20, 0.0), (-1.75, 1.80, 0.60)),
)


@dataclass(frozen=True, eq=False)
class View:
    """View of a camera: `image` (H, W, 3) uint8 RGB, `depth` (H, W) metres along z, `surface` (H, W) index.

    Surfaces 0 to 5 are the room's sides, 6 onwards OBJECTS.
    """

    image: NDArray[np.uint8]
    depth: Array
    surface: NDArray[np.int64]


class Room:
    """The room with textures drawn from `seed`."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        colors = [*_WALL_COLORS, *(thing.color for thing in OBJECTS)]
        self._atlas = np.concatenate([_texture(rng, color, pictures=i < 4) for i, color in enumerate(colors)])

    def render(self, T_world_camera: Array, K: Array, size: tuple[int, int]) -> View:
        """`K` (3, 3) pixels, `size` (width, height); the camera must be inside the room."""
        u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)])
        rays = np.einsum("ij,jhw->ihw", T_world_camera[:3, :3], rays)
        rays[np.abs(rays) < 1e-12] = 1e-12
        inverse = 1 / rays
        origin = T_world_camera[:3, 3]

        # Camera rays have z = 1, so the distance along them is the depth.
        to_sides = (_column(CENTRE - origin) + np.copysign(_column(HALF_SIZE), rays)) * inverse
        depth = to_sides.min(axis=0)
        axis = to_sides.argmin(axis=0)
        surface = 2 * axis + (np.take_along_axis(rays, axis[None], 0)[0] > 0)
        for i, thing in enumerate(OBJECTS, 6):
            hit = _hit_ball(thing, origin, rays) if isinstance(thing, Ball) else _hit_block(thing, origin, inverse)
            nearer = hit < depth
            depth[nearer], surface[nearer] = hit[nearer], i

        points = _column(origin) + rays * depth
        return View(self._shade(points, _normals(points, rays, axis, surface), surface), depth, surface)

    def _shade(self, points: Array, normals: Array, surface: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Texture by the plane that the normal favours, lit by one lamp."""
        axis = np.abs(normals).argmax(axis=0)
        low = np.array([CENTRE - HALF_SIZE] * 6 + [_low(thing) for thing in OBJECTS]).T[:, surface]
        x, y, z = (points - low) / np.where(surface < 6, WALL_TEXEL, OBJECT_TEXEL)
        column = np.clip(np.where(axis == 0, y, x), 0, TEXELS - 1)
        row = np.clip(np.where(axis == 2, y, TEXELS - 1 - z), 0, TEXELS - 1) + TEXELS * surface
        albedo = cv2.remap(self._atlas, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
        to_lamp = _column(LAMP) - points
        square = (to_lamp * to_lamp).sum(axis=0)
        facing = np.maximum((normals * to_lamp).sum(axis=0), 0) / np.sqrt(square)
        return to_pixels(albedo * (0.55 + 0.6 * facing / (1 + 0.08 * square))[..., None])


def to_pixels(values: Array) -> NDArray[np.uint8]:
    """Rounded and cut to the range of a byte."""
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def look_at(eye: Array, target: Array) -> Array:
    """T_world_camera (4, 4) of an upright camera at `eye` whose optical axis meets `target`."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = eye
    return T


def camera_path(seconds: float, period: float) -> Array:
    """T_world_camera (4, 4) on a smooth closed path around the table, one round a period, looking a little about."""
    a = 2 * math.pi * seconds / period
    eye = np.array([1.75 * math.cos(a), 1.35 * math.sin(a), 1.25 + 0.12 * math.sin(3 * a)])
    target = np.array([0.35 * math.sin(2 * a), 0.30 * math.cos(3 * a), 0.60 + 0.10 * math.cos(2 * a)])
    return look_at(eye, target)


def _low(thing: Ball | Block) -> Array:
    return np.array(thing.center) - thing.radius if isinstance(thing, Ball) else np.array(thing.low)


def _column(vector: Array) -> Array:
    """(3, 1, 1) of (3,): coordinates come first in the images of this module, which numpy reduces far faster."""
    return vector[:, None, None]


def _hit_ball(ball: Ball, origin: Array, rays: Array) -> Array:
    offset = origin - np.array(ball.center)
    a, b = (rays * rays).sum(axis=0), np.tensordot(offset, rays, 1)
    root = b * b - a * (offset @ offset - ball.radius**2)
    t = (-b - np.sqrt(np.maximum(root, 0))) / a
    return np.where((root > 0) & (t > 0), t, np.inf)


def _hit_block(block: Block, origin: Array, inverse: Array) -> Array:
    a, b = (_column(np.array(corner) - origin) * inverse for corner in (block.low, block.high))
    enter, leave = np.minimum(a, b).max(axis=0), np.maximum(a, b).min(axis=0)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def _normals(points: Array, rays: Array, axis: NDArray[np.int64], surface: NDArray[np.int64]) -> Array:
    """Unit normals (3, H, W) towards the camera."""
    normals: Array = -np.sign(rays) * (axis == np.arange(3)[:, None, None])  # of the room's sides
    for i, thing in enumerate(OBJECTS, 6):
        on = surface == i
        if isinstance(thing, Ball):
            normals[:, on] = (points[:, on] - np.array(thing.center)[:, None]) / thing.radius
        else:
            low, high = np.array(thing.low)[:, None], np.array(thing.high)[:, None]
            relative = (2 * points[:, on] - low - high) / (high - low)
            face = np.abs(relative).argmax(axis=0) == np.arange(3)[:, None]
            normals[:, on] = np.sign(relative) * face
    return normals


def _texture(rng: np.random.Generator, color: tuple[int, int, int], pictures: bool) -> NDArray[np.float32]:
    """(TEXELS, TEXELS, 3): the colour, mottled on several scales, with pictures hung on walls and marks on the rest."""
    mottle = np.zeros((TEXELS, TEXELS), np.float32)
    for cells, strength in ((8, 14), (32, 12), (128, 14)):
        grid = rng.normal(0, strength, (cells, cells)).astype(np.float32)
        mottle += cv2.resize(grid, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
    texture = np.array(color, np.float32) + mottle[..., None]
    for _ in range(26 if pictures else 60):
        extent = rng.integers(14, 70, 2) if pictures else rng.integers(5, 26, 2)
        corner = rng.integers(0, TEXELS - 70, 2)
        shade = rng.uniform(25, 235, 3) if pictures else np.array(color) * rng.uniform(0.55, 1.3)
        first, last = tuple(map(int, corner)), tuple(map(int, corner + extent))
        cv2.rectangle(texture, first, last, tuple(map(float, shade)), cv2.FILLED)
        if pictures:
            cv2.rectangle(texture, first, last, (40.0, 34.0, 30.0), 2)
            middle = tuple(map(int, corner + extent // 2))
            cv2.circle(texture, middle, int(extent.min() // 3), tuple(map(float, 255 - shade)), cv2.FILLED)
    return np.asarray(cv2.GaussianBlur(np.clip(texture, 0, 255), (0, 0), 0.8), np.float32)
