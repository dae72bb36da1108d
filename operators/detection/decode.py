"""Decodes the output of detector networks into scored boxes in the pixels of the network's input.

A layout describes how an image becomes the network's input (colour order, fit) and how its output is read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from operators.image.letterbox import FitMode

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


Outputs = Sequence[NDArray[Any]]
Decode = Callable[[Outputs, Size, float], Candidates]
"""(outputs, input size, score threshold) → candidates. Raises ValueError for outputs of another shape."""


@dataclass(frozen=True)
class Layout:
    """One family of networks. Its input is (pixel - `mean`) / `scale`, pixels from 0 to 255.

    `classes` returns the number of classes of decoded outputs; None if the outputs do not show it.
    """

    decode: Decode
    bgr: bool
    fit: FitMode
    classes: Callable[[Outputs], int] | None
    mean: float = 0.0
    scale: float = 255.0


def decode_fastestdet(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """FastestDet: (1, 5 + C, H, W), one box a cell.

    Channels: objectness, cell offsets before tanh (x, y), size before the sigmoid (w, h; share of the image), class
    scores. score = objectness^0.6 · class^0.4.
    """
    output = outputs[0]
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


def decode_yolov5(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """YOLOv5 to v7 as exported: (1, N, 5 + C), centre and size in input pixels, objectness, class scores."""
    output = outputs[0]
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[2] < 6:
        raise ValueError(f"a YOLOv5 output has shape (1, N, 5 + classes), got {output.shape}")
    rows = output[0]
    return _best_class(rows[:, :4], rows[:, 5:] * rows[:, 4:5], threshold)


def decode_yolov8(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """YOLOv8 and later as exported without NMS: (1, 4 + C, N), centre and size in input pixels, class scores."""
    output = outputs[0]
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[1] < 5:
        raise ValueError(f"a YOLOv8 output has shape (1, 4 + classes, N), got {output.shape}")
    if output.shape[2] == 6 < output.shape[1]:
        raise ValueError(f"{output.shape} is the output of an export with its suppression inside: decoder end2end")
    if len(outputs) > 1 and outputs[1].ndim == 4:
        raise ValueError(
            f"outputs {output.shape} and {outputs[1].shape} are of a segmentation model, whose masks are not read: "
            "export a model of the task detect"
        )
    rows = output[0].T
    return _best_class(rows[:, :4], rows[:, 4:], threshold)


def decode_end2end(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """YOLOv10, YOLO26 and others exported with their suppression inside: (1, N, 6), corners in input pixels, score,
    class."""
    output = outputs[0]
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[2] != 6:
        raise ValueError(f"an end-to-end output has shape (1, N, 6), got {output.shape}")
    rows = output[0]
    keep = rows[:, 4] >= threshold
    return Candidates(
        rows[keep, :4].astype(np.float32), rows[keep, 4].astype(np.float32), rows[keep, 5].astype(np.int32)
    )


def decode_ssd(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """SSD as exported before its suppression: scores (1, N, 1 + C), class 0 the background, and boxes (1, N, 4).

    Boxes are corners as shares of the input. A prior may answer for several classes. The outputs come in either order.
    """
    if len(outputs) != 2 or any(o.ndim != 3 or o.shape[0] != 1 for o in outputs) or not _ssd_pair(*outputs):
        shapes = ", ".join(str(o.shape) for o in outputs)
        raise ValueError(f"an SSD's outputs have shapes (1, N, 1 + classes) and (1, N, 4), got {shapes}")
    scores, boxes = sorted((o[0] for o in outputs), key=lambda o: o.shape[1] == 4)
    priors, classes = np.nonzero(scores[:, 1:] >= threshold)
    corners = boxes[priors] * np.array([*size, *size], np.float32)
    return Candidates(
        corners.astype(np.float32), scores[priors, classes + 1].astype(np.float32), classes.astype(np.int32)
    )


def decode_torchvision(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """A detector of torchvision as exported whole: boxes (N, 4) in input pixels, labels (N,), scores (N,).

    Labels count from 1, as in its checkpoints, whose class 0 is the background; suppression has been done.
    """
    shapes = ", ".join(str(o.shape) for o in outputs)
    if len(outputs) != 3 or outputs[0].ndim != 2 or outputs[0].shape[1] != 4:
        raise ValueError(f"torchvision's outputs have shapes (N, 4), (N,) and (N,), got {shapes}")
    flat = [o for o in outputs[1:] if o.shape == (len(outputs[0]),)]
    labels = next((o for o in flat if np.issubdtype(o.dtype, np.integer)), None)
    scores = next((o for o in flat if np.issubdtype(o.dtype, np.floating)), None)
    if labels is None or scores is None:
        raise ValueError(f"torchvision's outputs are boxes, whole-numbered labels and scores, got {shapes}")
    keep = (scores >= threshold) & (labels > 0)
    return Candidates(
        outputs[0][keep].astype(np.float32), scores[keep].astype(np.float32), (labels[keep] - 1).astype(np.int32)
    )


def _ssd_pair(a: NDArray[Any], b: NDArray[Any]) -> bool:
    return bool(a.shape[1] == b.shape[1] and (a.shape[2] == 4) != (b.shape[2] == 4))


DecoderName = Literal["fastestdet", "yolov5", "yolov8", "end2end", "ssd", "torchvision"]

LAYOUTS: dict[DecoderName, Layout] = {
    "fastestdet": Layout(decode_fastestdet, bgr=True, fit="stretch", classes=lambda o: int(o[0].shape[1]) - 5),
    "yolov5": Layout(decode_yolov5, bgr=False, fit="letterbox", classes=lambda o: int(o[0].shape[2]) - 5),
    "yolov8": Layout(decode_yolov8, bgr=False, fit="letterbox", classes=lambda o: int(o[0].shape[1]) - 4),
    "end2end": Layout(decode_end2end, bgr=False, fit="letterbox", classes=None),
    "ssd": Layout(
        decode_ssd,
        bgr=False,
        fit="stretch",
        classes=lambda o: int(next(a.shape[2] for a in o if a.shape[2] != 4)) - 1,
        mean=127.0,
        scale=128.0,
    ),
    "torchvision": Layout(decode_torchvision, bgr=False, fit="stretch", classes=None),
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
