"""The last step of all segmenters: unsure pixels become void, and classes become a message."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Image, SegmentationMap
from operators.image.letterbox import ImageFit
from operators.inference import ModelError

VOID = 255


def least_of(
    names: Sequence[str], threshold: float, by_class: Mapping[str, float], where: str
) -> NDArray[np.float32] | float:
    """Returns the least confidence of each class (C,), or of all where no class has a separate one.

    Raises ModelError for a class that the model does not know, and a share that is none.
    """
    for name, value in by_class.items():
        if name not in names or not 0 <= value <= 1:
            raise ModelError(f"{where} has {name!r}: {value}; it takes shares from 0 to 1 for {', '.join(names)}")
    return np.array([by_class.get(n, threshold) for n in names], np.float32) if by_class else threshold


def labelled(
    image: Image,
    names: Sequence[str],
    classes: NDArray[Any],
    confidence: NDArray[np.float32] | None,
    *,
    least: float | NDArray[np.float32] = 0.0,
    with_confidence: bool = False,
    void: int = VOID,
) -> SegmentationMap:
    """Returns the map of an image from classes (H, W) and, where known, their confidence (H, W).

    Pixels whose confidence is below `least`, one number or one for each class (C,), become void.
    """
    if confidence is not None and np.any(least):
        floor = least[np.minimum(classes, len(least) - 1)] if isinstance(least, np.ndarray) else least
        classes = np.where(confidence < floor, classes.dtype.type(void), classes)
    return SegmentationMap(
        stamp=image.stamp,
        frame=image.frame,
        class_names=tuple(names),
        void=void,
        classes=classes,
        confidence=np.clip(confidence, 0, 1) if confidence is not None and with_confidence else None,
    )


def enlarged(values: NDArray[Any], fit: ImageFit, interpolation: int) -> NDArray[Any]:
    """Returns the part (H, W) or (H, W, C) of the network's input that the image takes, at the image's size."""
    (x, y), (width, height) = fit.offset, fit.inner
    part = np.ascontiguousarray(values[y : y + height, x : x + width])
    return part if fit.inner == fit.image else np.asarray(cv2.resize(part, fit.image, interpolation=interpolation))
