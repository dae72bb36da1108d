"""The score and speed of a segmenter's network file on images with masks: the operator as it runs in a graph."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Image, SegmentationMap
from operators.segmentation.dataset import MaskedImage
from operators.segmentation.labelled import VOID
from operators.segmentation.score import confusion, mean_iou, named
from operators.segmentation.segmenter import Segmenter


def assess(weights: Path, classes: Sequence[str], images: Sequence[MaskedImage]) -> dict[str, Any]:
    """Mean IoU of the file on images with masks of `classes`, matched by name, and the median milliseconds an image."""
    segmenter = Segmenter(weights=str(weights))
    segmenter.setup()
    table = np.zeros((len(classes), len(classes) + 1), np.int64)
    times = []
    for k, masked in enumerate(images):
        pixels, mask = masked.read(len(classes))
        image = Image(stamp=k, frame="camera", data=pixels)
        began = time.perf_counter()
        found = segmenter.process(image)
        times.append(time.perf_counter() - began)
        table += confusion(mask, renumbered(found, classes), len(classes))
    return {
        "images": len(images),
        "miou": mean_iou(table),
        "per_class": named(table, classes),
        "ms": 1000 * float(np.median(times)) if times else 0.0,
    }


def renumbered(found: SegmentationMap, classes: Sequence[str]) -> NDArray[np.uint8]:
    """The class map (H, W) numbered as `classes`; what they do not name is void."""
    table = np.full(256, VOID, np.uint8)
    for k, name in enumerate(found.class_names):
        if name in classes:
            table[k] = classes.index(name)
    return table[found.classes]
