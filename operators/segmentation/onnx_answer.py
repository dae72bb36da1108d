"""Answers of segmentation networks in ONNX files, as scores or classes of the image's pixels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.image.letterbox import Fit


def scores_of(output: NDArray[Any], classes: int | None, probabilities: bool) -> NDArray[np.float32]:
    """Returns scores (C, H, W) of an output (1, C, H, W), or (1, H, W, C) where that alone fits so many classes.

    One channel is a class and what is not of it: two classes, the background first. Raises ValueError for another
    shape.
    """
    if output.ndim != 4 or output.shape[0] != 1 or 0 in output.shape:
        raise ValueError(f"scores have shape (1, classes, H, W) or (1, H, W, classes), got {output.shape}")
    last = classes is not None and output.shape[1] != classes == output.shape[3]
    scores = np.asarray(output[0].transpose(2, 0, 1) if last else output[0], np.float32)
    if len(scores) > 1:
        return scores
    return np.concatenate([1 - scores if probabilities else np.zeros_like(scores), scores])


def classes_of(output: NDArray[Any]) -> NDArray[np.int64]:
    """Returns classes (H, W) of an output of whole numbers, (H, W) with axes of extent 1. Raises ValueError."""
    extents = [extent for extent in output.shape if extent != 1]
    if len(extents) != 2:
        raise ValueError(f"a map of classes has shape (1, H, W), got {output.shape}")
    return output.reshape(extents).astype(np.int64)


def at_image(values: NDArray[Any], fit: Fit, interpolation: int) -> NDArray[Any]:
    """Returns the plane (H, W) of a network's output at the size of the image, without what was only padding.

    The plane covers the input, in whatever resolution.
    """
    if fit.inner != fit.target:
        if (values.shape[1], values.shape[0]) != fit.target:
            values = cv2.resize(values, fit.target, interpolation=interpolation)
        (x, y), (width, height) = fit.offset, fit.inner
        values = values[y : y + height, x : x + width]
    if (values.shape[1], values.shape[0]) == fit.image:
        return np.ascontiguousarray(values)
    return np.asarray(cv2.resize(np.ascontiguousarray(values), fit.image, interpolation=interpolation))


def best_of(scores: NDArray[np.float32], probabilities: bool) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Returns the best class (H, W) of scores (C, H, W), of equal ones the first, and its probability (H, W)."""
    best = scores.argmax(axis=0)
    highest = np.take_along_axis(scores, best[None], axis=0)[0]
    if probabilities:
        return best, np.clip(highest, 0, 1)
    return best, (1 / np.exp(scores - highest).sum(axis=0, dtype=np.float32)).astype(np.float32)
