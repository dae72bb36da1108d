"""Random variation of training images: geometry as one affine map, and the camera's colour, noise and blur."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.image.letterbox import ImageFit

Affine = NDArray[np.float64]
"""(2, 3): pixel edges of the source image → pixel edges of the network's input; (0, 0) is the top left corner."""
Pixels = NDArray[np.uint8]

GREY = 114


@dataclass(frozen=True)
class Variation:
    """Strength of changes to a training image; zero turns a change off.

    `flip` is the probability of a mirror image, `scale` the largest factor of size (1.5: between 1/1.5 and 1.5),
    `shift` the share of the input by which the image moves at most, `color` the strength of changes of brightness,
    white balance, gamma and saturation, `noise` the largest standard deviation in grey levels, `blur` the probability
    of a blur.
    """

    flip: float = 0.5
    scale: float = 1.5
    shift: float = 0.2
    color: float = 0.3
    noise: float = 8.0
    blur: float = 0.15

    def times(self, strength: float) -> Variation:
        """Weaker or stronger changes, mirror images as often; 1 leaves all as it is."""
        return Variation(
            self.flip,
            self.scale**strength,
            self.shift * strength,
            self.color * strength,
            self.noise * strength,
            self.blur * strength,
        )


NONE = Variation(flip=0, scale=1, shift=0, color=0, noise=0, blur=0)


def fitted(image: tuple[int, int], target: tuple[int, int]) -> Affine:
    """The letterbox of an image (width, height) in the input, as the operator fits it at run time."""
    fit = ImageFit.plan("letterbox", image, target)
    sx, sy = fit.inner[0] / image[0], fit.inner[1] / image[1]
    return np.array([[sx, 0, fit.offset[0]], [0, sy, fit.offset[1]]], np.float64)


def varied(affine: Affine, target: tuple[int, int], variation: Variation, rng: np.random.Generator) -> Affine:
    """The map followed by a random mirror image, scale and shift about the middle of the input."""
    mirror = -1.0 if rng.random() < variation.flip else 1.0
    scale = variation.scale ** rng.uniform(-1, 1)
    shift = rng.uniform(-variation.shift, variation.shift, 2) * target
    middle = np.array(target) / 2
    linear = np.diag([scale * mirror, scale])
    change = np.column_stack([linear, middle - linear @ middle + shift])
    return np.column_stack([change[:, :2] @ affine[:, :2], change[:, :2] @ affine[:, 2] + change[:, 2]])


def warp(
    pixels: Pixels, affine: Affine, target: tuple[int, int], border: int = GREY, *, labels: bool = False
) -> Pixels:
    """The input (H', W'[, 3]) of an image under the map; class maps (`labels`) keep their values."""
    # OpenCV counts from pixel centres, the map from pixel edges.
    half = np.array([0.5, 0.5])
    centred = affine.copy()
    centred[:, 2] = affine[:, :2] @ half + affine[:, 2] - half
    warped = cv2.warpAffine(
        pixels,
        centred,
        target,
        flags=cv2.INTER_NEAREST if labels else cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(border, border, border),
    )
    return warped.astype(np.uint8, copy=False)


def recolored(pixels: Pixels, variation: Variation, rng: np.random.Generator) -> Pixels:
    """Another exposure, white balance, saturation, focus and sensor noise."""
    if variation.color:
        c = variation.color
        gain = 1 + rng.uniform(-c, c) + rng.uniform(-c / 3, c / 3, 3)
        shift = rng.uniform(-c, c) * 60
        gamma = float(np.exp(rng.uniform(-c, c)))
        levels = np.arange(256, dtype=np.float64)[:, None]
        table = np.clip((levels / 255) ** gamma * 255 * gain + shift, 0, 255).astype(np.uint8)
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)[..., None]
        pixels = cv2.LUT(pixels, table[None]).astype(np.uint8, copy=False)
        share = float(rng.uniform(0, c))
        if rng.random() < 0.5:
            pixels = cv2.addWeighted(pixels, 1 - share, np.repeat(grey, 3, axis=2), share, 0).astype(np.uint8)
    if variation.blur and rng.random() < variation.blur:
        pixels = cv2.GaussianBlur(pixels, (0, 0), float(rng.uniform(0.4, 1.3))).astype(np.uint8, copy=False)
    if variation.noise and rng.random() < 0.5:
        sigma = float(rng.uniform(0, variation.noise))
        cv2.setRNGSeed(int(rng.integers(1 << 31)))  # of this thread alone; many times faster than NumPy's
        noise = cv2.randn(np.empty(pixels.shape, np.int16), np.zeros(3), np.full(3, sigma))
        pixels = cv2.add(pixels, noise, dtype=cv2.CV_8U).astype(np.uint8, copy=False)
    return pixels


def tensor_of(pixels: Pixels) -> NDArray[np.float32]:
    """(3, H, W) in [0, 1] of (H, W, 3) RGB pixels: what the networks take."""
    return np.ascontiguousarray(pixels.transpose(2, 0, 1), np.float32) / np.float32(255)
