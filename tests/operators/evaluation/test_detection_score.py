"""Scores of frames that are matched as they come, against one COCOeval over all of them."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from operators.evaluation import detection_score
from operators.evaluation.detection_score import ClassScore, DetectionScore, ScoredFrame, score_frames

NAMES = ("ball", "chair", "mug")


def frame(rng: np.random.Generator) -> ScoredFrame:
    """Objects, and detections beside, on and far from them; scores of few values, so that many are equal."""
    count = int(rng.integers(0, 5))
    corners = rng.uniform(0, 60, (count, 2))
    truth = np.hstack([corners, corners + rng.uniform(5, 40, (count, 2))])
    labels = [NAMES[k] for k in rng.integers(0, len(NAMES), count)]
    moved = truth[rng.integers(0, count, 6)] + rng.normal(0, 3, (6, 4)) if count else np.zeros((0, 4))
    moved[:, 2:] = np.maximum(moved[:, 2:], moved[:, :2] + 1)
    return ScoredFrame(
        truth, tuple(labels), rng.random(count) < 0.3, moved,
        tuple(rng.choice([*labels, *NAMES], len(moved)).tolist()),
        rng.integers(1, 10, len(moved)).astype(np.float32) / np.float32(10),
    )  # fmt: skip


def by_one_evaluation(frames: Sequence[ScoredFrame], most: int, name: str) -> tuple[float | None, float | None]:
    """AP50 and AP50:95 of one class as COCOeval gives them for all frames together."""

    def coco(rows: list[dict[str, Any]]) -> COCO:
        made = COCO()
        images = [{"id": k} for k in range(len(frames))]
        made.dataset = {"info": {}, "images": images, "categories": [{"id": 1}], "annotations": rows}
        made.createIndex()
        return made

    def row(number: int, image: int, box: np.ndarray, **more: Any) -> dict[str, Any]:
        size = box[2:] - box[:2]
        area = float(size.prod())
        place = {"id": number, "image_id": image, "category_id": 1, "bbox": [*box[:2], *size]}
        return place | {"area": area, "iscrowd": 0} | more

    truths, found = [], []
    for k, one in enumerate(frames):
        for box, label, ignored in zip(one.truth_boxes, one.truth_labels, one.ignored, strict=True):
            if label == name:
                truths.append(row(len(truths) + 1, k, box, **({"area": -1.0} if ignored else {})))
        for box, label, score in zip(one.boxes, one.labels, one.scores, strict=True):
            if label == name:
                found.append(row(len(found) + 1, k, box, score=float(score)))
    with contextlib.redirect_stdout(io.StringIO()):
        evaluation = COCOeval(coco(truths), coco(found), "bbox")
        evaluation.params.maxDets, evaluation.params.areaRng = [most], [[0.0, 1e10]]
        evaluation.params.areaRngLbl = ["all"]
        evaluation.evaluate()
        evaluation.accumulate()
    curves = evaluation.eval["precision"][:, :, 0, 0, 0]
    return (float(curves[0].mean()), float(curves.mean())) if (curves > -1).all() else (None, None)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(0, 9), together=st.integers(1, 4), most=st.integers(1, 4))
def test_frames_matched_as_they_come_score_as_all_of_them_together(
    seed: int, count: int, together: int, most: int
) -> None:
    rng = np.random.default_rng(seed)
    frames = [frame(rng) for _ in range(count)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detection_score, "_TOGETHER", together)
        scores = score_frames(frames, NAMES, max_detections=most, iou=0.5, score_threshold=0.5)

    for name in NAMES:
        assert (scores[name].ap50, scores[name].ap50_95) == by_one_evaluation(frames, most, name)
        labels = [label for one in frames for label in one.truth_labels]
        assert scores[name].truth + scores[name].ignored == labels.count(name)
        assert scores[name].detections == sum(one.labels.count(name) for one in frames)


def test_operating_point_uses_its_iou_and_score_thresholds() -> None:
    box = np.array([[0.0, 0.0, 10.0, 10.0]])
    aside = np.array([[0.0, 0.0, 10.0, 6.0]])  # IoU 0.6
    one = ScoredFrame(box, ("mug",), np.zeros(1, np.bool_), aside, ("mug",), np.array([0.5], np.float32))
    at = {
        iou: score_frames([one], ["mug"], max_detections=9, iou=iou, score_threshold=0.5)["mug"] for iou in (0.5, 0.7)
    }
    assert [(score.hits, score.false_alarms) for score in at.values()] == [(1, 0), (0, 1)]
    weak = score_frames([one], ["mug"], max_detections=9, iou=0.5, score_threshold=0.51)["mug"]
    assert (weak.hits, weak.false_alarms, weak.detections) == (0, 0, 1)


def test_a_detection_takes_8_bytes_once_it_is_matched() -> None:
    rng, score = np.random.default_rng(1), DetectionScore(max_detections=100, iou=0.5, score_threshold=0.3)
    frames = [frame(rng) for _ in range(320)]
    for one in frames:
        score.add(one)
    assert not score._waiting
    kept = [held for matched in score._matched.values() for held in (matched.scores, matched.matches, matched.ignored)]
    assert sum(len(held) * held.itemsize for held in kept) == 8 * sum(len(one.labels) for one in frames)


def test_classes_without_objects_have_no_score() -> None:
    assert score_frames([], ["mug"], max_detections=9, iou=0.5, score_threshold=0.5) == {
        "mug": ClassScore(0, 0, 0, None, None, 0, 0)
    }
    assert score_frames([], [], max_detections=9, iou=0.5, score_threshold=0.5) == {}
