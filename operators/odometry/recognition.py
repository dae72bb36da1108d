"""Recognising a view again after a loss: descriptors that bear other distances and angles.

Lowe, "Distinctive image features from scale-invariant keypoints", 2004. They cost ten times what tracking does, so
they are made of a keyframe only when a lost camera asks for it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels
from operators.odometry.features import Gray

COUNT = 500
RATIO = 0.8  # a match is distinctive where the second nearest is so much farther


@dataclass(frozen=True, eq=False)
class Description:
    """Pixels (N, 2) of a working image and their descriptors (N, 128)."""

    pixels: Pixels
    descriptors: NDArray[np.float32]


def describe(gray: Gray) -> Description:
    points, descriptors = cv2.SIFT.create(COUNT, contrastThreshold=0.02).detectAndCompute(gray, None)
    if descriptors is None:
        return Description(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    return Description(np.array([p.pt for p in points], np.float64), np.asarray(descriptors, np.float32))


def match(a: Description, b: Description) -> NDArray[np.int64]:
    """Returns pairs of indices (M, 2), each b once, that are distinctly nearest."""
    if len(a.descriptors) < 2 or len(b.descriptors) < 2:
        return np.zeros((0, 2), np.int64)
    candidates = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.descriptors, b.descriptors, k=2)
    best: dict[int, tuple[float, int]] = {}
    for pair in candidates:
        if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance:
            m = pair[0]
            if m.trainIdx not in best or m.distance < best[m.trainIdx][0]:
                best[m.trainIdx] = (m.distance, m.queryIdx)
    return np.array([(query, train) for train, (_, query) in sorted(best.items())], np.int64).reshape(-1, 2)
