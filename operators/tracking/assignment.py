"""Matching of tracks with detections: overlaps, the best assignment, and what a detection speaks for."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from dataflow.messages import Boxes3D, Detections2D

Array = NDArray[np.float64]


def overlap(first: Array, second: Array) -> Array:
    """Returns the IoU (N, M) of image boxes (N, 4) and (M, 4)."""
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=2)
    areas = [np.prod(np.maximum(b[:, 2:] - b[:, :2], 0), axis=1) for b in (first, second)]
    union = areas[0][:, None] + areas[1][None, :] - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0))


def assign(value: Array, allowed: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Returns the pairs (row, column) of greatest total value among the allowed ones; values are at most 1."""
    if not allowed.any():
        return []
    gain = np.where(allowed, value + 1.0, 0.0)  # any allowed pair is better than none
    rows, columns = linear_sum_assignment(gain, maximize=True)
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if allowed[r, c]]


def log_odds(score: float, least: float = 0.1) -> float:
    """Returns the evidence of one detection; even a weak one that fits a track speaks for it by the least."""
    bounded = min(max(score, 0.02), 0.95)
    return max(math.log(bounded / (1 - bounded)), least)


def class_ids_of(message: Detections2D | Boxes3D, classes: list[str]) -> NDArray[np.int32]:
    """Returns the ids (N,) of a message's rows in a list of classes, which grows with the names that arrive."""
    if not message.class_names:
        return message.class_ids
    classes += [name for name in message.class_names if name not in classes]
    return np.array([classes.index(name) for name in message.class_names], np.int32)[message.class_ids]
