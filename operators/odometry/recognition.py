"""Recognising a view again after a loss: descriptors that bear other distances and angles.

Lowe, "Distinctive image features from scale-invariant keypoints", 2004. They cost ten times what tracking does, so
they are made of a keyframe only when a lost camera asks for it.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels
from operators.odometry.features import Gray

COUNT = 500
RATIO = 0.8  # a match is distinctive where the second nearest is so much farther
DOUBTFUL = 0.9  # the same, where the whole of many matches is judged
GROWTH = 1.6  # factor by which the same thing may look larger or smaller, where its depth is known


@dataclass(frozen=True, eq=False)
class Description:
    """Pixels (N, 2) of a working image, their descriptors (N, 128), and how many pixels (N,) each describes across.

    SIFT's descriptors are whole numbers up to 255: as bytes a map of keyframes takes a quarter of the memory.
    """

    pixels: Pixels
    descriptors: NDArray[np.uint8]
    sizes: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))


def describe(gray: Gray) -> Description:
    points, descriptors = cv2.SIFT.create(COUNT, contrastThreshold=0.02).detectAndCompute(gray, None)
    if descriptors is None:
        return Description(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    pixels, sizes = np.array([p.pt for p in points], np.float64), np.array([p.size for p in points], np.float64)
    return Description(pixels, descriptors.astype(np.uint8), sizes)


def match(a: Description, b: Description) -> NDArray[np.int64]:
    """Returns pairs of indices (M, 2), each b once, that are distinctly nearest."""
    if len(a.descriptors) < 2 or len(b.descriptors) < 2:
        return np.zeros((0, 2), np.int64)
    here, there = a.descriptors.astype(np.float32), b.descriptors.astype(np.float32)
    candidates = cv2.BFMatcher(cv2.NORM_L2).knnMatch(here, there, k=2)
    best: dict[int, tuple[float, int]] = {}
    for pair in candidates:
        if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance:
            m = pair[0]
            if m.trainIdx not in best or m.distance < best[m.trainIdx][0]:
                best[m.trainIdx] = (m.distance, m.queryIdx)
    return np.array([(query, train) for train, (_, query) in sorted(best.items())], np.int64).reshape(-1, 2)


def match_of_size(
    a: NDArray[np.uint8], b: NDArray[np.uint8], size_a: NDArray[np.float64], size_b: NDArray[np.float64], most: int
) -> NDArray[np.int64]:
    """Returns pairs of indices (M, 2) of descriptors, each b once, that are distinctly nearest of a like size (metres).

    What is as large there as here leaves fewer rivals than all do, so more of the right ones are distinct. The nearest
    come first, at most `most` of them.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    here, there = a.astype(np.float32), b.astype(np.float32)
    square = (here * here).sum(axis=1)[:, None] + (there * there).sum(axis=1) - 2.0 * (here @ there.T)
    unlike = np.abs(np.log(size_a)[:, None] - np.log(size_b)) > np.log(GROWTH)
    square = np.where(unlike, np.float32(np.inf), np.maximum(square, 0.0))
    nearest = np.argmin(square, axis=1)
    rows = np.arange(len(a))
    first = square[rows, nearest]
    square[rows, nearest] = np.inf
    second = square.min(axis=1)
    distinct = np.flatnonzero(np.isfinite(first) & (first < DOUBTFUL**2 * second))
    order = distinct[np.argsort(first[distinct], kind="stable")]
    _, once = np.unique(nearest[order], return_index=True)
    kept = order[np.sort(once)][:most]
    return np.column_stack([kept, nearest[kept]]).astype(np.int64)
