"""Greedy non-maximum suppression, independent of the order in which the boxes come, ties included."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

Boxes = NDArray[np.float32]
"""(N, 4) corners x1, y1, x2, y2."""
_CELLS = 4096  # overlaps that are taken at once
_ONE = 0.6  # overlap of merged boxes above which they are of one thing
_NONE = np.zeros(0, np.int64)


def intersection_over_union(box: Boxes, boxes: Boxes) -> NDArray[np.float32]:
    """IoU (N,) of one box (4,) with boxes (N, 4); 0 where the union has no area."""
    iou: NDArray[np.float32] = _overlaps(box[None], _areas(box[None]), boxes, _areas(boxes))[0]
    return iou


def class_wise_nms(
    boxes: Boxes, scores: NDArray[np.float32], classes: NDArray[np.int32], iou_threshold: float
) -> NDArray[np.int64]:
    """Indices of the boxes to keep, by falling score.

    A box is dropped when a kept box of the same class with a higher score overlaps it by more than `iou_threshold`.
    Equal scores are ordered by class, then by coordinates, so the result depends on the set of boxes alone.
    """
    return np.array([best for best, _, _ in _rounds(boxes, scores, classes, iou_threshold)], np.int64)


def merging_nms(
    boxes: Boxes, scores: NDArray[np.float32], classes: NDArray[np.int32], iou_threshold: float, most: int
) -> tuple[NDArray[np.int64], Boxes]:
    """Indices of the best `most` boxes to keep, as `class_wise_nms` finds them, and where each of them lies.

    A box is moved to the mean of itself and the boxes that it suppresses, weighted by their scores and the fourth power
    of their overlaps with it, since neighbouring cells err independently of each other (Solovyev et al. 2021 take the
    scores alone). Boxes of one thing, kept apart by the threshold, may move onto each other: of those of a class that
    then overlap by more than `_ONE` (or the threshold, if that is more) the best stays.
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
    rows, moved = np.array(kept, np.int64), np.array(merged, np.float32).reshape(-1, 4)
    stays = np.sort(class_wise_nms(moved, scores[rows], classes[rows], max(iou_threshold, _ONE)))
    return rows[stays], moved[stays]


def _rounds(
    boxes: Boxes, scores: NDArray[np.float32], classes: NDArray[np.int32], iou_threshold: float
) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.float32]]]:
    """Each box that is kept, the boxes that it suppresses, and how much they overlap it.

    Overlaps are taken of several boxes with all that are left at once: of the more, the fewer are left.
    """
    order = np.lexsort((boxes[:, 3], boxes[:, 2], boxes[:, 1], boxes[:, 0], classes, -scores))
    boxes, classes = boxes[order], classes[order]
    areas = _areas(boxes)
    while order.size:
        first = max(1, _CELLS // order.size)
        overlaps = _overlaps(boxes[:first], areas[:first], boxes, areas)
        over = (overlaps > iou_threshold) & (classes[:first, None] == classes)
        np.fill_diagonal(over, False)
        stays = np.ones(order.size, np.bool_)
        for k, drops in enumerate(over.any(axis=1).tolist()):
            if not stays[k]:
                continue
            dropped = _NONE
            if drops:
                dropped = (over[k, k + 1 :] & stays[k + 1 :]).nonzero()[0] + (k + 1)
                stays[dropped] = False
            yield int(order[k]), order[dropped], overlaps[k, dropped]
        stays[:first] = False
        left = stays.nonzero()[0]
        order, boxes, classes, areas = order[left], boxes[left], classes[left], areas[left]


def _overlaps(
    some: Boxes, areas_of_some: NDArray[np.float32], boxes: Boxes, areas: NDArray[np.float32]
) -> NDArray[np.float32]:
    """IoU (M, N) of boxes (M, 4) with boxes (N, 4)."""
    x1, y1, x2, y2 = some.T[:, :, None]
    left, top, right, bottom = np.ascontiguousarray(boxes.T)
    width, height = np.minimum(x2, right) - np.maximum(x1, left), np.minimum(y2, bottom) - np.maximum(y1, top)
    intersection = np.maximum(width, 0) * np.maximum(height, 0)
    union = areas_of_some[:, None] + areas - intersection
    iou: NDArray[np.float32] = np.divide(intersection, union, out=np.zeros_like(union), where=union > 0)
    return iou


def _areas(boxes: Boxes) -> NDArray[np.float32]:
    area: NDArray[np.float32] = np.maximum(boxes[:, 2] - boxes[:, 0], 0) * np.maximum(boxes[:, 3] - boxes[:, 1], 0)
    return area
