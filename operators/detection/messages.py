"""Detections2D of found boxes, scores, classes and masks."""

from __future__ import annotations

import numpy as np

from dataflow.messages import Detections2D, Image, pack_masks
from operators.detection.decode import Candidates


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
