"""A labelled image as a training sample: a random view of it, and the boxes that are still in sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.detection.custom.dataset import LabelledImage
from operators.learning.augmentation import Pixels, Variation, fitted, recolored, varied, warp

_LEAST_SHARE = 0.35
"""An object of which the view cuts away more becomes an ignored one."""


@dataclass(frozen=True, eq=False)
class DetectionSample:
    """`pixels` (H, W, 3) RGB of the input; `boxes` (N, 4) corners in its pixels, `classes` and `ignored` (N,)."""

    pixels: Pixels
    boxes: NDArray[np.float32]
    classes: NDArray[np.int32]
    ignored: NDArray[np.bool_]


def view(
    image: LabelledImage, target: tuple[int, int], variation: Variation, rng: np.random.Generator
) -> DetectionSample:
    """A random view of a labelled image, of size `target` (width, height)."""
    pixels = image.read()
    affine = varied(fitted((pixels.shape[1], pixels.shape[0]), target), target, variation, rng)
    return seen_through(image, pixels, affine, target, variation, rng)


def seen_through(
    image: LabelledImage,
    pixels: Pixels,
    affine: NDArray[np.float64],
    target: tuple[int, int],
    variation: Variation,
    rng: np.random.Generator,
) -> DetectionSample:
    """The view of a labelled image, whose `pixels` are given, under a map, in random colours."""
    size = (pixels.shape[1], pixels.shape[0])
    boxes, ignored = moved_boxes(image.boxes * np.array([*size, *size], np.float32), image.ignored, affine, target)
    seen = (boxes[:, 2:] - boxes[:, :2] > 1).all(axis=1)
    return DetectionSample(
        recolored(warp(pixels, affine, target), variation, rng), boxes[seen], image.classes[seen], ignored[seen]
    )


def moved_boxes(
    boxes: NDArray[np.float32], ignored: NDArray[np.bool_], affine: NDArray[np.float64], target: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Boxes (N, 4) under an affine map without rotation, cut at the border, and which of them to ignore."""
    scale, offset = np.array([affine[0, 0], affine[1, 1]]), affine[:, 2]
    ends = np.stack([boxes[:, :2] * scale + offset, boxes[:, 2:] * scale + offset])
    corners = np.concatenate([ends.min(axis=0), ends.max(axis=0)], axis=1)
    cut = np.clip(corners, 0, [*target, *target])
    area, left = _areas(corners), _areas(cut)
    mostly_gone = left < _LEAST_SHARE * np.maximum(area, 1e-6)
    return cut.astype(np.float32), ignored | mostly_gone


def _areas(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))
