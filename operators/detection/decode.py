"""Candidates in the pixels of a network's input, boxes from rows, messages of both: shared by all decoders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image, pack_masks
from operators.image.letterbox import FitMode, ImageFit

Size = tuple[int, int]
"""(width, height) in pixels."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Boxes (N, 4) float32 as x1, y1, x2, y2 in input pixels, scores (N,) float32, classes (N,) int32.

    `masks` (N, ...) holds what the network gives of the mask of each, or, drawn, whether the pixels of the image (N,
    height, width) belong to it; None for one without masks.
    """

    boxes: NDArray[np.float32]
    scores: NDArray[np.float32]
    classes: NDArray[np.int32]
    masks: NDArray[np.float32] | NDArray[np.bool_] | None = None

    def select(self, which: NDArray[np.bool_] | NDArray[np.int64] | slice) -> Candidates:
        masks = None if self.masks is None else self.masks[which]
        return Candidates(self.boxes[which], self.scores[which], self.classes[which], masks)


Outputs = Sequence[NDArray[Any]]
Decode = Callable[[Outputs, Size, float], Candidates]
"""(outputs, input size, score threshold) → candidates. Raises ValueError for outputs of another shape."""
Draw = Callable[[Candidates, Outputs, ImageFit], NDArray[np.bool_]]
"""(candidates, outputs, fit) → their masks (N, height, width) in the pixels of the image."""


@dataclass(frozen=True)
class Layout:
    """One family of networks. Its input is (pixel - `mean`) / `scale` by channel in RGB order, pixels from 0 to 255.

    - `classes` returns the number of classes of decoded outputs; None if the outputs do not show it.
    - `nms_iou`: overlap above which its authors drop the weaker box of a class; 1 for networks that suppress.
    - `draw` draws the masks of candidates that have any.
    - `sized`: the network has a second input, the (width, height) of the image in whose pixels its boxes are.
    - `grid`: cells of its coarsest grid, in pixels.
    - `words`: tokens of each class's name that the network takes besides, for an open vocabulary; 0 for none.
    - `names`: of the outputs that are decoded, in their order, where an export has them all; else its own order counts.
    """

    decode: Decode
    bgr: bool
    fit: FitMode
    classes: Callable[[Outputs], int] | None
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: tuple[float, float, float] = (255.0, 255.0, 255.0)
    nms_iou: float = 0.45
    draw: Draw | None = None
    sized: bool = False
    grid: int = 32
    words: int = 0
    names: tuple[str, ...] = ()


def detections_of(image: Image, names: tuple[str, ...], found: Candidates) -> Detections2D:
    """Returns boxes, scores, classes, and drawn masks where there are any, all in the image's pixels."""
    return Detections2D(
        stamp=image.stamp,
        frame=image.frame,
        width=image.width,
        height=image.height,
        class_names=names,
        boxes=found.boxes,
        scores=np.minimum(found.scores, np.float32(1)),
        class_ids=found.classes,
        masks=None if found.masks is None else pack_masks(found.masks.astype(np.bool_, copy=False)),
    )


def best_class(
    boxes: NDArray[np.float32],
    per_class: NDArray[np.float32],
    threshold: float,
    masks: NDArray[np.float32] | None = None,
) -> Candidates:
    """Returns the best class of each row (N, C) at or above the threshold, its box given by centre and size."""
    classes = per_class.argmax(axis=1).astype(np.int32)
    scores = per_class[np.arange(len(classes)), classes]
    keep = np.flatnonzero(scores >= threshold)
    made = corners(*boxes[keep].T), scores[keep].astype(np.float32), classes[keep]
    return Candidates(*made, None if masks is None else masks[keep].astype(np.float32))


def corners(
    x: NDArray[np.float32], y: NDArray[np.float32], w: NDArray[np.float32], h: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Returns boxes (N, 4) as x1, y1, x2, y2 of their centres and sizes."""
    return np.stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2], axis=1).astype(np.float32)


def sigmoid(x: NDArray[np.float32]) -> NDArray[np.float32]:
    return (1 / (1 + np.exp(-np.clip(x, -80, 80)))).astype(np.float32)


def shapes_of(outputs: Outputs) -> str:
    """Returns the shapes of outputs for an error."""
    return ", ".join(str(o.shape) for o in outputs)
