"""Decoders of networks of the YOLO family and their like: one row, or one cell of a grid, gives one box."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.detection.decode import Candidates, Outputs, Size, best_class, corners, shapes_of, sigmoid

_YOLOX_STRIDES = (8, 16, 32)
_NANODET_STRIDES = (8, 16, 32, 64)
_BINS = 8  # of NanoDet's distribution over the distance to one side


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
    w, h = sigmoid(cells[3, keep]), sigmoid(cells[4, keep])
    boxes = corners(x, y, w, h) * np.array([*size, *size], np.float32)
    return Candidates(boxes.astype(np.float32), scores[keep], classes[keep])


def decode_yolov5(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """YOLOv5 to v7 as exported: (1, N, 5 + C), centre and size in input pixels, objectness, class scores.

    A model of the task segment has prototypes (1, K, h, w) as a second output, and K coefficients behind the scores.
    """
    output, kinds = outputs[0], prototypes_in(outputs)
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[2] < 6 + kinds:
        raise ValueError(f"a YOLOv5 output has shape (1, N, 5 + classes + coefficients), got {shapes_of(outputs)}")
    rows = output[0]
    end = rows.shape[1] - kinds
    return best_class(rows[:, :4], rows[:, 5:end] * rows[:, 4:5], threshold, rows[:, end:] if kinds else None)


def decode_yolov8(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """YOLOv8 and later as exported without NMS: (1, 4 + C, N), centre and size in input pixels, class scores.

    A model of the task segment has prototypes (1, K, h, w) as a second output, and K coefficients behind the scores.
    """
    output = outputs[0]
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[1] < 5:
        raise ValueError(f"a YOLOv8 output has shape (1, 4 + classes, N), got {output.shape}")
    if output.shape[2] == 6 < output.shape[1]:
        raise ValueError(f"{output.shape} is the output of an export with its suppression inside: decoder end2end")
    kinds = prototypes_in(outputs)
    if output.shape[1] < 5 + kinds:
        raise ValueError(
            f"outputs {shapes_of(outputs)} have fewer channels than 4 + classes + {kinds} coefficients of masks"
        )
    rows = output[0].T
    end = rows.shape[1] - kinds
    return best_class(rows[:, :4], rows[:, 4:end], threshold, rows[:, end:] if kinds else None)


def prototypes_in(outputs: Outputs) -> int:
    """Returns how many prototypes of masks (1, K, h, w) the second output holds; 0 without."""
    return int(outputs[1].shape[1]) if len(outputs) > 1 and outputs[1].ndim == 4 else 0


def decode_yolox(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """YOLOX as its authors export it: (1, N, 5 + C), rows of grids with strides of 8, 16 and 32 pixels.

    Columns: centre as offset from the cell (x, y), logarithm of the size in strides (w, h), objectness, class scores,
    the sigmoid applied. Source: `demo_postprocess` and `multiclass_nms` of YOLOX (Ge et al., 2021; Apache-2.0).
    """
    output = outputs[0]
    cells, strides = _cells(size, _YOLOX_STRIDES)
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[1] != len(cells) or output.shape[2] < 6:
        raise ValueError(
            f"a YOLOX output for an input of {size[0]}x{size[1]} has shape (1, {len(cells)}, 5 + classes), "
            f"got {output.shape}"
        )
    rows = output[0]
    centers = (rows[:, :2] + cells) * strides[:, None]
    sizes = np.exp(rows[:, 2:4]) * strides[:, None]
    return best_class(np.hstack([centers, sizes]), rows[:, 5:] * rows[:, 4:5], threshold)


def decode_nanodet(outputs: Outputs, size: Size, threshold: float) -> Candidates:
    """NanoDet-Plus as its authors export it: (1, N, C + 32), rows of grids with strides of 8, 16, 32 and 64 pixels.

    Columns: class scores, the sigmoid applied, then a distribution over 0 to 7 strides for the distance of each side
    from the cell's corner, before its softmax. A cell may answer for several classes. Source: `NanoDetPlusHead` of
    NanoDet (Lyu, 2021; Apache-2.0), after Li et al., "Generalized Focal Loss", 2020.
    """
    output = outputs[0]
    cells, strides = _cells(size, _NANODET_STRIDES)
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[1] != len(cells) or output.shape[2] <= 4 * _BINS:
        raise ValueError(
            f"a NanoDet-Plus output for an input of {size[0]}x{size[1]} has shape (1, {len(cells)}, classes + 32), "
            f"got {output.shape}"
        )
    rows, classes = np.nonzero(output[0, :, : -4 * _BINS] >= threshold)
    logits = output[0, rows, -4 * _BINS :].reshape(-1, 4, _BINS)
    shares = np.exp(logits - logits.max(axis=2, keepdims=True))
    shares /= shares.sum(axis=2, keepdims=True)
    distances = (shares @ np.arange(_BINS, dtype=np.float32)) * strides[rows, None]
    middles = cells[rows] * strides[rows, None]
    boxes = np.hstack([middles - distances[:, :2], middles + distances[:, 2:]])
    boxes = np.clip(boxes, 0, np.array([*size, *size], np.float32))
    return Candidates(boxes.astype(np.float32), output[0, rows, classes].astype(np.float32), classes.astype(np.int32))


def _cells(size: Size, strides: tuple[int, ...]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns column and row (N, 2) of the cells of all grids, finest first and row by row, and their strides (N,)."""
    cells: list[NDArray[Any]] = []
    for stride in strides:
        columns, rows = (-(-extent // stride) for extent in size)
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        cells.append(np.hstack([grid, np.full((len(grid), 1), stride)]))
    made = np.concatenate(cells).astype(np.float32)
    return made[:, :2], made[:, 2]
