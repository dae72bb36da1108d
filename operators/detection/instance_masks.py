"""Masks of detected objects in the pixels of the image, from what networks give of them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.detection.decode import Candidates, Outputs
from operators.image.letterbox import ImageFit

Masks = NDArray[np.bool_]
"""(N, height, width) in the pixels of the image."""


def by_prototypes(found: Candidates, outputs: Outputs, fit: ImageFit) -> Masks:
    """Combines prototypes (1, K, h, w) of the input by K coefficients a box; what lies outside the box is cut off.

    Source: `process_mask_native` of Ultralytics, after Bolya et al., "YOLACT", 2019.
    """
    prototypes = outputs[1][0].astype(np.float32)
    assert found.masks is not None
    logits = (found.masks @ prototypes.reshape(len(prototypes), -1)).reshape(-1, *prototypes.shape[1:])
    boxes = fit.restore(found.boxes)
    made = [inside(_at_image(plane, fit) > 0, box) for plane, box in zip(logits, boxes, strict=True)]
    return np.stack(made) if made else _none(fit)


def by_planes(found: Candidates, outputs: Outputs, fit: ImageFit) -> Masks:
    """Reads logits (N, h, w) that cover the input. Source: `PostProcess` of RF-DETR's segmentation."""
    assert found.masks is not None
    return np.stack([_at_image(plane, fit) > 0 for plane in found.masks]) if len(found.masks) else _none(fit)


def by_probabilities(found: Candidates, outputs: Outputs, fit: ImageFit) -> Masks:
    """Reads probabilities (N, h, w), which cover the input, or, where they have another size, the box of each.

    Source: `paste_masks_in_image` of torchvision's Mask R-CNN (He et al., 2017).
    """
    assert found.masks is not None
    if not len(found.masks):
        return _none(fit)
    if found.masks.shape[1:] == (fit.target[1], fit.target[0]):
        return np.stack([_at_image(plane, fit) > 0.5 for plane in found.masks])
    boxes = fit.restore(found.boxes)
    return np.stack([_pasted(plane, box, fit.image) for plane, box in zip(found.masks, boxes, strict=True)])


def _none(fit: ImageFit) -> Masks:
    return np.zeros((0, fit.image[1], fit.image[0]), np.bool_)


def _at_image(plane: NDArray[np.float32], fit: ImageFit) -> NDArray[np.float32]:
    """Returns a plane that covers the input at the size of the image, without what was only padding."""
    height, width = plane.shape
    x, y = (offset / extent for offset, extent in zip(fit.offset, fit.target, strict=True))
    w, h = (inner / extent for inner, extent in zip(fit.inner, fit.target, strict=True))
    left, upper = round(x * width), round(y * height)
    right, lower = max(left + 1, round((x + w) * width)), max(upper + 1, round((y + h) * height))
    cut = np.ascontiguousarray(plane[upper:lower, left:right])
    return np.asarray(cv2.resize(cut, fit.image, interpolation=cv2.INTER_LINEAR), np.float32)


def inside(mask: NDArray[np.bool_], box: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Cuts off pixels whose upper left corners are outside a box."""
    rows, columns = np.arange(mask.shape[0]), np.arange(mask.shape[1])
    within = ((rows >= box[1]) & (rows < box[3]))[:, None] & ((columns >= box[0]) & (columns < box[2]))
    return np.asarray(mask & within)


def _pasted(plane: NDArray[np.float32], box: NDArray[np.float32], image: tuple[int, int]) -> NDArray[np.bool_]:
    """Returns a box's own mask (h, w) in an image of (width, height): with a border of zeros, so that it ends at 0."""
    padded = np.pad(plane, 1)
    x1, y1, x2, y2 = box.tolist()
    grow = [(n + 2) / n for n in (plane.shape[1], plane.shape[0])]
    half = [(x2 - x1) / 2 * grow[0], (y2 - y1) / 2 * grow[1]]
    middle = [(x1 + x2) / 2, (y1 + y2) / 2]
    left, upper = int(middle[0] - half[0]), int(middle[1] - half[1])
    right, lower = int(middle[0] + half[0]), int(middle[1] + half[1])
    size = (max(right - left + 1, 1), max(lower - upper + 1, 1))
    sure = cv2.resize(padded, size, interpolation=cv2.INTER_LINEAR) > 0.5
    made = np.zeros((image[1], image[0]), np.bool_)
    x, y = max(left, 0), max(upper, 0)
    end_x, end_y = min(right + 1, image[0]), min(lower + 1, image[1])
    made[y:end_y, x:end_x] = sure[y - upper : end_y - upper, x - left : end_x - left]
    return made
