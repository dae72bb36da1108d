"""Rectified stereo pairs: one camera matrix for both images, the right camera on the left one's x axis."""

from __future__ import annotations

import numpy as np

from dataflow.messages import CameraInfo
from operators.geometry.se3 import Matrix


def rectified_pair(left: CameraInfo, right: CameraInfo) -> tuple[Matrix, float]:
    """Returns K (3, 3) of both cameras and the baseline in metres.

    Raises ValueError where two calibrations do not describe a rectified pair with a baseline.
    """
    if right.P is None or right.P[0, 3] >= 0:
        raise ValueError("right_info.P must be given, with P[0, 3] = -fx * baseline below 0")
    K = left.K if left.P is None else left.P[:, :3]
    if not np.allclose(K, right.P[:, :3], rtol=1e-3):
        raise ValueError("left_info and right_info must describe a rectified pair: one K for both")
    start = 0.0 if left.P is None else float(left.P[0, 3])
    baseline = (start - float(right.P[0, 3])) / float(K[0, 0])
    if baseline <= 0:
        raise ValueError(f"left_info and right_info must have the right camera to the right, got {baseline} m")
    return np.array(K, np.float64), baseline
