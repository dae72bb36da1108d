"""Weighted samples of a planar pose (x, y, yaw): resampling, how many are needed, and what they say."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_NORMAL_QUANTILE = 2.326  # 0.99


def normalised(logarithms: Array) -> Array:
    """Returns weights (N,) that sum to 1 of their logarithms (N,), alike where all are minus infinity."""
    top = float(logarithms.max())
    if not math.isfinite(top):
        return np.full(len(logarithms), 1.0 / len(logarithms))
    weights = np.exp(logarithms - top)
    return np.asarray(weights / weights.sum())


def evidence_of(weights: Array, logarithms: Array) -> float:
    """Returns the logarithm of the mean of likelihoods (N,), given as logarithms, by weights (N,) that sum to 1."""
    top = float(logarithms.max())
    return top + math.log(max(float(weights @ np.exp(logarithms - top)), 1e-300)) if math.isfinite(top) else top


def effective_size(weights: Array) -> float:
    """Returns the number of equally weighted samples that would be worth as much (Kong et al., 1994)."""
    return float(1.0 / np.square(weights).sum())


def systematic(weights: Array, count: int, offset: float) -> NDArray[np.intp]:
    """Draws `count` indices in proportion to weights (N,) that sum to 1; `offset` in [0, 1) decides which.

    Every sample is drawn in proportion to its weight, except for rounding (Kitagawa, 1996).
    """
    steps = (offset + np.arange(count)) / count
    return np.minimum(np.searchsorted(np.cumsum(weights), steps, side="right"), len(weights) - 1)


def particles_needed(bins: int, error: float) -> int:
    """Returns how many samples keep the Kullback-Leibler distance below `error` with 99 % (Fox, 2003)."""
    if bins < 2:
        return 1
    part = 2.0 / (9.0 * (bins - 1))
    return math.ceil((bins - 1) / (2.0 * error) * (1.0 - part + math.sqrt(part) * _NORMAL_QUANTILE) ** 3)


def bins_of(poses: Array, size: float, angle: float) -> NDArray[np.int64]:
    """Returns the key (N,) of the bin of each pose, bins being `size` metres and `angle` radians wide."""
    cells = np.floor(poses / np.array([size, size, angle])).astype(np.int64)
    cells[:, 2] %= max(1, round(2 * math.pi / angle))
    cells -= cells.min(axis=0)
    widths = cells.max(axis=0) + 1
    return np.asarray((cells[:, 0] * widths[1] + cells[:, 1]) * widths[2] + cells[:, 2])


def wrapped(angles: Array) -> Array:
    """Returns angles in [-π, π)."""
    return np.asarray((angles + math.pi) % (2 * math.pi) - math.pi)


def moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Returns mean (3,) and covariance (3, 3) of poses whose weights sum to 1; the yaw's mean is circular."""
    mean = weights @ poses
    mean[2] = math.atan2(float(weights @ np.sin(poses[:, 2])), float(weights @ np.cos(poses[:, 2])))
    off = poses - mean
    off[:, 2] = wrapped(off[:, 2])
    mean[2] = float(wrapped(mean[2] + weights @ off[:, 2]))
    return mean, (off * weights[:, None]).T @ off


def mode(poses: Array, weights: Array, size: float, angle: float) -> tuple[Array, Array, float]:
    """Returns mean (3,), covariance (3, 3) and share of the weight of the samples about the heaviest bin."""
    _, inverse = np.unique(bins_of(poses, size, angle), return_inverse=True)
    heaviest = int(np.bincount(inverse, weights).argmax())
    middle = np.asarray(inverse == heaviest)
    for _ in range(2):  # about the bin, then about what lies there
        centre, _ = moments(poses[middle], weights[middle] / weights[middle].sum())
        apart = np.abs(poses - centre)
        apart[:, 2] = np.abs(wrapped(poses[:, 2] - centre[2]))
        near = (np.hypot(apart[:, 0], apart[:, 1]) < 2 * size) & (apart[:, 2] < 2 * angle)
        if not weights[near].any():
            break
        middle = near
    share = float(weights[middle].sum())
    mean, covariance = moments(poses[middle], weights[middle] / share)
    return mean, covariance, share
