"""Average precision, precision and recall of detections, by COCO's rules (Lin et al., ECCV 2014) with pycocotools."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pycocotools.coco import COCO

_IGNORED_AREA = -1.0  # outside of COCO's area range, so neither a miss nor, when matched, a false positive
_AREA_RANGE = (0.0, 1e10)


@dataclass(frozen=True, eq=False)
class ScoredFrame:
    """Truth and detections of one image: boxes (N, 4) as corners in pixels of one image, class names (N,)."""

    truth_boxes: NDArray[np.float64]
    truth_labels: tuple[str, ...]
    ignored: NDArray[np.bool_]
    boxes: NDArray[np.float64]
    labels: tuple[str, ...]
    scores: NDArray[np.float32]


@dataclass(frozen=True)
class ClassScore:
    """Scores of one class. APs are None where the truth has no object that counts.

    `hits` and `false_alarms` count the detections at the operating point; those on ignored objects are neither.
    """

    truth: int
    ignored: int
    detections: int
    ap50: float | None
    ap50_95: float | None
    hits: int
    false_alarms: int


def precision(hits: int, false_alarms: int) -> float | None:
    """Share of the detections that are right; None without any."""
    return hits / (hits + false_alarms) if hits + false_alarms else None


def recall(hits: int, truth: int) -> float | None:
    """Share of the objects that were found; None without any."""
    return hits / truth if truth else None


def score_frames(
    frames: Sequence[ScoredFrame], classes: Sequence[str], *, max_detections: int, iou: float, score_threshold: float
) -> dict[str, ClassScore]:
    """The score of each class; objects and detections of other classes are left out.

    AP50 is the average precision at IoU 0.5, AP50:95 its mean over IoU 0.5, 0.55 ... 0.95; the operating point is all
    detections of at least `score_threshold`, matched at `iou`. `max_detections` holds for an image and class. An
    ignored object takes at most one detection, by plain IoU: as COCO treats objects outside of its area range, and
    not as its crowds, which would swallow every box inside of them.
    """
    from pycocotools.cocoeval import COCOeval

    if not frames or not classes:
        return {name: ClassScore(0, 0, 0, None, None, 0, 0) for name in classes}
    numbers = {name: k for k, name in enumerate(classes)}
    images = [{"id": k} for k in range(len(frames))]
    categories = [{"id": k, "name": name} for name, k in numbers.items()]
    truths, found = list(_truths(frames, numbers)), list(_found(frames, numbers))
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        evaluation = COCOeval(_coco(images, categories, truths), _coco(images, categories, found), "bbox")
        averaged = len(evaluation.params.iouThrs)
        evaluation.params.iouThrs = np.append(evaluation.params.iouThrs, iou)
        evaluation.params.maxDets = [max_detections]
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [list(_AREA_RANGE)], ["all"]
        evaluation.evaluate()
        evaluation.accumulate()
    curves = evaluation.eval["precision"][:averaged, :, :, 0, 0]  # IoU, recall, class
    hits, false_alarms = _at_threshold(evaluation.evalImgs, len(classes), score_threshold)
    counts = [_per_class(rows, len(classes)) for rows in (truths, [t for t in truths if t["area"] < 0], found)]
    scores = {}
    for name, k in numbers.items():
        objects, ignored, detections = (int(count[k]) for count in counts)
        scored = objects > ignored
        scores[name] = ClassScore(
            objects - ignored,
            ignored,
            detections,
            float(curves[0, :, k].mean()) if scored else None,
            float(curves[:, :, k].mean()) if scored else None,
            int(hits[k]),
            int(false_alarms[k]),
        )
    return scores


def _at_threshold(
    evaluated: Sequence[dict[str, Any] | None], classes: int, threshold: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Hits and false alarms of each class at the last IoU. Matching is greedy by score, so weaker boxes change none."""
    lowest = float(np.float32(threshold))  # scores are float32
    hits, false_alarms = np.zeros(classes, np.int64), np.zeros(classes, np.int64)
    for image in evaluated:
        if image is not None:
            counted = (np.array(image["dtScores"]) >= lowest) & ~image["dtIgnore"][-1]
            matched = image["dtMatches"][-1] > 0
            hits[image["category_id"]] += np.count_nonzero(counted & matched)
            false_alarms[image["category_id"]] += np.count_nonzero(counted & ~matched)
    return hits, false_alarms


def _truths(frames: Sequence[ScoredFrame], numbers: dict[str, int]) -> Iterator[dict[str, Any]]:
    for k, frame in enumerate(frames):
        for box, label, ignored in zip(frame.truth_boxes, frame.truth_labels, frame.ignored, strict=True):
            if label in numbers:
                row = _row(k, numbers[label], box)
                yield row | {"iscrowd": 0, "area": _IGNORED_AREA if ignored else row["area"]}


def _found(frames: Sequence[ScoredFrame], numbers: dict[str, int]) -> Iterator[dict[str, Any]]:
    for k, frame in enumerate(frames):
        for box, label, score in zip(frame.boxes, frame.labels, frame.scores, strict=True):
            if label in numbers:
                yield _row(k, numbers[label], box) | {"score": float(score)}


def _row(image: int, category: int, box: NDArray[np.float64]) -> dict[str, Any]:
    x1, y1, x2, y2 = box.tolist()
    size = (x2 - x1, y2 - y1)
    return {"image_id": image, "category_id": category, "bbox": [x1, y1, *size], "area": size[0] * size[1]}


def _coco(images: list[dict[str, Any]], categories: list[dict[str, Any]], rows: list[dict[str, Any]]) -> COCO:
    from pycocotools.coco import COCO

    coco = COCO()
    for number, row in enumerate(rows, 1):  # COCOeval takes the id 0 for no match
        row["id"] = number
    coco.dataset = {"info": {}, "images": images, "categories": categories, "annotations": rows}
    coco.createIndex()
    return coco


def _per_class(rows: Sequence[dict[str, Any]], classes: int) -> NDArray[np.int64]:
    return np.bincount(np.array([row["category_id"] for row in rows], np.int64), minlength=classes)
