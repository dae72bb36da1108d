"""Pictures of arrays for people: colours for depths, classes, cells and points, thinned to a size that a page takes."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

_GREY, _RGB = 0, 2
_LEVEL = 4
_TURBO = np.array(
    [
        [0.13572138, 0.09140261, 0.10667330],
        [4.61539260, 2.19418839, 12.64194608],
        [-42.66032258, 4.84296658, -60.58204836],
        [132.13108234, -14.18503333, 110.36276771],
        [-152.94239396, 4.27729857, -89.90310912],
        [59.28637943, 2.82956604, 27.34824973],
    ]
)
SHOWN_PIXELS = 960
"""Pictures are thinned to at most this width and height."""
_CLOUD_PIXELS = 360
Pixels = npt.NDArray[np.uint8]
"""(H, W) or (H, W, 3)."""
Picture = tuple[str, bytes]
"""A format, and a file of it."""


def png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """The PNG file of (H, W) grey or (H, W, 3) RGB pixels. Raises `ValueError` for other arrays."""
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise ValueError(f"a PNG takes uint8 (H, W) or (H, W, 3), got {pixels.dtype} {pixels.shape}")
    height, width = pixels.shape[:2]
    rows = np.zeros((height, 1 + pixels[0].size), np.uint8)  # each row begins with its filter: 0, none
    rows[:, 1:] = pixels.reshape(height, -1)
    head = struct.pack(">IIBBBBB", width, height, 8, _GREY if pixels.ndim == 2 else _RGB, 0, 0, 0)
    body = zlib.compress(rows.data, _LEVEL)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def turbo(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """RGB (..., 3) of values from 0 to 1 in the Turbo colours, by Mikhailov's polynomial; NaN is black."""
    x = np.clip(np.nan_to_num(values, nan=0.0), 0.0, 1.0).astype(np.float64)
    powers = np.stack([np.ones_like(x), x, x**2, x**3, x**4, x**5], axis=-1)
    colors: npt.NDArray[np.uint8] = (np.clip(powers @ _TURBO, 0.0, 1.0) * 255).astype(np.uint8)
    colors[np.isnan(values)] = 0
    return colors


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
