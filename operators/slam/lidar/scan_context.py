"""A description of a place by how high things rise around a LiDAR. Kim and Kim, "Scan context", 2018."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Context = NDArray[np.float32]

RINGS, SECTORS = 20, 60
FLOOR = -2.0  # metres below the sensor, from which heights count
_OVERLAP = 0.3  # least share of the sectors of a description that another must see too


def describe(points: Array, far: float) -> Context:
    """Returns the greatest height (20, 60) in each ring and sector within `far` metres, in columns of length 1.

    A sector in which nothing was seen is 0. `points` (N, 3) are in the sensor's frame.
    """
    distance = np.hypot(points[:, 0], points[:, 1])
    near = distance < far
    points, distance = points[near], distance[near]
    ring = np.minimum((distance * (RINGS / far)).astype(np.int64), RINGS - 1)
    sector = ((np.arctan2(points[:, 1], points[:, 0]) + np.pi) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    out = np.zeros((RINGS, SECTORS))
    np.maximum.at(out, (ring, sector), np.maximum(points[:, 2] - FLOOR, 0.0))
    length = np.linalg.norm(out, axis=0)
    return np.asarray(out / np.where(length > 0, length, 1.0), np.float32)


def likeness(one: Context, others: NDArray[np.float32]) -> tuple[Array, Array]:
    """Returns how alike a description is to each of others (N, 20, 60), 0 to 1, and the yaw of each to it, radians.

    It is the mean cosine of the sectors in which both saw something, at the best turn.
    """
    if not len(others):
        return np.zeros(0), np.zeros(0)
    cosines = np.einsum("rs,nrt->nst", one, others, optimize=True)
    mine, theirs = np.any(one, axis=0), np.any(others, axis=1)
    seen: NDArray[np.bool_] = np.logical_and(mine[:, None], theirs[:, None, :])
    s = np.arange(SECTORS)
    turned = (s[:, None] + s[None, :]) % SECTORS  # (sector, shift): the other's sector beside it
    total = cosines[:, s[:, None], turned].sum(axis=1, dtype=np.float64)
    count = seen[:, s[:, None], turned].sum(axis=1)
    least = np.maximum(_OVERLAP * max(1, int(mine.sum())), 1)
    mean = np.where(count >= least, total / np.maximum(count, 1), 0.0)
    best = mean.argmax(axis=1)
    yaw = (best * (2 * np.pi / SECTORS) + np.pi) % (2 * np.pi) - np.pi
    return mean[np.arange(len(others)), best], yaw
