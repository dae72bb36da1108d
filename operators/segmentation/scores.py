"""Classes and their probability from a network's scores in 8 bits, at half the resolution of what is asked for.

Pixel (2i, 2j) has the scores of cell (i, j); between cells lies their mean, beyond the last its own. The class of a
pixel is the one of the greatest score, of equal ones the first. Sums of integers give it exactly, many times as fast as
an ONNX graph that enlarges every class's scores in float.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BITS = 5  # of a key that number the class; the other eleven hold the sum of four scores
MOST_CLASSES = 1 << _BITS


def best_classes(scores: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns the class (2H, 2W) of each pixel of scores (C, H, W), at most 32 classes."""
    count, height, width = scores.shape
    if count > MOST_CLASSES:
        raise ValueError(f"at most {MOST_CLASSES} classes, got {count}")
    cells = np.empty((height + 1, width + 1), np.uint16)
    best = np.zeros((2, 2, height, width), np.uint16)  # the greatest keys, by row and column in the cell
    for k in range(count):  # one class at a time stays in the cache
        np.left_shift(scores[k], _BITS, out=cells[:-1, :-1], dtype=np.uint16)
        cells[-1, :-1], cells[:, -1] = cells[-2, :-1], cells[:, -2]
        beside = cells[:, :-1] + cells[:, 1:]
        order = np.uint16(MOST_CLASSES - 1 - k)
        for row, column, sums in (
            (0, 0, cells[:-1, :-1] + order),
            (0, 1, beside[:-1] + order),
            (1, 0, cells[:-1, :-1] + cells[1:, :-1] + order),
            (1, 1, beside[:-1] + beside[1:] + order),
        ):
            np.maximum(best[row, column], sums, out=best[row, column])
    classes = (MOST_CLASSES - 1 - (best & (MOST_CLASSES - 1))).astype(np.uint8)
    return np.ascontiguousarray(classes.transpose(2, 0, 3, 1)).reshape(2 * height, 2 * width)


def probability(scores: NDArray[np.uint8], step: float) -> NDArray[np.float32]:
    """Returns the probability (2H, 2W) of the best class, by softmax of scores (C, H, W) of so much each."""
    below = (scores.max(axis=0) - scores).astype(np.float32) * np.float32(step)
    cells = np.pad(1 / np.exp(-below).sum(axis=0, dtype=np.float32), ((0, 1), (0, 1)), mode="edge")
    height, width = scores.shape[1:]
    sure = np.empty((2 * height, 2 * width), np.float32)
    beside = (cells[:, :-1] + cells[:, 1:]) / 2
    sure[::2, ::2], sure[::2, 1::2] = cells[:-1, :-1], beside[:-1]
    sure[1::2, ::2], sure[1::2, 1::2] = (cells[:-1, :-1] + cells[1:, :-1]) / 2, (beside[:-1] + beside[1:]) / 2
    return sure
