"""The score of a detector by COCO's rules (pycocotools)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.detection.decode import Candidates


@dataclass(frozen=True, eq=False)
class ScoredImage:
    """The truth of an image and what was found; boxes (N, 4) as corners in pixels, `ignored` (N,) bool."""

    boxes: NDArray[np.float32]
    classes: NDArray[np.int32]
    ignored: NDArray[np.bool_]
    found: Candidates


@dataclass(frozen=True)
class DetectionScore:
    """Average precision, mean over the classes that occur: at IoU 0.5, at 0.5 to 0.95, and at 0.5 for each class."""

    ap50: float
    ap: float
    per_class: dict[str, float] = field(default_factory=dict)
    objects: int = 0


def score_detections(images: Sequence[ScoredImage], classes: Sequence[str]) -> DetectionScore:
    """Scores what was found. An ignored object counts neither as missed nor, when found, as wrong.

    It is matched by plain IoU (COCO's area rule), not as a crowd, which would swallow every box inside of it.
    """
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    objects = int(sum((~image.ignored).sum() for image in images))
    results = [row for i, image in enumerate(images, 1) for row in _results(i, image)]
    if not objects or not results:
        labelled = {int(label) for image in images for label in image.classes[~image.ignored]}
        return DetectionScore(0.0, 0.0, {name: 0.0 for k, name in enumerate(classes) if k in labelled}, objects)
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO()
        truth.dataset = _dataset(images, classes)
        truth.createIndex()
        evaluation = COCOeval(truth, truth.loadRes(results), "bbox")
        evaluation.params.maxDets = [1, 10, 100]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, :, 0, 2]  # IoU, recall, class
    present = precision[0].max(axis=0) > -1
    if not present.any():
        return DetectionScore(0.0, 0.0, {}, objects)
    ap50 = precision[0].mean(axis=0)
    return DetectionScore(
        float(ap50[present].mean()),
        float(precision[:, :, present].mean()),
        {name: float(ap50[k]) for k, name in enumerate(classes) if present[k]},
        objects,
    )


def _dataset(images: Sequence[ScoredImage], classes: Sequence[str]) -> dict[str, Any]:
    annotations: list[dict[str, Any]] = []
    for i, image in enumerate(images, 1):
        for box, label, ignored in zip(image.boxes, image.classes, image.ignored, strict=True):
            x1, y1, x2, y2 = map(float, box)
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": i,
                    "category_id": int(label),
                    "bbox": [x1, y1, x2 - x1, y2 - y1],
                    "area": -1.0 if ignored else (x2 - x1) * (y2 - y1),
                    "iscrowd": 0,
                }
            )
    return {
        "info": {},
        "images": [{"id": i} for i in range(1, len(images) + 1)],
        "annotations": annotations,
        "categories": [{"id": k, "name": name} for k, name in enumerate(classes)],
    }


def _results(image_id: int, image: ScoredImage) -> list[dict[str, Any]]:
    found = image.found
    return [
        {"image_id": image_id, "category_id": label, "bbox": [x1, y1, x2 - x1, y2 - y1], "score": score}
        for (x1, y1, x2, y2), score, label in zip(
            found.boxes.tolist(), found.scores.tolist(), found.classes.tolist(), strict=True
        )
    ]
