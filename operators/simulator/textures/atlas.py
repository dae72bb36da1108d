"""The atlas that holds all textures, with smaller copies for surfaces far away."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.simulator.textures import prints, stuffs
from operators.simulator.textures.painting import SIZE, Pixels, Rng

BORDER = 8  # texels repeated around a pattern, so that interpolation never sees its neighbour
LEVELS = 4  # each half the size of the one before
_CELL = SIZE + 2 * BORDER
_PER_ROW = 8
_PAINTERS: dict[str, Callable[[Rng], Pixels]] = {**stuffs.PAINTERS, **prints.PAINTERS}


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
    """Returns SIZE by SIZE texels that its name and the seed alone decide. Raises ValueError for an unknown name."""
    kind = name.split(":")[0]
    painter = _PAINTERS.get(kind)
    if painter is None:
        raise ValueError(f"no texture pattern {kind!r}; there are {', '.join(sorted(_PAINTERS))}")
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return np.clip(painter(rng), 0, 255).astype(np.float32)
