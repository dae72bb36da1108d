"""Matches the features of two views where a rough pose between them expects them.

Lowe's test asks that a feature be distinct from all others of the view, which few are after a large change of view.
Distinct from those in a small window is enough where a pose predicts that window.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix
from operators.odometry.rgbd.camera import RgbdCamera

RATIO = 0.85  # of the distance of descriptors to that of the second nearest in the window
FARTHEST = 0.5  # squared distance of rooted descriptors beyond which they do not show the same


def guided_pairs(
    points: NDArray[np.float32],
    rooted: NDArray[np.float32],
    pixels: NDArray[np.float32],
    seen: NDArray[np.float32],
    T_known_seen: Matrix,
    camera: RgbdCamera,
    window: float,
) -> NDArray[np.int64]:
    """Returns pairs of indices (M, 2), each feature once, at most `window` working pixels from its prediction.

    The known features have points (N, 3) in the known depth camera, NaN where unknown, and rooted descriptors (N, 128);
    the `seen` ones rooted descriptors (M, 128) at pixels (M, 2).
    """
    nothing = np.zeros((0, 2), np.int64)
    there = np.flatnonzero(np.isfinite(points[:, 2]))
    if not len(there) or len(pixels) < 2:
        return nothing
    moved = transform_points(camera.T_color_depth @ invert(T_known_seen), points[there].astype(np.float64))
    ahead = moved[:, 2] > 0.05
    there, at = there[ahead], project(moved[ahead], camera.K_color).astype(np.float32)
    near = np.abs(at[:, :1] - pixels[:, 0]) < window
    near &= np.abs(at[:, 1:] - pixels[:, 1]) < window
    a, b = np.nonzero(near)
    if not len(a):
        return nothing
    distance = np.full(near.shape, np.inf, np.float32)
    distance[a, b] = 2.0 - 2.0 * np.einsum("ij,ij->i", rooted[there[a]], seen[b])
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(there))
    least = distance[rows, nearest]
    second = distance.copy()
    second[rows, nearest] = np.inf
    # Squared distances: the ratio of distances is squared too.
    distinct = (least < FARTHEST) & (least < RATIO**2 * np.minimum(second.min(axis=1), FARTHEST))
    mutual = distance.argmin(axis=0)[nearest] == rows
    chosen = distinct & mutual
    return np.column_stack([there[chosen], nearest[chosen]])
