"""Parts of an image around small things that were seen in it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.detection.focus.cells import MULTIPLE

Region = tuple[int, int, int, int]
"""x1, y1, x2, y2 in pixels, multiples of MULTIPLE; the last ones may be beyond the image."""
MARGIN = 16.0
"""Pixels around each box that belong to its region."""


def regions(boxes: NDArray[np.float32], size: tuple[int, int]) -> list[Region]:
    """Returns rectangles that hold the boxes (N, 4) in an image of `size` (width, height) and what is near them.

    Boxes that are near each other share one, so that rows of things stay together. Rectangles may share some pixels.
    """
    width, height = size
    marked = np.zeros((-(-height // MULTIPLE), -(-width // MULTIPLE)), np.uint8)
    limits = np.array([width - 1, height - 1] * 2)
    grown = np.clip(boxes + np.array([-MARGIN, -MARGIN, MARGIN, MARGIN]), 0, limits).astype(np.int64) // MULTIPLE
    for x1, y1, x2, y2 in grown.tolist():
        marked[y1 : y2 + 1, x1 : x2 + 1] = 1
    _, _, found, _ = cv2.connectedComponentsWithStats(marked, connectivity=4)
    return [
        (MULTIPLE * int(x), MULTIPLE * int(y), MULTIPLE * int(x + w), MULTIPLE * int(y + h))
        for x, y, w, h, _ in found[1:]
    ]


def pixels_of(region: Region) -> int:
    """Counts the pixels of a region."""
    x1, y1, x2, y2 = region
    return (x2 - x1) * (y2 - y1)
