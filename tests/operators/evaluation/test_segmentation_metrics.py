"""Segmentation scores on maps whose IoU is counted by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages import SegmentationMap
from dataflow.testing import play
from operators.evaluation import SegmentationMetrics

STEP = 100_000_000
NAMES = ("floor", "wall", "mug")


def class_map(rows: Any, k: int = 0, names: tuple[str, ...] = NAMES, **fields: Any) -> SegmentationMap:
    classes = np.array(rows, np.uint8)
    return SegmentationMap(stamp=k * STEP, **{"frame": "camera", "class_names": names, "classes": classes} | fields)


def score(found: list[SegmentationMap], truth: list[SegmentationMap], **params: Any) -> dict[str, float | int | str]:
    metrics = SegmentationMetrics(**params)
    play(metrics, {"segmentation": found, "truth": truth})
    return dict(metrics.summary())


def test_iou_is_intersection_over_union_of_all_frames() -> None:
    truth = [class_map([[0, 0, 0, 1]]), class_map([[0, 1, 1, 1]], 1)]
    found = [class_map([[0, 0, 1, 1]]), class_map([[0, 1, 1, 0]], 1)]
    figures = score(found, truth)
    assert figures["frames"] == 2
    assert figures["pixels"] == 8
    assert figures["class_iou"] == "floor 0.600, wall 0.600"  # each 3 of 5, over both frames together
    assert figures["miou"] == pytest.approx(0.6)
    assert figures["pixel_accuracy"] == pytest.approx(6 / 8)


@pytest.mark.parametrize(
    ("found", "true", "pixels", "ious"),
    [
        (
            class_map([[2, 0, 1]], names=("wall", "mug", "floor")),
            class_map([[0, 1, 2]]),
            3,
            "1.000, mug 1.000, wall 1.000",
        ),
        (class_map([[0, 2, 2, 1]]), class_map([[0, 0, 2, 1]]), 4, "0.500, mug 0.500, wall 1.000"),
        (class_map([[0, 0, 2, 2]]), class_map([[0, 0, 0, 0]]), 4, "0.500"),
        (class_map([[0, 255, 1, 0]], void=255), class_map([[0, 0, 255, 255]], void=255), 2, "0.500"),
        (class_map([[0, 1]]), class_map([[0, 0, 1, 1], [0, 0, 1, 2]]), 8, "mug 0.000, wall 0.750, floor 1.000"),
        (class_map([[0, 1]], names=("floor", "sky")), class_map([[0, 1]]), 2, "wall 0.000, floor 1.000"),
        (class_map([[3, 3, 7]], names=()), class_map([[3, 7, 7]], names=()), 3, "3 0.500, 7 0.500"),
    ],
    ids=["other order", "a wrong class", "never true", "void", "smaller", "not of the truth", "no names"],
)
def test_ious_are_of_classes_by_name_over_the_pixels_that_the_truth_names(
    found: SegmentationMap, true: SegmentationMap, pixels: int, ious: str
) -> None:
    figures = score([found], [true])
    assert figures["pixels"] == pixels
    assert str(figures["class_iou"]).removeprefix("floor ") == ious


def test_classes_that_the_segmenter_does_not_know_are_named() -> None:
    figures = score([class_map([[0, 1, 1]], names=("floor", "wall"))], [class_map([[0, 1, 2]])])
    assert figures["unknown_classes"] == "mug"
    assert figures["miou"] == pytest.approx((1 + 1 / 2 + 0) / 3)
    assert figures["miou_known_classes"] == pytest.approx((1 + 1 / 2) / 2)
    assert str(score([class_map([[0, 1]])], [])["miou"]).startswith("not computed")


def test_frames_without_a_partner_are_counted_and_not_scored() -> None:
    truth = [class_map([[0, 1]], k) for k in (0, 2, 4)]
    found = [class_map([[0, 1]], 0), class_map([[1, 0]], 1), class_map([[0, 1]], 2)]
    figures = score(found, truth)
    assert figures["miou"] == 1.0
    assert (figures["frames"], figures["unmatched_segmentations"], figures["unmatched_truths"]) == (2, 1, 0)


def test_truth_that_comes_with_a_later_firing_still_counts() -> None:
    metrics = SegmentationMetrics()
    metrics.setup()
    metrics.process(class_map([[0, 1]], 0), ())
    metrics.process(class_map([[0, 1]], 1), (class_map([[0, 1]], 0), class_map([[0, 0]], 1)))
    metrics.finish()
    assert metrics.summary()["frames"] == 2


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_the_figures_agree_with_counting_class_by_class(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, found = rng.integers(0, 3, (2, 4, 5, 6))
    maps = [[class_map(frame, k) for k, frame in enumerate(side)] for side in (found, truth)]
    expected = [
        ((truth == c) & (found == c)).sum() / ((truth == c) | (found == c)).sum()
        for c in range(3)
        if (truth == c).any()
    ]
    assert score(*maps)["miou"] == pytest.approx(np.mean(expected))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"frame": "other"}, "of one camera"),
        ({"rows": [[0, 1], [0, 1], [0, 1]]}, "aspect ratios"),
        ({"names": ()}, "has no class_names"),
    ],
)
def test_maps_that_cannot_be_compared_are_refused(wrong: dict[str, Any], message: str) -> None:
    metrics = SegmentationMetrics()
    metrics.setup()
    with pytest.raises(ValueError, match=message):
        metrics.process(class_map(**{"rows": [[0, 1]]} | wrong), (class_map([[0, 1]]),))


def test_the_file_holds_the_figures_and_the_classes(tmp_path: Path) -> None:
    out = tmp_path / "made" / "score.json"
    figures = score([class_map([[0, 0]])], [class_map([[0, 1]])], out=str(out))
    assert json.loads(out.read_text()) == {"figures": figures, "class_iou": {"floor": 0.5, "wall": 0.0}}
