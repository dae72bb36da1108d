"""Fitting an image into a network's input, and boxes back into the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

FitMode = Literal["stretch", "letterbox"]

_GREY = 114  # the border that YOLO networks are trained with


@dataclass(frozen=True)
class Fit:
    """An image of size `image` inside an input of size `target`, both (width, height).

    The image takes `inner` pixels at `offset`: all of the input when stretched, its middle when letterboxed.
    """

    image: tuple[int, int]
    target: tuple[int, int]
    inner: tuple[int, int]
    offset: tuple[int, int]

    @classmethod
    def plan(cls, mode: FitMode, image: tuple[int, int], target: tuple[int, int]) -> Fit:
        if mode == "stretch":
            return cls(image, target, target, (0, 0))
        scale = min(target[0] / image[0], target[1] / image[1])
        width, height = (max(1, min(t, round(i * scale))) for i, t in zip(image, target, strict=True))
        return cls(image, target, (width, height), ((target[0] - width) // 2, (target[1] - height) // 2))

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The input image (H', W', 3) of an image (H, W, 3)."""
        resized: NDArray[np.uint8] = image
        if self.inner != self.image:
            resized = cv2.resize(image, self.inner, interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)
        if self.inner == self.target:
            return resized
        padded = np.full((self.target[1], self.target[0], 3), _GREY, np.uint8)
        (x, y), (width, height) = self.offset, self.inner
        padded[y : y + height, x : x + width] = resized
        return padded

    def restore(self, boxes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Boxes (N, 4) x1, y1, x2, y2 of the input as boxes of the image, cut at its border."""
        offset = np.array([*self.offset, *self.offset], np.float32)
        scale = np.array([i / n for i, n in zip(self.image, self.inner, strict=True)] * 2, np.float32)
        limit = np.array([*self.image, *self.image], np.float32)
        restored: NDArray[np.float32] = np.clip((boxes - offset) * scale, 0, limit).astype(np.float32)
        return restored
