"""IoU of upright boxes in space."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def upright_iou(first: tuple[Array, Array, float], second: tuple[Array, Array, float]) -> float:
    """Returns the IoU of two boxes, each (centre (3,), full size (3,), heading about the vertical in radians)."""
    shared = shared_volume(first, second)
    union = float(np.prod(first[1]) + np.prod(second[1])) - shared
    return shared / union if union > 0 else 0.0


def shared_volume(first: tuple[Array, Array, float], second: tuple[Array, Array, float]) -> float:
    """Returns the volume that two such boxes share, m³."""
    (c1, s1, y1), (c2, s2, y2) = first, second
    height = min(c1[2] + s1[2] / 2, c2[2] + s2[2] / 2) - max(c1[2] - s1[2] / 2, c2[2] - s2[2] / 2)
    if height <= 0:
        return 0.0
    kind, region = cv2.rotatedRectangleIntersection(
        ((0.0, 0.0), (float(s1[0]), float(s1[1])), float(np.degrees(y1))),
        ((float(c2[0] - c1[0]), float(c2[1] - c1[1])), (float(s2[0]), float(s2[1])), float(np.degrees(y2))),
    )
    if kind == cv2.INTERSECT_NONE or region is None or len(region) < 3:
        return 0.0
    return float(cv2.contourArea(cv2.convexHull(region))) * float(height)
