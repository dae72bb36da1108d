"""Images of upright boxes in several views, and of those of their sides that show in a case."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_AROUND = np.radians(22.5 + 45 * np.arange(8))
ELLIPSE = np.array([[0.52 * np.cos(a), 0.52 * np.sin(a), z] for a in _AROUND for z in (-0.5, 0.5)])
_NEAREST = 0.1  # metres before the camera from which a corner has a place in the image


def image_boxes(boxes: Array, P: Array, rounded: NDArray[np.bool_]) -> Array:
    """Returns the image boxes (K, 4) of upright boxes (K, 7), centre, sizes and heading, NaN where partly behind.

    `rounded` (K,) says which hold something of round outline.
    """
    rows = _with_log_sizes(boxes)
    image = images(rows, P[:, None], CORNERS)[:, 0]
    if rounded.any():
        image[rounded] = images(rows[rounded], P[:, None], ELLIPSE)[:, 0]
    return image


def spine_boxes(boxes: Array, P: Array, eye: Array, fronts: Array) -> Array:
    """Returns the same of the spines alone of things that stand in cases with `fronts` (K,), seen from `eye` (3,)."""
    return spines(_with_log_sizes(boxes), P[:, None], eye[None], fronts)[:, 0]


def _with_log_sizes(boxes: Array) -> Array:
    rows = boxes.copy()
    rows[:, 3:6] = np.log(np.maximum(boxes[:, 3:6], 1e-3))
    return rows


def spines(rows: Array, P: Array, eyes: Array, front: Array | float) -> Array:
    """Returns the image boxes (K, V, 4) of those sides of boxes (K, 7) along `front` that `eyes` (V, 3) see.

    Boxes are as in `images`; `front` is a heading, rad, or one for each box (K,).
    """
    across = lies_across(rows, front)
    deep = rows.copy()  # turned by a quarter where that lets its second axis lie along the front
    deep[~across, 3], deep[~across, 4] = rows[~across, 4], rows[~across, 3]
    deep[~across, 6] += np.pi / 2
    low, high = (images(deep, P, CORNERS[CORNERS[:, 1] == side]) for side in (-0.5, 0.5))
    way = eyes[None, :, :2] - deep[:, None, :2]
    before = np.cos(deep[:, 6, None]) * way[..., 1] > np.sin(deep[:, 6, None]) * way[..., 0]
    return np.where(before[..., None], high, low)


def lies_across(rows: Array, front: Array | float) -> Mask:
    """Tells of boxes (K, 7) whether their first axis lies across a heading."""
    return np.asarray(np.abs(np.cos(rows[:, 6] - front)) < np.sqrt(0.5))


def images(rows: Array, P: Array, outline: Array) -> Array:
    """Returns the image boxes (K, V, 4) of boxes (K, 7) in views (3, V, 4), NaN where partly behind the camera.

    Boxes are centre, log sizes and heading. `outline` (C, 3) are the places in a box of side 1 that are looked at: the
    first axis of what is worked with, along which extremes are found many times as fast.
    """
    c, s = np.cos(rows[:, 6]), np.sin(rows[:, 6])
    x, y, z = outline.T[..., None] * np.exp(rows.T[3:6, None])
    places = np.empty((3, len(outline), len(rows)))
    np.subtract(c * x, s * y, out=places[0])
    np.add(s * x, c * y, out=places[1])
    places[2] = z
    places += rows.T[:3, None]
    seen = places.reshape(3, -1).T @ P[..., :3].reshape(-1, 3).T
    seen += P[..., 3].ravel()
    seen = seen.reshape(len(outline), len(rows), 3, -1)
    depth = np.maximum(seen[:, :, 2], 1e-6)
    uv = seen[:, :, :2] / depth[:, :, None]
    image = np.concatenate([np.minimum.reduce(uv, axis=0), np.maximum.reduce(uv, axis=0)], axis=1).transpose(0, 2, 1)
    image[np.minimum.reduce(depth, axis=0) < _NEAREST] = np.nan
    return image
