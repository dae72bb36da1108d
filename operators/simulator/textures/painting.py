"""Holds what all textures are painted with: smooth noise, rectangles, colours, rows of words."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Rng = np.random.Generator
Pixels = NDArray[np.float32]
"""(SIZE, SIZE, 3) RGB, 0 to 255."""
Color = Sequence[float] | NDArray[np.float64]
"""RGB, 0 to 255."""

SIZE = 256


def noise(rng: Rng, cells_x: int, cells_y: int | None = None) -> NDArray[np.float32]:
    """Smooth noise (SIZE, SIZE) of unit standard deviation that repeats without a seam."""
    cells_y = cells_x if cells_y is None else cells_y
    grid = rng.standard_normal((cells_y, cells_x)).astype(np.float32)
    along = (np.arange(SIZE, dtype=np.float32) + 0.5) / SIZE
    x, y = np.meshgrid(along * cells_x - 0.5, along * cells_y - 0.5)
    smooth = cv2.remap(grid, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    return np.asarray(smooth / max(float(smooth.std()), 1e-6), np.float32)


def grey(rng: Rng, base: float, *layers: tuple[int, float]) -> NDArray[np.float32]:
    value = np.full((SIZE, SIZE), base, np.float32)
    for cells, strength in layers:
        value += strength * noise(rng, cells)
    return value


def rgb(grey: NDArray[np.float32]) -> Pixels:
    return np.repeat(grey[..., None], 3, axis=2)


def rect(canvas: Pixels, x: float, y: float, w: float, h: float, color: Color, thickness: int = -1) -> None:
    cv2.rectangle(canvas, (int(x), int(y)), (int(x + w), int(y + h)), tuple(map(float, color)), thickness)


def bright(rng: Rng) -> NDArray[np.float64]:
    """A saturated colour."""
    hue = rng.uniform(0, 6)
    rgb = np.clip(np.abs((hue - np.array([3, 2, 4])) % 6 - 3) - 1, 0, 1)
    rgb[0] = np.clip(abs(hue - 3) - 1, 0, 1)
    return np.asarray((0.25 + 0.7 * rgb * rng.uniform(0.6, 1)) * rng.uniform(150, 255))


def lines(rng: Rng, canvas: Pixels, x: float, y: float, w: float, h: float, pitch: int, color: Color) -> None:
    """Rows of words."""
    row = y
    while row + pitch * 0.6 < y + h:
        column = x
        end = x + w * rng.uniform(0.5, 1)
        while column < end:
            word = rng.uniform(4, 20)
            rect(canvas, column, row, min(word, x + w - column), max(1, pitch * 0.35), color)
            column += word + 4
        row += pitch
