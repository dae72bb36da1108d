"""Decodes the output of detector networks into scored boxes in the pixels of the network's input.

A layout says how an image becomes the network's input (colour order, fit) and how its output is read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from operators.detection.fit import FitMode

Size = tuple[int, int]
"""(width, height) in pixels."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Boxes (N, 4) float32 as x1, y1, x2, y2 in input pixels, scores (N,) float32, classes (N,) int32."""

    boxes: NDArray[np.float32]
    scores: NDArray[np.float32]
    classes: NDArray[np.int32]

    def select(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> Candidates:
        return Candidates(self.boxes[which], self.scores[which], self.classes[which])


Decode = Callable[[NDArray[np.float32], Size, float], Candidates]
"""(output, input size, score threshold) → candidates. Raises ValueError for an output of another shape."""


@dataclass(frozen=True)
class Layout:
    """One family of networks."""

    decode: Decode
    bgr: bool
    fit: FitMode


def decode_fastestdet(output: NDArray[np.float32], size: Size, threshold: float) -> Candidates:
    """FastestDet: (1, 5 + C, H, W), one box a cell.

    Channels: objectness, cell offsets before tanh (x, y), size before the sigmoid (w, h; share of the image), class
    scores. score = objectness^0.6 · class^0.4.
    """
    if output.ndim != 4 or output.shape[0] != 1 or output.shape[1] < 6:
        raise ValueError(f"a FastestDet output has shape (1, 5 + classes, H, W), got {output.shape}")
    _, channels, rows, columns = output.shape
    cells = output[0].reshape(channels, rows * columns)
    per_class = cells[5:]
    classes = per_class.argmax(axis=0).astype(np.int32)
    best = np.take_along_axis(per_class, classes[None].astype(np.int64), axis=0)[0]
    scores = (np.maximum(cells[0], 0) ** 0.6 * np.maximum(best, 0) ** 0.4).astype(np.float32)
    keep = np.flatnonzero(scores >= threshold)
    row, column = np.divmod(keep, columns)
    x = (column + np.tanh(cells[1, keep])) / columns
    y = (row + np.tanh(cells[2, keep])) / rows
    w, h = _sigmoid(cells[3, keep]), _sigmoid(cells[4, keep])
    boxes = _corners(x, y, w, h) * np.array([*size, *size], np.float32)
    return Candidates(boxes.astype(np.float32), scores[keep], classes[keep])


def decode_yolov5(output: NDArray[np.float32], size: Size, threshold: float) -> Candidates:
    """YOLOv5 to v7 as exported: (1, N, 5 + C), centre and size in input pixels, objectness, class scores."""
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[2] < 6:
        raise ValueError(f"a YOLOv5 output has shape (1, N, 5 + classes), got {output.shape}")
    rows = output[0]
    return _best_class(rows[:, :4], rows[:, 5:] * rows[:, 4:5], threshold)


def decode_yolov8(output: NDArray[np.float32], size: Size, threshold: float) -> Candidates:
    """YOLOv8 and later as exported without NMS: (1, 4 + C, N), centre and size in input pixels, class scores."""
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[1] < 5:
        raise ValueError(f"a YOLOv8 output has shape (1, 4 + classes, N), got {output.shape}")
    rows = output[0].T
    return _best_class(rows[:, :4], rows[:, 4:], threshold)


DecoderName = Literal["fastestdet", "yolov5", "yolov8"]

LAYOUTS: dict[DecoderName, Layout] = {
    "fastestdet": Layout(decode_fastestdet, bgr=True, fit="stretch"),
    "yolov5": Layout(decode_yolov5, bgr=False, fit="letterbox"),
    "yolov8": Layout(decode_yolov8, bgr=False, fit="letterbox"),
}


def _best_class(boxes: NDArray[np.float32], per_class: NDArray[np.float32], threshold: float) -> Candidates:
    """The best class of each row (N, C) at or above the threshold, its box given by centre and size."""
    classes = per_class.argmax(axis=1).astype(np.int32)
    scores = per_class[np.arange(len(classes)), classes]
    keep = np.flatnonzero(scores >= threshold)
    return Candidates(_corners(*boxes[keep].T), scores[keep].astype(np.float32), classes[keep])


def _corners(
    x: NDArray[np.float32], y: NDArray[np.float32], w: NDArray[np.float32], h: NDArray[np.float32]
) -> NDArray[np.float32]:
    return np.stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2], axis=1).astype(np.float32)


def _sigmoid(x: NDArray[np.float32]) -> NDArray[np.float32]:
    return (1 / (1 + np.exp(-np.clip(x, -80, 80)))).astype(np.float32)
