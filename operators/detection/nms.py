"""Greedy non-maximum suppression, independent of the order in which the boxes come, ties included."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Boxes = NDArray[np.float32]
"""(N, 4) corners x1, y1, x2, y2."""


def intersection_over_union(box: Boxes, boxes: Boxes) -> NDArray[np.float32]:
    """IoU (N,) of one box (4,) with boxes (N, 4); 0 where the union has no area."""
    width = np.minimum(box[2], boxes[:, 2]) - np.maximum(box[0], boxes[:, 0])
    height = np.minimum(box[3], boxes[:, 3]) - np.maximum(box[1], boxes[:, 1])
    intersection = np.maximum(width, 0) * np.maximum(height, 0)
    union = _area(box[None]) + _area(boxes) - intersection
    iou: NDArray[np.float32] = np.divide(intersection, union, out=np.zeros_like(union), where=union > 0)
    return iou


def class_wise_nms(
    boxes: Boxes, scores: NDArray[np.float32], classes: NDArray[np.int32], iou_threshold: float
) -> NDArray[np.int64]:
    """Indices of the boxes to keep, by falling score.

    A box is dropped when a kept box of its own class with a higher score overlaps it by more than `iou_threshold`.
    Equal scores are ordered by class, then by coordinates, so the result depends on the set of boxes alone.
    """
    order = np.lexsort((boxes[:, 3], boxes[:, 2], boxes[:, 1], boxes[:, 0], classes, -scores))
    kept: list[int] = []
    while order.size:
        best, rest = order[0], order[1:]
        kept.append(int(best))
        overlaps = intersection_over_union(boxes[best], boxes[rest]) > iou_threshold
        order = rest[~(overlaps & (classes[rest] == classes[best]))]
    return np.array(kept, np.int64)


def _area(boxes: Boxes) -> NDArray[np.float32]:
    area: NDArray[np.float32] = np.maximum(boxes[:, 2] - boxes[:, 0], 0) * np.maximum(boxes[:, 3] - boxes[:, 1], 0)
    return area
