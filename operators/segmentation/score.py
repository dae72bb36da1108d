"""Intersection over union of class maps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Confusion = NDArray[np.int64]
"""(C, C + 1): pixels of a true class (row) that were given a class (column), or none (the last column)."""


def confusion(truth: NDArray[np.uint8], found: NDArray[np.uint8], classes: int) -> Confusion:
    """Counts the pixels whose true class is known (below `classes`)."""
    known = truth < classes
    given = np.minimum(found[known].astype(np.int64), classes)
    cells = classes * (classes + 1)
    return np.bincount(truth[known].astype(np.int64) * (classes + 1) + given, minlength=cells).reshape(classes, -1)


def class_iou(table: Confusion) -> NDArray[np.float64]:
    """IoU (C,) of each class; NaN for a class that is not in the truth."""
    hit = np.diag(table[:, :-1]).astype(np.float64)
    present = table.sum(axis=1)
    union = present + table[:, :-1].sum(axis=0) - hit
    return np.where(present > 0, hit / np.maximum(union, 1), np.nan)


def mean_iou(table: Confusion) -> float:
    """The mean over the classes that are in the truth; 0 without any."""
    iou = class_iou(table)
    return float(np.nanmean(iou)) if np.isfinite(iou).any() else 0.0


def named(table: Confusion, names: Sequence[str]) -> dict[str, float]:
    """IoU by class name, for the classes that are in the truth."""
    return {name: float(v) for name, v in zip(names, class_iou(table), strict=True) if np.isfinite(v)}
