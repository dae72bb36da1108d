"""Upright boxes that agree with the image boxes of several views, with points on them, and with usual sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.scene.class_sizes import Usual

Array = NDArray[np.float64]
Box = tuple[Array, Array, float]
"""Centre (3,), full size (3,) and heading about the vertical of an upright box."""

_SIGNS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_STEPS = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05, 0.02])  # of centre, m; of log sizes; of heading, rad
_NEAREST = 0.1  # metres before the camera from which a corner has a place in the image
_PIXELS, _SHARE = 1.5, 0.06  # an edge of an image box strays so much, and by such a share of the box
_INSIDE = 0.02  # metres by which points stray from a box that they are of
_TURN = 0.15  # radians by which the heading that points show strays
_MOST_RESIDUAL = 3.0
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class ImageView:
    """One view of an object: `P` (3, 4) maps the world to pixels; `box` (4,) is the object's in the image.

    `edges` (4,) are those of the box, left, upper, right, lower, that are the object's and not the image's.
    """

    P: Array
    box: Array
    edges: NDArray[np.bool_]
    origin: Array


def fit_cuboid(start: Box, views: Sequence[ImageView], points: Array, usual: Usual | None) -> Box:
    """Returns the upright box that agrees best with image boxes, with points (N, 3) of its surface, and with its class.

    Least squares over centre, sizes and heading, by Gauss and Newton with differences: edges of the box's image against
    those of each view, with a bounded residual, since things hide each other; points at most on the surface, and on it
    where a view sees that side; log sizes as is usual. After Nicholson, Milford and Suenderhauf, "QuadricSLAM", 2018,
    and Yang and Scherer, "CubeSLAM", 2019.
    """
    center, size, yaw = start
    x = np.array([*center, *np.log(np.maximum(size, 0.01)), yaw])
    P = np.stack([v.P for v in views])
    boxes, edges = np.stack([v.box for v in views]), np.stack([v.edges for v in views])
    spread = _PIXELS + _SHARE * np.repeat(boxes[:, 2:] - boxes[:, :2], 2, axis=0).reshape(-1, 2, 2).reshape(-1, 4)
    eyes = np.stack([v.origin for v in views])
    weights = edges / spread / np.sqrt(max(1.0, len(views) / 4))
    prior = None if usual is None else (np.log(usual.size), 1 / np.asarray(usual.spread))

    def residuals(rows: Array) -> Array:
        """Returns the residuals (K, R) of boxes (K, 7)."""
        image = (_images(rows, P) - boxes) * weights
        image = np.nan_to_num(image).reshape(len(rows), -1)
        parts = [image, _surface(rows, points, eyes), (rows[:, 6:] - yaw) / _TURN]
        if prior is not None:
            parts.append((rows[:, 3:6] - prior[0]) * prior[1])
        return np.concatenate(parts, axis=1)

    for _ in range(_ROUNDS):
        probes = np.concatenate([x[None], x + np.diag(_STEPS)])
        values = residuals(probes)
        r, J = values[0], (values[1:] - values[0]).T / _STEPS
        weight = np.minimum(1.0, _MOST_RESIDUAL / np.maximum(np.abs(r), 1e-9))  # Huber
        A = J.T @ (weight[:, None] * J) + np.diag([1e-3] * 7)
        step = np.linalg.solve(A, -J.T @ (weight * r))
        x = x + np.clip(step, -20 * _STEPS, 20 * _STEPS)
        if (np.abs(step) < 0.1 * _STEPS).all():
            break
    return x[:3].copy(), np.exp(x[3:6]), float(x[6])


def image_boxes(boxes: Array, P: Array) -> Array:
    """Returns the image boxes (K, 4) of upright boxes (K, 7), centre, sizes and heading, NaN where partly behind."""
    rows = boxes.copy()
    rows[:, 3:6] = np.log(np.maximum(boxes[:, 3:6], 1e-3))
    return np.asarray(_images(rows, P[None])[:, 0])


def _images(rows: Array, P: Array) -> Array:
    """Returns the image boxes (K, V, 4) of boxes (K, 7) in views (V, 3, 4), NaN where a corner is behind the camera."""
    c, s = np.cos(rows[:, 6]), np.sin(rows[:, 6])
    local = _SIGNS[None] * np.exp(rows[:, None, 3:6])
    corners = np.empty_like(local)
    corners[..., 0] = c[:, None] * local[..., 0] - s[:, None] * local[..., 1]
    corners[..., 1] = s[:, None] * local[..., 0] + c[:, None] * local[..., 1]
    corners[..., 2] = local[..., 2]
    corners += rows[:, None, :3]
    seen = np.einsum("vij,kcj->kvci", P[:, :, :3], corners) + P[:, None, :, 3]
    depth = seen[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = seen[..., :2] / depth[..., None]
    image = np.concatenate([uv.min(axis=2), uv.max(axis=2)], axis=-1)
    image[(depth < _NEAREST).any(axis=2)] = np.nan
    return np.asarray(image)


def _surface(rows: Array, points: Array, eyes: Array) -> Array:
    """Returns by how much the points' extents differ from the sides of boxes (K, 7): (K, 6), in standard deviations.

    Sides that no view sees may be farther out than the points.
    """
    c, s = np.cos(rows[:, 6]), np.sin(rows[:, 6])
    axes = np.zeros((len(rows), 3, 3))
    axes[:, 0, 0], axes[:, 0, 1], axes[:, 1, 0], axes[:, 1, 1], axes[:, 2, 2] = c, s, -s, c, 1.0
    local = np.einsum("kij,knj->kni", axes, points[None] - rows[:, None, :3])
    half = np.exp(rows[:, 3:6]) / 2
    ranked = np.sort(local, axis=1)
    cut = len(points) // 20
    low, high = ranked[:, cut] + half, half - ranked[:, len(points) - 1 - cut]
    towards = np.einsum("kij,kvj->kvi", axes, eyes[None] - rows[:, None, :3])
    shown_low, shown_high = (towards < -half[:, None]).mean(axis=1) > 0.3, (towards > half[:, None]).mean(axis=1) > 0.3
    residual = np.concatenate([low, high], axis=1)  # positive: the side is farther out than the points
    shown = np.concatenate([shown_low, shown_high], axis=1)
    return np.where(residual > 0, np.where(shown, residual, 0.0), residual) / _INSIDE
