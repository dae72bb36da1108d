"""Detection scores are those of pycocotools."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.evaluation.detection_score import ClassScore, ScoredFrame, score_frames

CLASSES = ("cup", "chair", "plant")
LABELS = (*CLASSES, "unjudged")
SIDES = st.integers(0, 12)
BOXES = st.tuples(SIDES, SIDES, SIDES, SIDES)


@st.composite
def frames(draw: st.DrawFn) -> ScoredFrame:
    """An image of few possible boxes and scores, so that ties and equal overlaps are common."""
    truths = draw(st.lists(st.tuples(BOXES, st.sampled_from(LABELS), st.booleans()), max_size=6))
    found = draw(st.lists(st.tuples(BOXES, st.sampled_from(LABELS), st.integers(0, 4)), max_size=10))
    return ScoredFrame(
        _corners([box for box, _, _ in truths]),
        tuple(label for _, label, _ in truths),
        np.array([ignored for _, _, ignored in truths], np.bool_),
        _corners([box for box, _, _ in found]),
        tuple(label for _, label, _ in found),
        np.array([score for _, _, score in found], np.float32) / np.float32(5),
    )


def _corners(boxes: Sequence[tuple[int, int, int, int]]) -> np.ndarray:
    at = np.array(boxes, np.float64).reshape(-1, 4)
    return np.hstack([at[:, :2], at[:, :2] + at[:, 2:]])


@settings(max_examples=60, deadline=None)
@given(st.lists(frames(), min_size=1, max_size=5), st.integers(1, 4), st.sampled_from([0.3, 0.5, 0.75, 1.0]))
def test_scores_are_those_of_pycocotools(images: list[ScoredFrame], most: int, iou: float) -> None:
    found = score_frames(images, CLASSES, max_detections=most, iou=iou, score_threshold=0.4)

    assert found == by_pycocotools(images, CLASSES, most=most, iou=iou, threshold=0.4)


def test_many_images_of_many_boxes_score_as_with_pycocotools() -> None:
    random = np.random.default_rng(5)
    images = []
    for _ in range(20):
        true = random.uniform(0, 200, (6, 4))
        near = true[random.integers(0, 6, 60)] + random.normal(0, 6, (60, 4))
        images.append(
            ScoredFrame(
                np.hstack([true[:, :2], true[:, :2] + true[:, 2:]]),
                tuple(random.choice(LABELS, 6)),
                random.random(6) < 0.2,
                np.hstack([near[:, :2], near[:, :2] + near[:, 2:]]),
                tuple(random.choice(LABELS, 60)),
                random.random(60).astype(np.float32),
            )
        )

    found = score_frames(images, CLASSES, max_detections=15, iou=0.6, score_threshold=0.5)

    assert found == by_pycocotools(images, CLASSES, most=15, iou=0.6, threshold=0.5)
    assert all(score.hits and score.false_alarms for score in found.values())


def by_pycocotools(
    images: Sequence[ScoredFrame], classes: Sequence[str], *, most: int, iou: float, threshold: float
) -> dict[str, ClassScore]:
    pytest.importorskip("pycocotools")
    from pycocotools.cocoeval import COCOeval

    truths, found = [], []
    for k, frame in enumerate(images):
        for box, label, ignored in zip(frame.truth_boxes, frame.truth_labels, frame.ignored, strict=True):
            if label in classes:
                row = _row(k, classes.index(label), box) | {"iscrowd": 0}
                truths.append(row | ({"area": -1.0} if ignored else {}))
        for box, label, score in zip(frame.boxes, frame.labels, frame.scores, strict=True):
            if label in classes:
                found.append(_row(k, classes.index(label), box) | {"score": float(score)})
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its progress
        evaluation = COCOeval(_coco(len(images), classes, truths), _coco(len(images), classes, found), "bbox")
        evaluation.params.iouThrs = np.append(evaluation.params.iouThrs, iou)
        evaluation.params.maxDets = [most]
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [[0.0, 1e10]], ["all"]
        evaluation.evaluate()
        evaluation.accumulate()
    curves = evaluation.eval["precision"][:-1, :, :, 0, 0]
    scores = {}
    for k, name in enumerate(classes):
        own = [image for image in evaluation.evalImgs if image is not None and image["category_id"] == k]
        hits = alarms = 0
        for image in own:
            counted = (np.array(image["dtScores"]) >= float(np.float32(threshold))) & ~image["dtIgnore"][-1]
            hits += int(np.count_nonzero(counted & (image["dtMatches"][-1] > 0)))
            alarms += int(np.count_nonzero(counted & (image["dtMatches"][-1] == 0)))
        rows = [row for row in truths if row["category_id"] == k]
        ignored = sum(row["area"] < 0 for row in rows)
        ap50 = float(curves[0, :, k].mean()) if len(rows) > ignored else None
        mean = float(curves[:, :, k].mean()) if len(rows) > ignored else None
        every = sum(row["category_id"] == k for row in found)
        scores[name] = ClassScore(len(rows) - ignored, ignored, every, ap50, mean, hits, alarms)
    return scores


def _row(image: int, category: int, box: np.ndarray) -> dict[str, Any]:
    x1, y1, x2, y2 = box.tolist()
    size = (x2 - x1, y2 - y1)
    return {"image_id": image, "category_id": category, "bbox": [x1, y1, *size], "area": size[0] * size[1]}


def _coco(images: int, classes: Sequence[str], rows: list[dict[str, Any]]) -> Any:
    from pycocotools.coco import COCO

    for number, row in enumerate(rows, 1):  # 0 would be no match
        row["id"] = number
    coco = COCO()
    coco.dataset = {
        "info": {},
        "images": [{"id": k} for k in range(images)],
        "categories": [{"id": k, "name": name} for k, name in enumerate(classes)],
        "annotations": rows,
    }
    coco.createIndex()
    return coco
