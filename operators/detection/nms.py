"""Greedy non-maximum suppression, independent of the order in which the boxes come, ties included."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

Boxes = NDArray[np.float32]
"""(N, 4) corners x1, y1, x2, y2."""


def intersection_over_union(box: Boxes, boxes: Boxes) -> NDArray[np.float32]:
    """IoU (N,) of one box (4,) with boxes (N, 4); 0 where the union has no area."""
    return _overlaps(box, _areas(box[None]), boxes, _areas(boxes))


def class_wise_nms(
    boxes: Boxes, scores: NDArray[np.float32], classes: NDArray[np.int32], iou_threshold: float
) -> NDArray[np.int64]:
    """Indices of the boxes to keep, by falling score.

    A box is dropped when a kept box of its own class with a higher score overlaps it by more than `iou_threshold`.
    Equal scores are ordered by class, then by coordinates, so the result depends on the set of boxes alone.
    """
    return np.array([best for best, _, _ in _rounds(boxes, scores, classes, iou_threshold)], np.int64)


def merging_nms(
    boxes: Boxes, scores: NDArray[np.float32], classes: NDArray[np.int32], iou_threshold: float, most: int
) -> tuple[NDArray[np.int64], Boxes]:
    """Indices of the best `most` boxes to keep, as `class_wise_nms` finds them, and where each of them lies.

    A box is moved to the mean of itself and the boxes that it suppresses, weighted by their scores and the fourth power
    of their overlaps with it, since neighbouring cells err independently of each other (Solovyev et al. 2021 take the
    scores alone).
    """
    kept, merged = [], []
    for best, dropped, overlaps in islice(_rounds(boxes, scores, classes, iou_threshold), most):
        kept.append(best)
        mean = boxes[best]
        if dropped.size and scores[best] > 0:
            weights = scores[dropped] * np.square(np.square(overlaps))
            total = (weights[:, None] * boxes[dropped]).sum(axis=0) + scores[best] * mean
            mean = total / (weights.sum() + scores[best])
        merged.append(mean)
    return np.array(kept, np.int64), np.array(merged, np.float32).reshape(-1, 4)


def _rounds(
    boxes: Boxes, scores: NDArray[np.float32], classes: NDArray[np.int32], iou_threshold: float
) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.float32]]]:
    """Each box that is kept, the boxes that it suppresses, and how much they overlap it."""
    order = np.lexsort((boxes[:, 3], boxes[:, 2], boxes[:, 1], boxes[:, 0], classes, -scores))
    boxes, classes, areas = boxes[order], classes[order], _areas(boxes)[order]
    left = np.arange(len(order))
    while left.size:
        best, rest = left[0], left[1:]
        overlaps = _overlaps(boxes[best], areas[best], boxes[rest], areas[rest])
        drop = (overlaps > iou_threshold) & (classes[rest] == classes[best])
        yield int(order[best]), order[rest[drop]], overlaps[drop]
        left = rest[~drop]


def _overlaps(
    box: Boxes, area: NDArray[np.float32] | np.float32, boxes: Boxes, areas: NDArray[np.float32]
) -> NDArray[np.float32]:
    corner = np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2])
    np.maximum(corner, 0, out=corner)
    intersection = corner[:, 0] * corner[:, 1]
    union = area + areas - intersection
    iou: NDArray[np.float32] = np.divide(intersection, union, out=np.zeros_like(union), where=union > 0)
    return iou


def _areas(boxes: Boxes) -> NDArray[np.float32]:
    area: NDArray[np.float32] = np.maximum(boxes[:, 2] - boxes[:, 0], 0) * np.maximum(boxes[:, 3] - boxes[:, 1], 0)
    return area
