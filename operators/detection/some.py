"""Some of the detections of a message, such as the small ones, which operators look at once more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D

Mask = NDArray[np.bool_]


def require_same_image(pixels: NDArray[np.uint8], detections: Detections2D) -> None:
    """Raises ValueError where detections are of an image of another size than pixels (H, W, 3)."""
    height, width = pixels.shape[:2]
    if (detections.width, detections.height) != (width, height):
        given = f"{detections.width}x{detections.height}"
        raise ValueError(f"the detections are of an image of {given} pixels, this one has {width}x{height}")


def of_classes(detections: Detections2D, names: Sequence[str]) -> Mask:
    """Tells which detections (N,) are of these classes."""
    return np.isin(detections.class_ids, indices(detections.class_names, names))


def small_ones(detections: Detections2D, names: Sequence[str], largest: float) -> Mask:
    """Tells which detections (N,) are of these classes, and no longer than `largest` pixels along a side."""
    extent = detections.boxes[:, 2:] - detections.boxes[:, :2]
    return np.asarray(of_classes(detections, names) & (extent.max(axis=1, initial=0.0) <= largest))


def indices(known: Sequence[str], names: Sequence[str]) -> NDArray[np.int32]:
    """Returns where each name (N,) is among those known; -1 where it is not."""
    return np.array([known.index(name) if name in known else -1 for name in names], np.int32)


def rows_of(detections: Detections2D, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Detections2D:
    """Returns some detections, in that order, with all that is told of them."""
    return detections.replace(
        **{name: value[rows] for name, value in detections.items() if isinstance(value, np.ndarray)}
    )


def by_score(
    detections: Detections2D, boxes: NDArray[np.float32], scores: NDArray[np.float32], classes: NDArray[np.int32]
) -> Detections2D:
    """Returns detections of the same image with other boxes, by falling score."""
    order = np.argsort(-scores, kind="stable")
    return Detections2D(
        stamp=detections.stamp,
        frame=detections.frame,
        width=detections.width,
        height=detections.height,
        class_names=detections.class_names,
        boxes=boxes[order],
        scores=scores[order],
        class_ids=classes[order],
    )
