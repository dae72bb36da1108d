"""Close-ups of boxes: square parts of an image around them, all of one size."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

SIDE = 32
"""Pixels along a side of a close-up."""
AROUND = 1.6
"""Side of the part of the image, in longer sides of the box."""
_LEAST = 10  # pixels of the image along a side


def closeups(pixels: U8, boxes: F32) -> U8:
    """Returns (N, SIDE, SIDE, 3): what an image (H, W, 3) shows of boxes (N, 4) and around them.

    Beyond the image its border goes on.
    """
    found = np.empty((len(boxes), SIDE, SIDE, 3), np.uint8)
    height, width = pixels.shape[:2]
    middles = np.clip((boxes[:, :2] + boxes[:, 2:]).astype(np.float64) / 2, 0, (width, height))
    longer = (boxes[:, 2:] - boxes[:, :2]).max(axis=1, initial=0.0)
    sides = np.maximum(np.rint(AROUND * longer), _LEAST).astype(int)
    for k, ((x, y), side) in enumerate(zip(middles.tolist(), sides.tolist(), strict=True)):
        left, top = round(x - side / 2), round(y - side / 2)
        right, bottom = left + side, top + side
        part = pixels[max(0, top) : max(0, bottom), max(0, left) : max(0, right)]
        above, below = max(0, -top), max(0, bottom - height)
        before, after = max(0, -left), max(0, right - width)
        if above or below or before or after:
            bordered = cv2.copyMakeBorder(part, above, below, before, after, cv2.BORDER_REPLICATE)
            part = bordered.astype(np.uint8, copy=False)
        how = cv2.INTER_AREA if side > SIDE else cv2.INTER_LINEAR
        found[k] = cv2.resize(part, (SIDE, SIDE), interpolation=how)
    return found
