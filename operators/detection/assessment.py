"""The score and speed of a detector's network file on labelled images: the operator as it runs in a graph."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.messages import Detections2D, Image
from operators.detection.custom.dataset import DataError, LabelledImage
from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.custom_detector import CustomDetector
from operators.detection.decode import Candidates

SCORING = {"score_threshold": 0.01, "nms_iou": 0.5, "max_detections": 100}
"""Low, since average precision asks for the whole curve."""


def assess(weights: Path, classes: Sequence[str], images: Sequence[LabelledImage]) -> dict[str, Any]:
    """AP50 and AP of the file on images labelled with `classes`, matched by name, and the median milliseconds an image.

    Raises DataError where the network lacks a class that is labelled.
    """
    detector = CustomDetector(weights=str(weights), **SCORING)
    detector.setup()
    scored, times = [], []
    for k, labels in enumerate(images):
        pixels = labels.read()
        image = Image(stamp=k, frame="camera", data=pixels)
        began = time.perf_counter()
        found = detector.process(image)
        times.append(time.perf_counter() - began)
        size = (image.width, image.height)
        boxes = labels.boxes * np.array([*size, *size], np.float32)
        scored.append(ScoredImage(boxes, labels.classes, labels.ignored, candidates(found, classes)))
        _check(weights, labels, classes, found.class_names)
    score = score_detections(scored, classes)
    return {
        "images": len(images),
        "objects": score.objects,
        "ap50": score.ap50,
        "ap": score.ap,
        "per_class": score.per_class,
        "ms": 1000 * float(np.median(times)) if times else 0.0,
    }


def candidates(found: Detections2D, classes: Sequence[str]) -> Candidates:
    """Returns what was found, numbered as `classes`; boxes of other classes are left out."""
    number = np.array([classes.index(n) if n in classes else -1 for n in found.class_names], np.int32)
    labels = number[found.class_ids]
    keep = labels >= 0
    return Candidates(found.boxes[keep], found.scores[keep], labels[keep])


def _check(weights: Path, labels: LabelledImage, classes: Sequence[str], known: Sequence[str]) -> None:
    unknown = [classes[k] for k in labels.classes[~labels.ignored].tolist() if classes[k] not in known]
    if unknown:
        raise DataError(f"{labels.file} has an object {unknown[0]!r}, but {weights} finds only {', '.join(known)}")
