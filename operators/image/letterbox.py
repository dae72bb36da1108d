"""Fitting an image into a network's input, and boxes back into the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

FitMode = Literal["stretch", "letterbox", "corner"]
"""The image fills the input, lies in its middle, or in its top left corner; the last two keep its aspect ratio."""

_GREY = 114  # the border that YOLO networks are trained with


@dataclass(frozen=True)
class ImageFit:
    """An image of size `image` inside an input of size `target`, both (width, height).

    The image takes `inner` pixels at `offset`: all of the input when stretched, its middle when letterboxed. `scale`
    holds the pixels of the image for one of the input, across and down.
    """

    image: tuple[int, int]
    target: tuple[int, int]
    inner: tuple[int, int]
    offset: tuple[int, int]
    scale: tuple[float, float]

    @classmethod
    def plan(cls, mode: FitMode, image: tuple[int, int], target: tuple[int, int]) -> ImageFit:
        if mode == "stretch":
            return cls(image, target, target, (0, 0), (image[0] / target[0], image[1] / target[1]))
        scale = min(target[0] / image[0], target[1] / image[1])
        if mode == "corner":  # rounded and scaled as YOLOX does
            return cls(image, target, _floored(image, scale), (0, 0), (1 / scale, 1 / scale))
        width, height = (max(1, min(t, round(i * scale))) for i, t in zip(image, target, strict=True))
        offset = ((target[0] - width) // 2, (target[1] - height) // 2)
        return cls(image, target, (width, height), offset, (image[0] / width, image[1] / height))

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The input image (H', W', 3) of an image (H, W, 3)."""
        resized: NDArray[np.uint8] = image
        if self.inner != self.image:
            resized = cv2.resize(image, self.inner, interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)
        return self.framed(resized)

    def framed(self, resized: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The input image of the image at its `inner` size, (h, w, 3)."""
        if self.inner == self.target:
            return resized
        padded = np.full((self.target[1], self.target[0], 3), _GREY, np.uint8)
        (x, y), (width, height) = self.offset, self.inner
        padded[y : y + height, x : x + width] = resized
        return padded

    def restore(self, boxes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Boxes (N, 4) x1, y1, x2, y2 of the input as boxes of the image, cut at its border."""
        offset = np.array([*self.offset, *self.offset], np.float32)
        scale = np.array([*self.scale, *self.scale], np.float32)
        limit = np.array([*self.image, *self.image], np.float32)
        restored: NDArray[np.float32] = np.clip((boxes - offset) * scale, 0, limit).astype(np.float32)
        return restored


def _floored(image: tuple[int, int], scale: float) -> tuple[int, int]:
    return max(1, int(image[0] * scale)), max(1, int(image[1] * scale))
