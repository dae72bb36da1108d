"""Samples of a detector's own inner maps on a grid over the window of a box: they describe its surroundings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from operators.image.letterbox import ImageFit

F32 = NDArray[np.float32]
GRID = 6
"""Samples along each side of a window."""
_LEVELS = 3
_TOGETHER = 8  # windows whose samples stay in the processor's cache
Samples = NDArray[np.float64]


def surroundings(maps: Sequence[F32], seen: F32, fit: ImageFit) -> F32:
    """Samples (N, M * GRID * GRID * C) of M inner maps (1, C, h, w) over windows (N, 4) in pixels of the image.

    Where samples lie far apart, they are taken from a map of which two by two cells, or four by four, are one.
    """
    scale = np.array([inner / extent for inner, extent in zip(fit.inner, fit.image, strict=True)] * 2, np.float32)
    there = seen * scale + np.array([*fit.offset, *fit.offset], np.float32)
    return np.concatenate([_sampled(each[0], there, fit.target) for each in maps], axis=1)


def _sampled(map: F32, seen: F32, size: tuple[int, int]) -> F32:
    channels, _, width = map.shape
    stride = size[0] / width
    apart = np.sqrt(np.maximum(np.prod(seen[:, 2:] - seen[:, :2], axis=1), 1e-6)) / GRID / stride
    deepest = sum(min(map.shape[1:]) >> k >= 4 for k in range(_LEVELS - 1))
    level = np.clip(np.log2(np.maximum(apart, 1)).astype(int), 0, deepest)
    found = np.empty((len(seen), GRID * GRID * channels), np.float32)
    cells = np.ascontiguousarray(map.transpose(1, 2, 0))
    for k in range(int(level.max(initial=0)) + 1):
        if k:
            even = cells[: cells.shape[0] // 2 * 2, : cells.shape[1] // 2 * 2]
            cells = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2, channels).mean(axis=(1, 3))
        rows = np.flatnonzero(level == k)
        if len(rows):
            found[rows] = _bilinear(cells, seen[rows] / np.float32(stride * 2**k)).reshape(len(rows), -1)
    return found


def _bilinear(cells: F32, seen: F32) -> F32:
    """Samples (N, GRID, GRID, C) of cells (h, w, C) over windows (N, 4) in cells; beyond the border lies its cell."""
    height, width, channels = cells.shape
    shares = ((np.arange(GRID) + 0.5) / GRID).astype(np.float32)
    x = np.clip(seen[:, :1] + shares * (seen[:, 2:3] - seen[:, :1]) - 0.5, 0, width - 1)
    y = np.clip(seen[:, 1:2] + shares * (seen[:, 3:4] - seen[:, 1:2]) - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(np.intp), max(0, width - 2)), np.minimum(y.astype(np.intp), max(0, height - 2))
    u, v = (x - left)[:, None, :, None], (y - top)[:, :, None, None]
    at = top[:, :, None] * width + left[:, None, :]
    flat = cells.reshape(-1, channels)
    right, below = int(width > 1), width * int(height > 1)
    found = np.empty((*at.shape, channels), np.float32)
    for k in range(0, len(seen), _TOGETHER):
        some = slice(k, k + _TOGETHER)
        rows = [_between(flat, at[some] + down, at[some] + down + right, u[some]) for down in (0, below)]
        rows[0] *= 1 - v[some]
        rows[1] *= v[some]
        np.add(rows[0], rows[1], out=found[some], casting="same_kind")
    return found


def _between(flat: F32, left: NDArray[np.intp], right: NDArray[np.intp], share: NDArray[np.float64]) -> Samples:
    """Values (..., C) between two rows of `flat` (K, C) each."""
    between: Samples = (1 - share) * flat.take(left, axis=0)
    between += share * flat.take(right, axis=0)
    return between
