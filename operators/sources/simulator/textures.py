"""Procedural textures and the atlas that holds them, with smaller copies for surfaces far away.

Every pattern fills a square of SIZE texels, repeats without a seam where it is meant to be tiled, and is drawn from its
own generator: a pattern's name and the world's seed decide it alone.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Rng = np.random.Generator
Pixels = NDArray[np.float32]
"""(SIZE, SIZE, 3) RGB, 0 to 255."""
Color = Sequence[float] | NDArray[np.float64]
"""RGB, 0 to 255."""

SIZE = 256
BORDER = 8  # texels repeated around a pattern, so that interpolation never sees its neighbour
LEVELS = 4  # each half the size of the one before
_CELL = SIZE + 2 * BORDER
_PER_ROW = 8


@dataclass(frozen=True, eq=False)
class Atlas:
    """All patterns in one image.

    `image` (H, W, 3) uint8; `origins` (N, 2) the column and row of texel (0, 0) of each pattern; level k of the atlas
    starts at column `left[k]`, row `top[k]`, 2^k times smaller.
    """

    image: NDArray[np.uint8]
    names: tuple[str, ...]
    origins: NDArray[np.float32]
    left: NDArray[np.float32]
    top: NDArray[np.float32]


def make_atlas(names: Sequence[str], seed: int) -> Atlas:
    """Draws the named patterns, e.g. `plaster` or `poster:3`: what follows the colon only varies the draw.

    Raises ValueError for a name that is not a pattern.
    """
    rows = -(-len(names) // _PER_ROW)
    base = np.zeros((rows * _CELL, _PER_ROW * _CELL, 3), np.uint8)
    origins = np.zeros((len(names), 2), np.float32)
    for k, name in enumerate(names):
        x, y = (k % _PER_ROW) * _CELL, (k // _PER_ROW) * _CELL
        padded = np.pad(
            np.rint(draw(name, seed)).astype(np.uint8), ((BORDER, BORDER), (BORDER, BORDER), (0, 0)), mode="wrap"
        )
        base[y : y + _CELL, x : x + _CELL] = padded
        origins[k] = x + BORDER, y + BORDER
    height, width = base.shape[:2]
    image = np.zeros((height, width + width // 2, 3), np.uint8)
    left, top = np.zeros(LEVELS, np.float32), np.zeros(LEVELS, np.float32)
    row = 0
    for k in range(LEVELS):
        level = base if k == 0 else cv2.resize(base, (width >> k, height >> k), interpolation=cv2.INTER_AREA)
        x = 0 if k == 0 else width
        y = row if k else 0
        image[y : y + level.shape[0], x : x + level.shape[1]] = level
        left[k], top[k] = x, y
        row += level.shape[0] if k else 0
    return Atlas(image, tuple(names), origins, left, top)


def draw(name: str, seed: int) -> Pixels:
    """One pattern. Raises ValueError for an unknown name."""
    kind = name.split(":")[0]
    painter = _PAINTERS.get(kind)
    if painter is None:
        raise ValueError(f"no texture pattern {kind!r}; there are {', '.join(sorted(_PAINTERS))}")
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return np.clip(painter(rng), 0, 255).astype(np.float32)


def noise(rng: Rng, cells_x: int, cells_y: int | None = None) -> NDArray[np.float32]:
    """Smooth noise (SIZE, SIZE) of unit standard deviation that repeats without a seam."""
    cells_y = cells_x if cells_y is None else cells_y
    grid = rng.standard_normal((cells_y, cells_x)).astype(np.float32)
    along = (np.arange(SIZE, dtype=np.float32) + 0.5) / SIZE
    x, y = np.meshgrid(along * cells_x - 0.5, along * cells_y - 0.5)
    smooth = cv2.remap(grid, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    return np.asarray(smooth / max(float(smooth.std()), 1e-6), np.float32)


def _grey(rng: Rng, base: float, *layers: tuple[int, float]) -> NDArray[np.float32]:
    value = np.full((SIZE, SIZE), base, np.float32)
    for cells, strength in layers:
        value += strength * noise(rng, cells)
    return value


def _rgb(grey: NDArray[np.float32]) -> Pixels:
    return np.repeat(grey[..., None], 3, axis=2)


def _rect(canvas: Pixels, x: float, y: float, w: float, h: float, color: Color, thickness: int = -1) -> None:
    cv2.rectangle(canvas, (int(x), int(y)), (int(x + w), int(y + h)), tuple(map(float, color)), thickness)


def _bright(rng: Rng) -> NDArray[np.float64]:
    """A saturated colour."""
    hue = rng.uniform(0, 6)
    rgb = np.clip(np.abs((hue - np.array([3, 2, 4])) % 6 - 3) - 1, 0, 1)
    rgb[0] = np.clip(abs(hue - 3) - 1, 0, 1)
    return np.asarray((0.25 + 0.7 * rgb * rng.uniform(0.6, 1)) * rng.uniform(150, 255))


def _lines(rng: Rng, canvas: Pixels, x: float, y: float, w: float, h: float, pitch: int, color: Color) -> None:
    """Rows of words."""
    row = y
    while row + pitch * 0.6 < y + h:
        column = x
        end = x + w * rng.uniform(0.5, 1)
        while column < end:
            word = rng.uniform(4, 20)
            _rect(canvas, column, row, min(word, x + w - column), max(1, pitch * 0.35), color)
            column += word + 4
        row += pitch


def _plain(rng: Rng) -> Pixels:
    return _rgb(_grey(rng, 232, (64, 5), (16, 5), (128, 4)))


def _plaster(rng: Rng) -> Pixels:
    return _rgb(_grey(rng, 222, (4, 3), (24, 5), (90, 7), (200, 5)))


def _wood(rng: Rng) -> Pixels:
    y = np.arange(SIZE, dtype=np.float32)[:, None] / SIZE
    warp = 0.05 * noise(rng, 3, 4) + 0.012 * noise(rng, 6, 24)
    rings = np.sin(2 * np.pi * (9 * (y + warp)))
    grain = noise(rng, 8, 128) * 9 + noise(rng, 16, 250) * 5
    value = 200 + 22 * rings + grain
    return np.asarray(value[..., None] * np.array([1.0, 0.97, 0.92], np.float32))


def _parquet(rng: Rng) -> Pixels:
    canvas = _wood(rng)
    planks = 8
    height = SIZE // planks
    shade = np.ones((SIZE, SIZE), np.float32)
    for k in range(planks):
        offset = int(rng.integers(0, SIZE))
        rows = slice(k * height, (k + 1) * height)
        canvas[rows] = np.roll(canvas[rows], int(rng.integers(SIZE)), axis=1)
        for part in range(2):
            columns = (np.arange(SIZE // 2) + offset + part * SIZE // 2) % SIZE
            shade[k * height : (k + 1) * height, columns] *= rng.uniform(0.78, 1.12)
        shade[k * height, :] *= 0.55
        for part in range(2):
            shade[rows, (offset + part * SIZE // 2) % SIZE] *= 0.55
    return np.asarray(canvas * shade[..., None])


def _carpet(rng: Rng) -> Pixels:
    return _rgb(_grey(rng, 190, (5, 6), (40, 8), (128, 22), (250, 18)))


def _tiles(rng: Rng) -> Pixels:
    value = _grey(rng, 212, (20, 6), (100, 6))
    n = 4
    side = SIZE // n
    for i in range(n):
        for j in range(n):
            value[i * side : (i + 1) * side, j * side : (j + 1) * side] *= rng.uniform(0.84, 1.08)
    for k in range(n):
        value[k * side : k * side + 3] = 120
        value[:, k * side : k * side + 3] = 120
    return _rgb(value + 3 * noise(rng, 200))


def _ceiling(rng: Rng) -> Pixels:
    value = _grey(rng, 232, (120, 8), (220, 7))
    value[:3], value[:, :3] = 165, 165
    return _rgb(value)


def _fabric(rng: Rng) -> Pixels:
    weave = 14 * (np.indices((SIZE, SIZE)).sum(axis=0) // 3 % 2) - 7
    return _rgb(_grey(rng, 205, (10, 8), (60, 9), (128, 9)) + weave.astype(np.float32))


def _checked(rng: Rng) -> Pixels:
    """A shirt: stripes both ways."""
    stripes = np.zeros((SIZE, SIZE), np.float32)
    for k in range(0, SIZE, 32):
        stripes[:, k : k + 12] -= 50
        stripes[k : k + 12] -= 50
    return _rgb(225 + stripes) + 6 * _rgb(noise(rng, 120))


def _metal(rng: Rng) -> Pixels:
    return _rgb(195 + 8 * noise(rng, 4, 200) + 4 * noise(rng, 16))


def _cardboard(rng: Rng) -> Pixels:
    canvas = _rgb(_grey(rng, 215, (6, 5), (100, 6))) + 4 * _rgb(noise(rng, 4, 128))
    _rect(canvas, 0, SIZE * 0.44, SIZE, SIZE * 0.12, (236, 222, 190))
    x, y = rng.uniform(12, 120, 2)
    _rect(canvas, x, y * 0.5, 90, 46, (246, 246, 240))
    _lines(rng, canvas, x + 6, y * 0.5 + 6, 78, 36, 8, (50, 50, 60))
    for k in range(14):
        _rect(canvas, 150 + k * 5, 190, int(rng.integers(1, 4)), 40, (40, 40, 44))
    return canvas


def _books(rng: Rng) -> Pixels:
    """Spines side by side."""
    canvas = np.full((SIZE, SIZE, 3), 40, np.float32)
    x = 0
    while x < SIZE:
        width = int(rng.integers(12, 34))
        top = int(rng.integers(4, 50))
        color = _bright(rng) * rng.uniform(0.5, 1)
        _rect(canvas, x, top, width - 2, SIZE, color)
        for _ in range(int(rng.integers(1, 4))):
            y = rng.uniform(top + 8, SIZE - 30)
            _rect(canvas, x + 3, y, width - 8, rng.uniform(3, 22), np.clip(color + rng.uniform(-90, 130), 0, 255))
        x += width
    return canvas + 4 * _rgb(noise(rng, 128))


def _cover(rng: Rng) -> Pixels:
    """The front of a book or a package."""
    color = _bright(rng)
    canvas = np.empty((SIZE, SIZE, 3), np.float32)
    canvas[:] = color
    band = 255 - color
    _rect(canvas, 0, rng.uniform(20, 90), SIZE, rng.uniform(30, 70), band)
    cv2.circle(canvas, (int(rng.uniform(70, 190)), 185), int(rng.uniform(25, 50)), tuple(map(float, band * 0.8)), -1)
    _lines(rng, canvas, 30, 28, 190, 60, 20, np.clip(color * 0.4, 0, 255))
    return canvas + 4 * _rgb(noise(rng, 100))


def _poster(rng: Rng) -> Pixels:
    """A picture in a frame."""
    sky, ground = _bright(rng), _bright(rng) * 0.7
    ramp = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None, None]
    canvas = np.ascontiguousarray(np.broadcast_to(sky * (1 - ramp) + ground * ramp, (SIZE, SIZE, 3)), np.float32)
    style = int(rng.integers(3))
    for _ in range(int(rng.integers(6, 14))):
        color = tuple(map(float, _bright(rng)))
        x, y = (int(v) for v in rng.uniform(10, SIZE - 10, 2))
        if style == 0:
            cv2.circle(canvas, (x, y), int(rng.uniform(8, 48)), color, -1)
        elif style == 1:
            points = rng.uniform(0, SIZE, (3, 2)).astype(np.int32)
            cv2.fillPoly(canvas, [points], color)
        else:
            w, h = rng.uniform(10, 90, 2)
            _rect(canvas, x, y, w, h, color)
    if rng.uniform() < 0.5:
        _rect(canvas, 24, 196, 208, 44, (244, 242, 236))
        _lines(rng, canvas, 34, 202, 188, 34, 11, (30, 30, 36))
    _rect(canvas, 0, 0, SIZE - 1, SIZE - 1, rng.choice([(30, 28, 26), (236, 234, 228), (110, 76, 46)]), 14)
    return canvas + 5 * _rgb(noise(rng, 90))


def _screen(rng: Rng) -> Pixels:
    """A computer's screen: windows with text and a chart."""
    canvas = np.empty((SIZE, SIZE, 3), np.float32)
    dark = rng.uniform() < 0.5
    canvas[:] = (34, 38, 52) if dark else (205, 216, 228)
    canvas += 10 * _rgb(noise(rng, 4))
    for _ in range(3):
        x, y = rng.uniform(6, 110), rng.uniform(14, 110)
        w, h = rng.uniform(90, 135), rng.uniform(70, 125)
        paper = (24, 26, 34) if dark else (250, 250, 250)
        _rect(canvas, x, y, w, h, paper)
        _rect(canvas, x, y, w, 10, _bright(rng))
        if rng.uniform() < 0.4:
            values = np.cumsum(rng.normal(0, 8, 18)) + y + h * 0.55
            line = np.stack([np.linspace(x + 6, x + w - 6, 18), np.clip(values, y + 16, y + h - 6)], axis=1)
            cv2.polylines(canvas, [line.astype(np.int32)], False, tuple(map(float, _bright(rng))), 3)
        else:
            ink = _bright(rng) if dark else np.array((40.0, 44, 60))
            _lines(rng, canvas, x + 6, y + 16, w - 12, h - 22, 9, ink)
    _rect(canvas, 0, 0, SIZE - 1, SIZE - 1, (16, 16, 18), 12)
    return canvas


