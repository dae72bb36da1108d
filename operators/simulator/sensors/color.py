"""From the light that reaches a camera to its pixels: exposure, motion blur, noise, rounding.

Noise is cheap: a pool of normal numbers drawn once, read from a place that is drawn for every image.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Rng = np.random.Generator

_POOL = 1 << 21


class NoisePool:
    """Normal numbers of unit variance. An image takes a run of them: 0.3 ms instead of 10 for VGA colour."""

    def __init__(self, seed: int) -> None:
        self._pool = np.random.default_rng([seed, 77]).standard_normal(_POOL, np.float32)

    def take(self, rng: Rng, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """An array of a shape; not to be written to."""
        count = int(np.prod(shape))
        if count > _POOL // 2:
            return rng.standard_normal(shape, np.float32)
        start = int(rng.integers(0, _POOL - count))
        return self._pool[start : start + count].reshape(shape)


def expose(light: F32, gain: float) -> F32:
    """Light times gain with a soft shoulder: bright places keep their texture instead of turning white."""
    return np.asarray(255 * (1 - np.exp(light * np.float32(-1.55 * gain / 255))), np.float32)


def drifting_gain(t: float, change: float, seed: int) -> float:
    """Exposure that swings slowly and never repeats exactly."""
    phase = (seed * 0.754877) % 1 * 2 * math.pi
    return 1 + change * 0.6 * math.sin(0.71 * t + phase) + change * 0.4 * math.sin(1.93 * t + 2 * phase)


def blur(image: F32, shift: tuple[float, float]) -> F32:
    """Smears an image along a shift in pixels (column, row), the same everywhere: a turn during the exposure."""
    length = math.hypot(*shift)
    if length < 0.5:
        return image
    half = math.ceil(length / 2)
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for share in np.linspace(-0.5, 0.5, 8 * half + 1):
        kernel[round(half + share * shift[1]), round(half + share * shift[0])] += 1
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.float32)


def develop(image: F32, pool: NoisePool, rng: Rng, read_noise: float, shot_noise: float) -> U8:
    """Adds noise of standard deviation sqrt(read² + shot² · brightness) and rounds to bytes."""
    if read_noise == 0 and shot_noise == 0:
        noisy = image
    else:
        deviation = cv2.sqrt(np.maximum(image, 0) * np.float32(shot_noise**2) + np.float32(read_noise**2))
        noisy = image + pool.take(rng, image.shape) * deviation
    return np.asarray(cv2.convertScaleAbs(np.maximum(noisy, 0)), np.uint8)


def grey(image: F32) -> F32:
    """Luma of an RGB image."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.float32)


def jpeg(pixels: U8, quality: int) -> U8:
    """The bytes (N,) of a JPEG file."""
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"an image of shape {pixels.shape} could not be encoded as JPEG")
    return np.asarray(data.reshape(-1), np.uint8)
