"""Chooses and cuts out what is to be recognised: the whole image, or each object found in it."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image
from operators.image.letterbox import ImageFit
from operators.network_input import three_channels

Per = Literal["image", "object"]
MARGIN = 0.05
"""Share of a box by which it is enlarged on each side: boxes of detectors cut off rims."""


class Subjects:
    """Gives the views of each image. `missed` counts the images without detections of the same stamp."""

    def __init__(self, per: Per) -> None:
        self.per = per
        self.missed = 0

    def of(
        self, image: Image, detections: Detections2D | None
    ) -> tuple[list[NDArray[np.uint8]], NDArray[np.int64] | None]:
        """Returns views (h, w, 3) and the ids of what they show; none where objects are asked for and not known."""
        if self.per == "image":
            return views(image, None)
        if detections is None or detections.stamp != image.stamp:
            self.missed += 1
            return [], np.zeros(0, np.int64)
        return views(image, detections)

    def summary(self) -> dict[str, int]:
        """Counts, for an operator's summary; empty where there is nothing to report."""
        return {"images_without_detections": self.missed} if self.missed else {}


def views(image: Image, detections: Detections2D | None) -> tuple[list[NDArray[np.uint8]], NDArray[np.int64] | None]:
    """Returns RGB pixels (h, w, 3) of each thing to recognise, and the ids of the objects they show.

    Without detections that is the whole image, and there are no ids. Objects without an id are numbered from 0. A box
    that lies outside the image gives a view of one pixel at its edge, so that rows stay those of the detections.
    """
    pixels = three_channels(image.data)
    if detections is None:
        return [pixels], None
    cut = []
    for x1, y1, x2, y2 in detections.boxes.astype(np.float64):
        mx, my = MARGIN * (x2 - x1), MARGIN * (y2 - y1)
        left, right = _span(x1 - mx, x2 + mx, image.width)
        top, bottom = _span(y1 - my, y2 + my, image.height)
        cut.append(np.ascontiguousarray(pixels[top:bottom, left:right]))
    ids = np.arange(len(cut)) if detections.ids is None else detections.ids
    return cut, np.asarray(ids, np.int64)


def letterboxed(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Returns the view in the network's input of `size` (width, height), its proportions kept."""
    return ImageFit.plan("letterbox", (pixels.shape[1], pixels.shape[0]), size).apply(pixels)


def covering(pixels: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """Returns (side, side, 3): the middle square of the view, as networks for ImageNet are fed."""
    height, width = pixels.shape[:2]
    square = min(height, width)
    top, left = (height - square) // 2, (width - square) // 2
    shrinking = square > side
    cut = np.ascontiguousarray(pixels[top : top + square, left : left + square])
    how = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(cut, (side, side), interpolation=how), np.uint8)


def _span(first: float, last: float, extent: int) -> tuple[int, int]:
    """Whole pixels from first to last within an extent, one at least."""
    begin = int(np.clip(np.floor(first), 0, extent - 1))
    return begin, int(np.clip(np.ceil(last), begin + 1, extent))