def _keys(rng: Rng) -> Pixels:
    canvas = np.full((SIZE, SIZE, 3), 60, np.float32)
    for i in range(5):
        for j in range(14):
            shade = 225 if rng.uniform() < 0.85 else 140
            _rect(canvas, 8 + j * 17.3, 14 + i * 47, 13, 36, (shade, shade, shade + 4))
    return canvas


def _window(rng: Rng) -> Pixels:
    """The view from a window, with its frame."""
    ramp = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None, None]
    sky = np.array([150, 190, 235]) * (1 - ramp) + np.array([226, 236, 244]) * ramp
    canvas = np.ascontiguousarray(np.broadcast_to(sky, (SIZE, SIZE, 3)), np.float32) + 10 * _rgb(noise(rng, 5))
    x = 0.0
    while x < SIZE:
        w, h = rng.uniform(24, 60), rng.uniform(50, 150)
        color = rng.uniform(110, 190) * np.array([1.0, 0.96, 0.9])
        _rect(canvas, x, SIZE - h, w, h, color)
        for i in range(int(h // 16)):
            for j in range(int(w // 12)):
                _rect(canvas, x + 4 + 12 * j, SIZE - h + 5 + 16 * i, 6, 8, color * rng.uniform(0.45, 1.25))
        x += w
    _rect(canvas, 0, SIZE - 26, SIZE, 26, (96, 132, 84))
    frame = (238, 238, 236)
    _rect(canvas, 0, 0, SIZE - 1, SIZE - 1, frame, 16)
    _rect(canvas, SIZE / 2 - 5, 0, 10, SIZE, frame)
    return canvas


def _whiteboard(rng: Rng) -> Pixels:
    canvas = np.full((SIZE, SIZE, 3), 246, np.float32)
    inks = [(30.0, 40.0, 150.0), (170.0, 30.0, 36.0), (20.0, 110.0, 60.0), (30.0, 30.0, 34.0)]
    for _ in range(7):
        ink = inks[int(rng.integers(4))]
        x, y = rng.uniform(16, 150), rng.uniform(16, 200)
        if rng.uniform() < 0.5:
            strokes = rng.normal(0, [3, 5], (22, 2)) + np.array([3, 0])
            steps = np.cumsum(strokes, axis=0) + np.array([x, y])
            cv2.polylines(canvas, [steps.astype(np.int32)], False, ink, 2)
        else:
            _rect(canvas, x, y, rng.uniform(20, 70), rng.uniform(16, 40), ink, 2)
    _lines(rng, canvas, 24, 20, 150, 60, 14, inks[3])
    _rect(canvas, 0, 0, SIZE - 1, SIZE - 1, (170, 172, 176), 10)
    return canvas


def _door(rng: Rng) -> Pixels:
    """A door leaf: two sunken panels and grain."""
    canvas = _wood(rng).transpose(1, 0, 2).copy() * 1.05
    for y, h in ((22, 88), (134, 100)):
        _rect(canvas, 44, y, 168, h, (120, 116, 110), 4)
        canvas[y + 4 : y + h - 4, 48:208] *= 0.9
        _rect(canvas, 60, y + 14, 136, h - 28, (214, 208, 200), 2)
    return canvas


def _leaf(rng: Rng) -> Pixels:
    canvas = _rgb(_grey(rng, 190, (12, 26), (60, 18)))
    _rect(canvas, SIZE / 2 - 5, 0, 10, SIZE, (235, 240, 215))
    return canvas


def _ball(rng: Rng) -> Pixels:
    """Segments in two shades, like a beach ball's."""
    canvas = np.full((SIZE, SIZE, 3), 238, np.float32)
    second = _bright(rng)
    for k in range(0, 6, 2):
        _rect(canvas, k * SIZE / 6, 0, SIZE / 6, SIZE, second)
    _rect(canvas, 0, SIZE * 0.47, SIZE, SIZE * 0.06, (90, 90, 96))
    return canvas + 5 * _rgb(noise(rng, 64))


def _label(rng: Rng) -> Pixels:
    """A bottle's label or a mug's print, on a plain ground."""
    canvas = _rgb(_grey(rng, 236, (40, 5)))
    color = _bright(rng)
    _rect(canvas, 0, 96, SIZE, 96, color)
    for x in (0, SIZE // 2):
        cv2.circle(canvas, (x + 40, 144), 30, (250.0, 250.0, 244.0), -1)
        _lines(rng, canvas, x + 78, 110, 44, 70, 16, np.clip(color * 0.35, 0, 255))
    return canvas


def _robot(rng: Rng) -> Pixels:
    """A robot's shell: panels, a stripe, vents."""
    canvas = _rgb(_grey(rng, 235, (30, 4)))
    _rect(canvas, 0, 150, SIZE, 30, _bright(rng))
    for k in range(0, SIZE, 64):
        _rect(canvas, k, 0, 2, SIZE, (130, 130, 136))
        for j in range(5):
            _rect(canvas, k + 14, 30 + 12 * j, 34, 5, (60, 62, 70))
    return canvas


def _face(rng: Rng) -> Pixels:
    """A head's skin: eyes and mouth on the half towards +x (the seam of the lathe), the rest plain."""
    canvas = _rgb(_grey(rng, 236, (20, 4), (80, 3)))
    for side in (1, -1):
        x = int((side * 0.07 % 1) * SIZE)
        cv2.ellipse(canvas, (x, 116), (7, 5), 0, 0, 360, (250.0, 250.0, 250.0), -1)
        cv2.circle(canvas, (x, 116), 4, (34.0, 28.0, 26.0), -1)
        _rect(canvas, x - 8, 102, 16, 3, (70, 50, 44))
        _rect(canvas, x - 4 if side < 0 else 0, 166, 12, 5, (170, 74, 74))
    return canvas


_PAINTERS: dict[str, Callable[[Rng], Pixels]] = {
    name[1:]: painter
    for name, painter in list(globals().items())
    if name in (
        "_plain", "_plaster", "_wood", "_parquet", "_carpet", "_tiles", "_ceiling", "_fabric", "_checked", "_metal",
        "_cardboard", "_books", "_cover", "_poster", "_screen", "_keys", "_window", "_whiteboard", "_door", "_leaf",
        "_ball", "_label", "_robot", "_face",
    )
}  # fmt: skip
