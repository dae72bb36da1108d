"""Images of upright boxes in several views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_AROUND = np.radians(22.5 + 45 * np.arange(8))
ELLIPSE = np.array([[0.52 * np.cos(a), 0.52 * np.sin(a), z] for a in _AROUND for z in (-0.5, 0.5)])
_NEAREST = 0.1  # metres before the camera from which a corner has a place in the image


def image_boxes(boxes: Array, P: Array, rounded: NDArray[np.bool_]) -> Array:
    """Returns the image boxes (K, 4) of upright boxes (K, 7), centre, sizes and heading, NaN where partly behind.

    `rounded` (K,) marks boxes of objects with a round outline.
    """
    rows = boxes.copy()
    rows[:, 3:6] = np.log(np.maximum(boxes[:, 3:6], 1e-3))
    image = images(rows, P[:, None], CORNERS)[:, 0]
    if rounded.any():
        image[rounded] = images(rows[rounded], P[:, None], ELLIPSE)[:, 0]
    return image


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
