"""Anchor boxes fitted to the sizes of the objects in a data set: k-means with 1 - IoU as distance (YOLOv2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Sizes = NDArray[np.float32]
"""(N, 2) widths and heights in pixels."""


def size_iou(sizes: Sizes, anchors: Sizes) -> NDArray[np.float32]:
    """IoU (N, K) of boxes that share their centre."""
    intersection = np.minimum(sizes[:, None], anchors[None]).prod(axis=2)
    union = sizes.prod(axis=1)[:, None] + anchors.prod(axis=1)[None] - intersection
    iou: NDArray[np.float32] = (intersection / np.maximum(union, 1e-9)).astype(np.float32)
    return iou


def fit_anchors(sizes: Sizes, count: int, seed: int, rounds: int = 50) -> Sizes:
    """`count` anchors (count, 2) by growing area, for objects of these sizes in the network's input.

    Where there are fewer distinct sizes than anchors, the rest are scaled copies of the found ones. Raises ValueError
    without any size.
    """
    sizes = np.maximum(np.asarray(sizes, np.float32).reshape(-1, 2), 1)
    if not len(sizes):
        raise ValueError("anchors need at least one object")
    distinct = np.unique(sizes, axis=0)
    start = np.random.default_rng(seed).permutation(len(distinct))[:count]
    anchors = distinct[np.sort(start)]
    for _ in range(rounds):
        nearest = size_iou(sizes, anchors).argmax(axis=1)
        moved = np.stack(
            [
                np.median(sizes[nearest == k], axis=0) if (nearest == k).any() else anchors[k]
                for k in range(len(anchors))
            ]
        ).astype(np.float32)
        if np.array_equal(moved, anchors):
            break
        anchors = moved
    scales = 2.0 ** np.array([0, 1, -1, 2, -2, 3, -3, 0.5, -0.5, 1.5, -1.5, 2.5])
    copies = np.concatenate([anchors * s for s in scales]) if len(anchors) < count else anchors
    chosen = copies[:count].astype(np.float32)
    return chosen[np.lexsort((chosen[:, 0], chosen.prod(axis=1)))]


def mean_best_iou(sizes: Sizes, anchors: Sizes) -> float:
    """Tells how well the anchors cover the sizes: the mean over objects of the best anchor's IoU."""
    return float(size_iou(np.asarray(sizes, np.float32), anchors).max(axis=1).mean())
