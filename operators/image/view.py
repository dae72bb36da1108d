"""Pinhole views of raw cameras: which part of an image without distortion is shown, how large, turned how.

Pixel (0, 0) is the centre of the first pixel, as in OpenCV: an image w pixels wide reaches from -0.5 to w - 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo
from operators.geometry.lens import undistorted
from operators.geometry.se3 import Matrix

Bounds = NDArray[np.float64]

_ALONG = 33  # places on each side of an image


def fitting_view(cameras: Sequence[tuple[CameraInfo, Matrix]], keep: float) -> Matrix:
    """Returns one K (3, 3) for the images of several cameras, of their size, each turned by its rectification (3, 3).

    With `keep` 0 every pixel shows something in all images; with 1 every pixel of each raw image is shown; between, the
    focal length is between. Pixels are square. Raises ValueError where a side of an image is not before the camera.
    """
    inner, outer = np.array([-np.inf, -np.inf, np.inf, np.inf]), np.array([np.inf, np.inf, -np.inf, -np.inf])
    for info, R in cameras:
        left, top, right, bottom = (_seen(info, R, side) for side in _sides(info.width, info.height))
        own = np.array([left[:, 0].max(), top[:, 1].max(), right[:, 0].min(), bottom[:, 1].min()])
        inner = np.concatenate([np.maximum(inner, own)[:2], np.minimum(inner, own)[2:]])
        every = np.concatenate([left, top, right, bottom])
        outer = np.concatenate([np.minimum(outer[:2], every.min(axis=0)), np.maximum(outer[2:], every.max(axis=0))])
    if not (inner[:2] < inner[2:]).all():
        raise ValueError("the cameras see nothing in common: no pixel is in all images")
    extent = np.array([cameras[0][0].width - 1, cameras[0][0].height - 1], np.float64)
    focal_in = float((extent / (inner[2:] - inner[:2])).max())
    focal_out = float((extent / (outer[2:] - outer[:2])).min())
    focal = (1 - keep) * focal_in + keep * focal_out
    middle = (1 - keep) * (inner[:2] + inner[2:]) / 2 + keep * (outer[:2] + outer[2:]) / 2
    cx, cy = extent / 2 - focal * middle
    return np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])


def _sides(width: int, height: int) -> list[Bounds]:
    """Pixels along the left, top, right and bottom side."""
    x, y = np.linspace(0, width - 1, _ALONG), np.linspace(0, height - 1, _ALONG)
    zero = np.zeros(_ALONG)
    return [
        np.column_stack(pair)
        for pair in ((zero, y), (x, zero), (zero + width - 1, y), (x, zero + height - 1))
    ]  # fmt: skip


def _seen(info: CameraInfo, R: Matrix, pixels: Bounds) -> Bounds:
    rays = np.column_stack([undistorted(pixels, info), np.ones(len(pixels))]) @ R.T
    if not (rays[:, 2] > 1e-3).all():
        raise ValueError(f"the rectification of {info.frame!r} turns a side of its image behind the camera")
    return np.asarray(rays[:, :2] / rays[:, 2:])


@dataclass(frozen=True)
class Window:
    """A part of an image, `x`, `y`, `width`, `height` in its pixels, shown with `columns` x `rows` pixels."""

    x: int
    y: int
    width: int
    height: int
    columns: int
    rows: int

    @classmethod
    def of(
        cls, size: tuple[int, int], crop: tuple[int, int, int, int] | None, columns: int | None, rows: int | None
    ) -> Window:
        """Returns the window of an image of `size` (width, height) that is cropped, then scaled.

        `crop` is x, y, width, height. One of `columns` and `rows` alone keeps the aspect ratio. Raises ValueError
        where the crop reaches outside the image.
        """
        x, y, width, height = crop or (0, 0, *size)
        if min(x, y) < 0 or min(width, height) < 1 or x + width > size[0] or y + height > size[1]:
            raise ValueError(f"crop {[x, y, width, height]} reaches outside the image of {size[0]}x{size[1]} pixels")
        if columns is None and rows is None:
            columns, rows = width, height
        elif columns is None:
            assert rows is not None
            columns = max(1, round(width * rows / height))
        elif rows is None:
            rows = max(1, round(height * columns / width))
        return cls(x, y, width, height, columns, rows)

    def seen_through(self, info: CameraInfo) -> CameraInfo:
        """Returns the calibration of the window, of one of the image; distortion coefficients hold for both."""
        sx, sy = self.columns / self.width, self.rows / self.height
        # Pixels scale about the image's corner, which lies half a pixel before the first pixel's centre.
        S = np.array([[sx, 0, (0.5 - self.x) * sx - 0.5], [0, sy, (0.5 - self.y) * sy - 0.5], [0, 0, 1]])
        return info.replace(
            width=self.columns, height=self.rows, K=S @ info.K, P=None if info.P is None else S @ info.P
        )
