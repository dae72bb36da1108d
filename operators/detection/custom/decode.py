"""The grid network's raw output as scored boxes.

The box of an anchor (w, h) in the cell (column, row) of a map of stride s follows YOLOv5: its centre is
s · (2σ(tx) − 0.5 + column), s · (2σ(ty) − 0.5 + row), its size w · (2σ(tw))², h · (2σ(th))², and its score
σ(objectness) · σ(class).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from operators.detection.decode import Candidates
from operators.detection.nms import merging_nms

Map = NDArray[np.float32]
"""(1, A · (5 + C), H, W): per anchor tx, ty, tw, th, objectness and C class scores, all before the sigmoid."""

_CROWD = 20


def find_boxes(
    maps: Sequence[Map],
    anchors: NDArray[np.float32],
    strides: Sequence[int],
    classes: int,
    threshold: float,
    nms_iou: float,
    most: int,
) -> Candidates:
    """The boxes in the output, in input pixels, after class-wise suppression: the best `most`, by falling score.

    Each lies at the mean of the boxes that were one with it.
    """
    found = decode_grid(maps, anchors, strides, classes, threshold)
    if len(found.scores) > _CROWD * most:  # a network that is still untrained answers everywhere
        found = found.select(np.argsort(-found.scores, kind="stable")[: _CROWD * most])
    kept, boxes = merging_nms(found.boxes, found.scores, found.classes, nms_iou, most)
    return replace(found.select(kept), boxes=boxes)


def decode_grid(
    maps: Sequence[Map], anchors: NDArray[np.float32], strides: Sequence[int], classes: int, threshold: float
) -> Candidates:
    """Boxes in the pixels of the input whose best class scores at least `threshold`.

    `anchors` (L, A, 2): widths and heights in input pixels, for each of the L maps. Raises ValueError for maps of
    another shape.
    """
    levels = [
        _decode_map(output, level, stride, classes, threshold)
        for output, level, stride in zip(maps, anchors, strides, strict=True)
    ]
    return Candidates(
        np.concatenate([found.boxes for found in levels]),
        np.concatenate([found.scores for found in levels]),
        np.concatenate([found.classes for found in levels]),
    )


def _decode_map(output: Map, anchors: NDArray[np.float32], stride: int, classes: int, threshold: float) -> Candidates:
    per_anchor = 5 + classes
    if output.ndim != 4 or output.shape[:2] != (1, len(anchors) * per_anchor):
        raise ValueError(f"a map has shape (1, {len(anchors)} * (5 + {classes}), H, W), got {output.shape}")
    height, width = output.shape[2:]
    rows = output.reshape(len(anchors), per_anchor, height * width)
    # The objectness alone bounds the score: few cells are left for the rest of the work.
    anchor, cell = np.nonzero(rows[:, 4] >= _logit(threshold))
    kept = rows[anchor, :, cell]
    with np.errstate(over="ignore"):
        values = (1 / (1 + np.exp(-kept))).astype(np.float32)
    label = values[:, 5:].argmax(axis=1).astype(np.int32)
    score = values[:, 4] * values[np.arange(len(values)), 5 + label]
    row, column = np.divmod(cell, width)
    center = (values[:, :2] * 2 - 0.5 + np.stack([column, row], axis=1)) * stride
    half = (values[:, 2:4] * 2) ** 2 * anchors[anchor] / 2
    boxes = np.concatenate([center - half, center + half], axis=1).astype(np.float32)
    keep = score >= threshold
    return Candidates(boxes[keep], score[keep], label[keep])


def _logit(p: float) -> np.float32:
    """The raw value whose sigmoid is p; a little lower, so that rounding loses no box that scores p."""
    if p <= 0:
        return np.float32(-np.inf)
    if p >= 1:
        return np.float32(15)
    return np.float32(np.log(p / (1 - p)) - 1e-4)
