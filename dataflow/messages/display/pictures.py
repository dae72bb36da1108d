"""Pictures of arrays for people: colours for depths, classes, cells and points, thinned to a size that a page takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.messages.display.png import png, turbo

SHOWN_PIXELS = 960
"""Pictures are thinned to at most this width and height."""
_CLOUD_PIXELS = 360
Pixels = npt.NDArray[np.uint8]
"""(H, W) or (H, W, 3)."""
Picture = tuple[str, bytes]
"""A format, and a file of it."""


def of_pixels(pixels: Pixels) -> Picture:
    """Pixels as they are."""
    return "png", png(np.ascontiguousarray(_thin(pixels)))


def of_depth(depth: npt.NDArray[np.floating[Any]]) -> Picture:
    """Metres (H, W): near is red and far is blue, as far as depths go; black where there was no return."""
    thin = _thin(depth).astype(np.float64)
    return of_pixels(turbo(1.0 - _scaled(np.where(thin > 0, thin, np.nan))))


def of_nearness(nearness: npt.NDArray[np.floating[Any]]) -> Picture:
    """Relative nearness (H, W): near is red and far is blue, as metres have it."""
    return of_pixels(turbo(_scaled(_thin(nearness).astype(np.float64))))


def of_classes(classes: npt.NDArray[np.integer[Any]]) -> Picture:
    """Class ids (H, W): each in one colour, the same everywhere: hues a golden angle apart."""
    ids = _thin(classes).astype(np.float64)
    phase = 2 * np.pi * ((ids * 0.6180339887) % 1.0)[..., None] + np.array([0.0, 2.0943951, 4.1887902])
    return of_pixels((127.5 + 110.0 * np.cos(phase)).astype(np.uint8))


def of_occupancy(occupancy: npt.NDArray[np.int8]) -> Picture:
    """Percent (H, W), -1 unknown: free is white, occupied black, unknown grey; y points up."""
    cells = _thin(occupancy)[::-1]
    return of_pixels(np.where(cells < 0, 128, 255 - np.clip(cells, 0, 100) * 2.55).astype(np.uint8))


def of_points(points: npt.NDArray[np.float32]) -> Picture:
    """Points (N, 3) from above, x up and y to the left, coloured by height."""
    there = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    canvas = np.zeros((_CLOUD_PIXELS, _CLOUD_PIXELS, 3), np.uint8)
    if not len(there):
        return of_pixels(canvas)
    lower, upper = there[:, :2].min(axis=0), there[:, :2].max(axis=0)
    extent = max(float((upper - lower).max()), 1e-6)
    at = ((there[:, :2] - (lower + upper) / 2) / extent * 0.98 + 0.5) * (_CLOUD_PIXELS - 1)
    order = np.argsort(there[:, 2], kind="stable")
    rows, columns = (_CLOUD_PIXELS - 1 - at[order]).astype(np.int64).T
    canvas[rows, columns] = turbo(_scaled(there[order, 2]))
    return of_pixels(canvas)


def _thin(data: npt.NDArray[Any]) -> npt.NDArray[Any]:
    step = max(1, -(-max(data.shape[:2]) // SHOWN_PIXELS))
    return data[::step, ::step]


def _scaled(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Values from 0.05 to 0.95, between which colours are bright, from their first to their last percent; NaN stays."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.full(values.shape, np.nan)
    low, high = np.percentile(finite, (1, 99))
    share: npt.NDArray[np.float64] = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    return 0.05 + 0.9 * share
