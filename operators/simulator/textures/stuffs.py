"""Textures of what things and buildings are made of. They repeat without a seam."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from operators.simulator.textures.painting import SIZE, Pixels, Rng, grey, noise, rgb


def plain(rng: Rng) -> Pixels:
    return rgb(grey(rng, 232, (64, 5), (16, 5), (128, 4)))


def plaster(rng: Rng) -> Pixels:
    return rgb(grey(rng, 222, (4, 3), (24, 5), (90, 7), (200, 5)))


def wood(rng: Rng) -> Pixels:
    y = np.arange(SIZE, dtype=np.float32)[:, None] / SIZE
    warp = 0.05 * noise(rng, 3, 4) + 0.012 * noise(rng, 6, 24)
    rings = np.sin(2 * np.pi * (9 * (y + warp)))
    grain = noise(rng, 8, 128) * 9 + noise(rng, 16, 250) * 5
    value = 200 + 22 * rings + grain
    return np.asarray(value[..., None] * np.array([1.0, 0.97, 0.92], np.float32))


def parquet(rng: Rng) -> Pixels:
    canvas = wood(rng)
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


def carpet(rng: Rng) -> Pixels:
    return rgb(grey(rng, 190, (5, 6), (40, 8), (128, 22), (250, 18)))


def tiles(rng: Rng) -> Pixels:
    value = grey(rng, 212, (20, 6), (100, 6))
    n = 4
    side = SIZE // n
    for i in range(n):
        for j in range(n):
            value[i * side : (i + 1) * side, j * side : (j + 1) * side] *= rng.uniform(0.84, 1.08)
    for k in range(n):
        value[k * side : k * side + 3] = 120
        value[:, k * side : k * side + 3] = 120
    return rgb(value + 3 * noise(rng, 200))


def ceiling(rng: Rng) -> Pixels:
    value = grey(rng, 232, (120, 8), (220, 7))
    value[:3], value[:, :3] = 165, 165
    return rgb(value)


def fabric(rng: Rng) -> Pixels:
    weave = 14 * (np.indices((SIZE, SIZE)).sum(axis=0) // 3 % 2) - 7
    return rgb(grey(rng, 205, (10, 8), (60, 9), (128, 9)) + weave.astype(np.float32))


def checked(rng: Rng) -> Pixels:
    """A shirt: stripes both ways."""
    stripes = np.zeros((SIZE, SIZE), np.float32)
    for k in range(0, SIZE, 32):
        stripes[:, k : k + 12] -= 50
        stripes[k : k + 12] -= 50
    return rgb(225 + stripes) + 6 * rgb(noise(rng, 120))


def metal(rng: Rng) -> Pixels:
    return rgb(195 + 8 * noise(rng, 4, 200) + 4 * noise(rng, 16))


def asphalt(rng: Rng) -> Pixels:
    return rgb(grey(rng, 150, (6, 8), (60, 8), (200, 22)))


def grass(rng: Rng) -> Pixels:
    blades = grey(rng, 170, (8, 14), (100, 20), (250, 26))
    return np.asarray(blades[..., None] * np.array([0.62, 0.9, 0.45], np.float32))


PAINTERS: dict[str, Callable[[Rng], Pixels]] = {
    painter.__name__: painter
    for painter in (plain, plaster, wood, parquet, carpet, tiles, ceiling, fabric, checked, metal, asphalt, grass)
}
