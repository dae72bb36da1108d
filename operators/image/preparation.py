"""Prepares every image of one camera: lens distortion, rotation, crop, scale, brightness."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo
from operators.geometry.lens import is_distorted, tables
from operators.geometry.se3 import Matrix
from operators.image.view import Window

Picture = NDArray[np.uint8]
Tone = Literal["none", "stretch", "equalize", "clahe"]


class Preparation:
    """Prepares images of one calibration; `info` is the calibration of what comes out."""

    def __init__(
        self, raw: CameraInfo, ideal: CameraInfo, window: Window, *, R: Matrix | None = None, tone: Tone = "none"
    ) -> None:
        """`ideal` is the calibration before the window, `R` (3, 3) the rectification; None leaves the lens as it is."""
        self.info = window.seen_through(ideal)
        self.empty = 0  # pixels that show nothing: the lens does not look there
        self._window, self._tone = window, tone
        self._tables = None
        if R is not None and not (same_rays(raw, ideal) and np.array_equal(R, np.eye(3))):
            self._tables = tables(raw, R, ideal.K, (ideal.width, ideal.height))
            self.empty = int((~self._shown(raw)).sum())

    def apply(self, pixels: Picture) -> Picture:
        """Returns the prepared image of raw pixels (H, W) or (H, W, 3)."""
        w = self._window
        if self._tables is not None:
            columns, rows = self._tables
            pixels = np.asarray(
                cv2.remap(pixels, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), np.uint8
            )
        pixels = pixels[w.y : w.y + w.height, w.x : w.x + w.width]
        if (w.columns, w.rows) != (w.width, w.height):
            shrinking = w.columns <= w.width and w.rows <= w.height
            how = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
            pixels = np.asarray(cv2.resize(pixels, (w.columns, w.rows), interpolation=how), np.uint8)
        return toned(np.ascontiguousarray(pixels), self._tone)

    def _shown(self, raw: CameraInfo) -> NDArray[np.bool_]:
        """Returns which pixels of the window, before it is scaled, show a part of the raw image."""
        assert self._tables is not None
        w = self._window
        columns, rows = (table[w.y : w.y + w.height, w.x : w.x + w.width] for table in self._tables)
        return (columns > -0.5) & (rows > -0.5) & (columns < raw.width - 0.5) & (rows < raw.height - 0.5)


def same_rays(raw: CameraInfo, ideal: CameraInfo) -> bool:
    """Returns whether pixels of both see the same, so that none needs to be sampled again."""
    size = (raw.width, raw.height) == (ideal.width, ideal.height)
    return size and not is_distorted(raw) and np.array_equal(raw.K, ideal.K)


def toned(pixels: Picture, tone: Tone) -> Picture:
    """Returns an image with its brightness normalised; of colour images hue and saturation stay.

    `stretch` maps the 1st and 99th percentile to black and white, `equalize` makes all values equally frequent, and
    `clahe` does so in 8 x 8 parts, contrast limited (Zuiderveld, "Contrast limited adaptive histogram equalization",
    1994).
    """
    if tone == "none":
        return pixels
    if pixels.ndim == 3:
        lab = cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB)
        lab[..., 0] = toned(np.ascontiguousarray(lab[..., 0]), tone)
        return np.asarray(cv2.cvtColor(lab, cv2.COLOR_LAB2RGB), np.uint8)
    if tone == "equalize":
        return np.asarray(cv2.equalizeHist(pixels), np.uint8)
    if tone == "clahe":
        return np.asarray(cv2.createCLAHE(clipLimit=2.0, tileGridSize=(8, 8)).apply(pixels), np.uint8)
    ordered = np.cumsum(np.bincount(pixels.ravel(), minlength=256))
    low, high = np.searchsorted(ordered, np.array([0.01, 0.99]) * pixels.size)
    levels = (np.arange(256) - low) * (255.0 / max(1, int(high) - int(low)))
    return np.asarray(cv2.LUT(pixels, np.clip(np.rint(levels), 0, 255).astype(np.uint8)), np.uint8)


def grey_of(pixels: Picture) -> Picture:
    """Returns grey values (H, W) of RGB (H, W, 3) or grey pixels."""
    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
