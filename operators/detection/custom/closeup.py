"""The view that a refiner has of each box: a close-up of the image around it, and numbers for place and kind."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
Pixels = NDArray[np.uint8]

MARGIN, PIXELS = 0.25, 2.0
"""A close-up reaches beyond the box by this share of its size and by so many pixels on each side."""
_GREY = 114  # beyond the image, as in the network's input
_LEVELS = 4
_PLACES = 11


def windows(boxes: F32) -> F32:
    """The part of the image (N, 4) that the close-up of each box (N, 4) shows."""
    reach = MARGIN * (boxes[:, 2:] - boxes[:, :2]) + np.float32(PIXELS)
    return np.concatenate([boxes[:, :2] - reach, boxes[:, 2:] + reach], axis=1).astype(np.float32)


def closeups(pixels: Pixels, seen: F32, side: int) -> Pixels:
    """Parts (N, side, side, 3) of an image (H, W, 3): each window (N, 4) stretched to a square.

    What is shown smaller is taken from the image halved as often as fits the mean of both directions.
    """
    found = np.empty((len(seen), side, side, 3), np.uint8)
    halved: list[Pixels] = [pixels]
    shrunk = np.maximum((seen[:, 2:] - seen[:, :2]).astype(np.float64) / side, 1e-6)
    levels = np.clip(np.round(np.log2(shrunk).mean(axis=1)), 0, _LEVELS).astype(int)
    for level in range(1, int(levels.max(initial=0)) + 1):
        height, width = halved[-1].shape[0] // 2, halved[-1].shape[1] // 2
        if min(height, width) < 1:
            levels = np.minimum(levels, level - 1)
            break
        smaller = cv2.resize(halved[-1][: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        halved.append(smaller.astype(np.uint8, copy=False))
    # OpenCV counts from pixel centres, boxes from pixel edges.
    steps = shrunk / 2.0 ** levels[:, None]
    firsts = seen[:, :2] / 2.0 ** levels[:, None] + steps / 2 - 0.5
    affine = np.zeros((2, 3))
    for k, (level, step, first) in enumerate(zip(levels.tolist(), steps, firsts, strict=True)):
        affine[0, 0], affine[1, 1], affine[:, 2] = step[0], step[1], first
        cv2.warpAffine(
            halved[level],
            affine,
            (side, side),
            dst=found[k],
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(_GREY, _GREY, _GREY),
        )
    return found


def places(boxes: F32, scores: F32, classes: NDArray[np.int32], count: int, size: tuple[int, int]) -> F32:
    """Numbers (N, F) about boxes in an image of `size` (width, height): which of `count` classes, how large, how far
    from the image's borders, and how sure the detector was."""
    extent = np.maximum(boxes[:, 2:] - boxes[:, :2], 1e-3)
    reach = MARGIN * extent + PIXELS
    seen = extent + 2 * reach
    shares = extent / seen
    before = boxes[:, :2] / seen
    after = (np.array(size, np.float32) - boxes[:, 2:]) / seen
    sure = np.clip(scores, 1e-3, 1 - 1e-3)
    columns = [
        np.log2(extent) / 4 - 1,
        np.log2(extent[:, :1] / extent[:, 1:]) / 2,
        shares,
        np.clip(before, -0.5, 0.5),
        np.clip(after, -0.5, 0.5),
        (np.log(sure / (1 - sure)) / 4)[:, None],
        np.full((len(boxes), 1), np.log2(size[0] / 640), np.float32),
    ]
    return np.concatenate([*columns, np.eye(count, dtype=np.float32)[classes]], axis=1).astype(np.float32)


def numbers(classes: int) -> int:
    """Counts the numbers that `places` gives for each box."""
    return _PLACES + classes


def moved(boxes: F32, sides: F32, size: tuple[int, int]) -> F32:
    """Boxes (N, 4) whose sides move by shares (N, 4) of their windows' width and height, cut at the image's border."""
    seen = windows(boxes)
    extent = seen[:, 2:] - seen[:, :2]
    there = boxes + sides * np.concatenate([extent, extent], axis=1)
    limits = np.array([*size, *size], np.float32)
    corners = np.clip(there, 0, limits)
    low, high = np.minimum(corners[:, :2], corners[:, 2:]), np.maximum(corners[:, :2], corners[:, 2:])
    return np.concatenate([low, high], axis=1).astype(np.float32)
