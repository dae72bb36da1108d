"""Draws curves and plans as images (H, W, 3), with OpenCV: no plotting library is needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
Color = tuple[int, int, int]
COLORS: tuple[Color, ...] = (
    (31, 119, 180), (214, 39, 40), (44, 160, 44), (255, 127, 14), (148, 103, 189), (140, 86, 75), (23, 155, 170),
    (200, 90, 160), (120, 120, 20),
)  # fmt: skip
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 16, 30, 34
_INK, _GRID, _LIMIT = (60, 60, 60), (225, 225, 225), (150, 150, 150)


@dataclass(frozen=True, eq=False)
class Curve:
    """Values (N,) over x (N,), both finite, with a name for the legend; `limit` draws it thin and grey."""

    name: str
    x: Array
    y: Array
    limit: bool = False


def steps(low: float, high: float, most: int) -> list[float]:
    """Returns round numbers from `low` to `high`, at most so many: 1, 2 or 5 times a power of ten apart."""
    span = max(high - low, 1e-12)
    raw = span / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * 0.999)
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def chart(title: str, curves: Sequence[Curve], size: tuple[int, int], top: float | None = None) -> Pixels:
    """Draws curves over time, from 0 up; `size` is width and height, `top` where higher values are cut off."""
    drawn = [curve for curve in curves if len(curve.x)]
    x = np.concatenate([curve.x for curve in drawn]) if drawn else np.zeros(1)
    y = np.concatenate([curve.y for curve in drawn]) if drawn else np.zeros(1)
    high = float(y.max()) if top is None else min(float(y.max()), top)
    axes = _Axes(size, (float(x.min()), float(x.max())), (min(0.0, float(y.min())), high * 1.05))
    return _drawn(title, drawn, axes)


def plan(title: str, tracks: Sequence[Curve], size: tuple[int, int]) -> Pixels:
    """Draws tracks in the plane, a metre as long along both axes."""
    drawn = [track for track in tracks if len(track.x)]
    x = np.concatenate([track.x for track in drawn]) if drawn else np.zeros(1)
    y = np.concatenate([track.y for track in drawn]) if drawn else np.zeros(1)
    inner = size[0] - _LEFT - _RIGHT, size[1] - _TOP - _BOTTOM
    scale = 1.1 * max(np.ptp(x) / inner[0], np.ptp(y) / inner[1], 1e-6)
    middle = (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2)
    (a, b), (c, d) = ((m - scale * n / 2, m + scale * n / 2) for m, n in zip(middle, inner, strict=True))
    return _drawn(title, drawn, _Axes(size, (a, b), (c, d)))


def tiled(images: Sequence[Pixels]) -> Pixels:
    """Lays images of one size in two columns."""
    even = [*images, *[np.full_like(images[0], 255)] * (len(images) % 2)]
    return np.vstack([np.hstack(even[k : k + 2]) for k in range(0, len(even), 2)])


class _Axes:
    """The way from values to pixels."""

    def __init__(self, size: tuple[int, int], x: tuple[float, float], y: tuple[float, float]) -> None:
        self.size = size
        self.x = x if x[1] > x[0] else (x[0], x[0] + 1.0)
        self.y = y if y[1] > y[0] else (y[0], y[0] + 1.0)
        self.wide, self.high = size[0] - _LEFT - _RIGHT, size[1] - _TOP - _BOTTOM

    def column(self, x: Array) -> Array:
        return _LEFT + (x - self.x[0]) / (self.x[1] - self.x[0]) * self.wide

    def row(self, y: Array) -> Array:
        share = np.clip((y - self.y[0]) / (self.y[1] - self.y[0]), 0.0, 1.0)
        return np.asarray(_TOP + self.high * (1.0 - share))


def _drawn(title: str, curves: Sequence[Curve], axes: _Axes) -> Pixels:
    wide, high = axes.size
    image = np.full((high, wide, 3), 255, np.uint8)
    _text(image, title, (_LEFT, 20), 0.5, _INK)
    for value in steps(*axes.x, 8):
        at = round(float(axes.column(np.float64(value))))  # type: ignore[arg-type]
        cv2.line(image, (at, _TOP), (at, high - _BOTTOM), _GRID)
        _text(image, f"{value:g}", (at - 8, high - _BOTTOM + 16), 0.38, _INK)
    for value in steps(*axes.y, 6):
        at = round(float(axes.row(np.float64(value))))  # type: ignore[arg-type]
        cv2.line(image, (_LEFT, at), (wide - _RIGHT, at), _GRID)
        _text(image, f"{value:g}", (6, at + 4), 0.38, _INK)
    cv2.rectangle(image, (_LEFT, _TOP), (wide - _RIGHT, high - _BOTTOM), _INK)
    strong = 0
    for k, curve in enumerate(curves):
        color = _LIMIT if curve.limit else COLORS[strong % len(COLORS)]
        strong += not curve.limit
        points = np.column_stack([axes.column(curve.x), axes.row(curve.y)])
        sub = np.round(points * 16).astype(np.int32)
        cv2.polylines(image, [sub], False, color, 1 if curve.limit else 2, cv2.LINE_AA, 4)
        _text(image, curve.name, (wide - _RIGHT - 8 * len(curve.name) - 8, _TOP + 16 + 15 * k), 0.4, color)
    return image


def _text(image: Pixels, text: str, place: tuple[int, int], size: float, color: Color) -> None:
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
