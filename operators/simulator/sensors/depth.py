"""The depth camera's error model: noise and steps that grow with z², holes at edges and on slanted surfaces.

The camera measures inverse depth v · quantum with an integer v. That integer is what a 16-bit PNG holds, so the
compressed stream loses nothing.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.simulator.rendering.optics import View
from operators.simulator.sensors.color import NoisePool
from operators.simulator.settings import DepthCamera

F32 = NDArray[np.float32]
U16 = NDArray[np.uint16]

_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 6, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
"""Noise defeats PNG's filters: without them files are a tenth smaller and made in less time."""

_STEP = 0.04  # a change of depth by this share between neighbours is an edge


def measure(view: View, camera: DepthCamera, pool: NoisePool, rng: np.random.Generator) -> U16:
    """The integers (H, W) that the camera reads; 0 for no return."""
    truth = view.depth
    seen = (truth >= camera.min_range) & (truth <= camera.max_range) & (view.cosine >= camera.grazing)
    inverse = np.where(seen, 1 / np.maximum(truth, 1e-3), 0).astype(np.float32)
    steps = inverse * np.float32(1 / ((1 + camera.bias) * camera.quantum))
    if camera.noise > 0:
        steps = steps + _grained(pool, rng, truth.shape, camera.grain) * np.float32(camera.noise / camera.quantum)
    levels = np.clip(np.rint(steps), 1, 65535)
    if camera.edge_holes > 0:
        around = np.ones((3, 3), np.uint8)
        brink = cv2.dilate(inverse, around) - cv2.erode(inverse, around) > _STEP * inverse
        seen &= ~(brink & (_uniform(pool, rng, truth.shape) < camera.edge_holes))
    if camera.specks > 0:
        seen &= _uniform(pool, rng, truth.shape) >= camera.specks
    if camera.missing > 0:
        seen &= ~_patches(rng, truth.shape, camera.missing)
    return np.where(seen, levels, 0).astype(np.uint16)


def metres(levels: U16, quantum: float) -> F32:
    """The depths (H, W) of integers: scale / v with scale = 1 / quantum, 0 where v is 0."""
    scale = 1 / quantum
    return np.where(levels > 0, scale / np.maximum(levels, 1).astype(np.float64), 0).astype(np.float32)


def png(levels: U16) -> NDArray[np.uint8]:
    """The bytes (N,) of a 16-bit grey PNG file."""
    done, data = cv2.imencode(".png", levels, _PNG)
    if not done:
        raise ValueError(f"depth of shape {levels.shape} could not be encoded as PNG")
    return np.asarray(data.reshape(-1), np.uint8)


def _grained(pool: NoisePool, rng: np.random.Generator, shape: tuple[int, ...], grain: int) -> F32:
    """Noise (H, W) of unit standard deviation that is alike over `grain` pixels, as windows that are matched make it.

    Drawn on a coarser grid and interpolated linearly, which lessens the deviation; that is made up for.
    """
    if grain == 1:
        return pool.take(rng, shape)
    height, width = shape
    coarse = pool.take(rng, (height // grain + 2, width // grain + 2))
    size = (coarse.shape[1] * grain, coarse.shape[0] * grain)
    full = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)
    gain = np.float32(1 / interpolated_deviation(grain))
    return np.asarray(full[grain : grain + height, grain : grain + width] * gain, np.float32)


@lru_cache(maxsize=16)
def interpolated_deviation(grain: int) -> float:
    """Standard deviation of noise of unit deviation after enlarging it `grain` times by linear interpolation.

    A pixel at the share f between two cells has the variance (1 - f)² + f² along each axis, so the deviation of the
    image, root mean square over both axes, is the mean of that over a cell's pixels.
    """
    f = ((np.arange(grain) + 0.5) / grain - 0.5) % 1
    return float(np.mean((1 - f) ** 2 + f**2))


def _patches(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> NDArray[np.bool_]:
    """Patches (H, W) that cover a share of the image, each a few tenths of it wide."""
    field = cv2.resize(rng.standard_normal((6, 8)), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(field <= np.quantile(field, share))


def _uniform(pool: NoisePool, rng: np.random.Generator, shape: tuple[int, ...]) -> F32:
    """Numbers in [0, 1), made of the fractions of the pool's numbers."""
    value = pool.take(rng, shape) * np.float32(997.0)
    return np.asarray(value - np.floor(value), np.float32)
