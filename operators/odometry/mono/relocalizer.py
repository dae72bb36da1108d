"""Finds a lost camera's view among the keyframes of a monocular map.

Corners are described by SIFT, upright and at one size, which bears what a robot's view changes by near a place where
it has been. Lowe, "Distinctive image features from scale-invariant keypoints", 2004.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels, Points
from operators.geometry.se3 import Matrix
from operators.odometry.features import Gray, detect_corners
from operators.odometry.mono.map import MonoMap, View
from operators.odometry.mono.pose import solved
from operators.odometry.recognition import Description, match

PATCH = 7.0  # pixels, size of the corners described
CORNERS = 500
FEWEST = 12  # corners by which a view may be recognised
ERROR = 4.0  # pixels by which a recognised corner may be off


def described(gray: Gray, pixels: Pixels) -> tuple[Description, NDArray[np.int64]]:
    """Returns the descriptors of corners (N, 2), and which of them have one."""
    keypoints = [cv2.KeyPoint(float(x), float(y), PATCH, 0.0, 0, 0, i) for i, (x, y) in enumerate(pixels.tolist())]
    kept, descriptors = cv2.SIFT.create().compute(gray, keypoints)
    if descriptors is None:
        return Description(np.zeros((0, 2)), np.zeros((0, 128), np.uint8)), np.zeros(0, np.int64)
    rows = np.array([k.class_id for k in kept], np.int64)
    return Description(pixels[rows], descriptors.astype(np.uint8)), rows


def recognised(gray: Gray, known: MonoMap, views: Sequence[View], K: Matrix) -> tuple[Matrix, View] | None:
    """Returns T_world_camera of a view and the keyframe that it was recognised by, if it was."""
    corners = detect_corners(gray, CORNERS)
    seen, _ = described(gray, corners)
    best: tuple[int, Matrix, View] | None = None
    for view in views:
        _, points, pixels = known.seen_in(view)
        mine, rows = described(view.gray, pixels)
        pairs = match(mine, seen)
        if len(pairs) < FEWEST:
            continue
        chosen: Points = points[rows[pairs[:, 0]]]
        found = solved(chosen, seen.pixels[pairs[:, 1]], K, ERROR, FEWEST)
        if found is not None and found[1].sum() > max(0.3 * len(pairs), 0 if best is None else best[0]):
            best = int(found[1].sum()), found[0], view
    return None if best is None else best[1:]
