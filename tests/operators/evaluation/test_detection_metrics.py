"""Detection scores on boxes whose hits and misses are known, and against a second implementation of AP."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages import Detections2D
from dataflow.testing import play
from operators.evaluation import DetectionMetrics

STEP = 100_000_000
NAMES = ("mug", "chair", "ball")
Item = tuple[str, tuple[float, float, float, float], float]  # class, box, score or visible share


def boxes(items: list[Item], k: int, names: tuple[str, ...], **fields: Any) -> Detections2D:
    ids = [names.index(name) for name, _, _ in items] if names else [int(name) for name, _, _ in items]
    return Detections2D(
        stamp=k * STEP,
        **{
            "frame": "camera",
            "width": 200,
            "height": 100,
            "class_names": names,
            "boxes": np.array([box for _, box, _ in items], np.float32).reshape(-1, 4),
            "scores": np.array([score for _, _, score in items], np.float32),
            "class_ids": np.array(ids, np.int32),
        }
        | fields,
    )


def found(items: list[Item], k: int = 0, names: tuple[str, ...] = NAMES, **fields: Any) -> Detections2D:
    return boxes(items, k, names, **fields)


def true(
    items: list[Item], k: int = 0, names: tuple[str, ...] = NAMES, pixels: int = 1000, **fields: Any
) -> Detections2D:
    """The third entry of an item is its visible share."""
    visible = np.array([share for _, _, share in items], np.float32)
    whole = [(name, box, 1.0) for name, box, _ in items]
    given = {"visible": visible, "pixel_counts": np.full(len(items), pixels, np.int64)} | fields
    return boxes(whole, k, names, **given)


def score(detections: list[Detections2D], truth: list[Detections2D], **params: Any) -> dict[str, float | int | str]:
    metrics = DetectionMetrics(**params)
    play(metrics, {"detections": detections, "truth": truth})
    return dict(metrics.summary())


A, B, C = (10.0, 10.0, 50.0, 50.0), (60.0, 20.0, 100.0, 80.0), (120.0, 5.0, 180.0, 95.0)
ASIDE = (14.0, 10.0, 54.0, 50.0)  # IoU with A: 36 / 44


def test_exact_boxes_score_one() -> None:
    objects: list[Item] = [("mug", A, 1.0), ("chair", B, 1.0)]
    figures = score([found(objects, k) for k in range(3)], [true(objects, k) for k in range(3)])
    assert figures["ap50"] == pytest.approx(1)
    assert figures["ap50_95"] == pytest.approx(1)
    assert (figures["frames"], figures["truth_objects"], figures["detections"]) == (3, 6, 6)
    assert (figures["precision"], figures["recall"]) == (1.0, 1.0)


def test_a_shifted_box_counts_up_to_its_overlap() -> None:
    """IoU 0.818 passes 0.5 to 0.8: seven of the ten thresholds."""
    figures = score([found([("mug", ASIDE, 0.9)])], [true([("mug", A, 1.0)])])
    assert figures["ap50"] == pytest.approx(1)
    assert figures["ap50_95"] == pytest.approx(0.7)


def test_a_second_box_on_one_object_is_a_false_alarm() -> None:
    detections = [found([("mug", A, 0.9), ("mug", ASIDE, 0.8)])]
    figures = score(detections, [true([("mug", A, 1.0)])])
    assert figures["ap50"] == pytest.approx(1)  # ranked below the hit: the curve reaches recall 1 before
    assert figures["precision"] == pytest.approx(0.5)


@pytest.mark.parametrize(("share", "pixels"), [(0.59, 1000), (1.0, 199)])  # hidden, tiny
def test_hidden_and_tiny_objects_are_neither_missed_nor_held_against_a_detector(share: float, pixels: int) -> None:
    truth = [true([("mug", A, share)], pixels=pixels), true([("mug", B, 1.0)], 1)]
    blind = score([found([], 0), found([("mug", B, 0.9)], 1)], truth)
    keen = score([found([("mug", A, 0.95)], 0), found([("mug", B, 0.9)], 1)], truth)
    for figures in (blind, keen):
        assert figures["ap50"] == pytest.approx(1)
        assert (figures["precision"], figures["recall"]) == (1.0, 1.0)
        assert (figures["truth_objects"], figures["ignored_objects"]) == (1, 1)


@pytest.mark.parametrize(
    ("share", "pixels", "fields"),
    [(0.6, 1000, {}), (1.0, 200, {}), (0.1, 10, {"visible": None, "pixel_counts": None})],
    ids=["share at the limit", "pixels at the limit", "neither known"],
)
def test_objects_at_the_limits_or_of_unknown_size_count(share: float, pixels: int, fields: dict[str, None]) -> None:
    wrong = [found([("chair", A, 0.9)])]  # of another class
    figures = score(wrong, [true([("mug", A, share)], pixels=pixels, **fields)])
    assert (figures["truth_objects"], figures["ap50"], figures["recall"]) == (1, 0, 0)
    assert str(score(wrong, [])["ap50"]).startswith("not computed")


def test_classes_are_matched_by_name_and_unknown_ones_are_named() -> None:
    truth = [true([("mug", A, 1.0), ("ball", B, 1.0)])]
    figures = score([found([("mug", A, 0.9), ("cat", C, 0.9)], names=("cat", "mug"))], truth)
    assert figures["ap50"] == pytest.approx(0.5)
    assert figures["ap50_known_classes"] == pytest.approx(1)
    assert figures["unknown_classes"] == "ball"
    assert (figures["detections_not_judged"], figures["classes_not_in_truth"]) == (1, "cat")
    assert figures["worst_class"] == "ball"


def test_boxes_of_a_larger_version_of_the_image_are_scaled() -> None:
    large = tuple(2 * v for v in A)
    figures = score([found([("mug", large, 0.9)], width=400, height=200)], [true([("mug", A, 1.0)])])
    assert figures["ap50_95"] == pytest.approx(1)


def test_frames_without_a_partner_are_counted_and_not_scored() -> None:
    objects: list[Item] = [("mug", A, 1.0)]
    figures = score([found(objects, 0), found([], 1)], [true(objects, 0), true(objects, 3)])
    assert (figures["frames"], figures["unmatched_detections"], figures["unmatched_truths"]) == (1, 1, 0)
    assert figures["ap50"] == pytest.approx(1)


def test_truth_beyond_the_tolerance_is_no_truth() -> None:
    near = found([("mug", A, 0.9)]).replace(stamp=2_000_000)
    assert score([near], [true([("mug", A, 1.0)])])["frames"] == 0
    assert score([near], [true([("mug", A, 1.0)])], tolerance="2ms")["frames"] == 1


def test_truth_that_comes_late_is_scored_all_the_same() -> None:
    metrics = DetectionMetrics()
    metrics.setup()
    objects: list[Item] = [("mug", A, 1.0)]
    late = {2: (true(objects, 0), true(objects, 1)), 5: tuple(true(objects, k) for k in range(2, 6))}
    for k in range(6):
        metrics.process(found(objects, k), late.get(k, ()))
    metrics.finish()
    figures = metrics.summary()
    assert (figures["frames"], figures["unmatched_detections"], figures["unmatched_truths"]) == (6, 0, 0)
    assert figures["recall"] == 1.0


def average_precision(hits: list[bool], objects: int) -> float:
    """Mean of the best precision at recall ≥ 0, 0.01 ... 1, of hits by falling score."""
    right = np.cumsum(hits)
    recall, precision = right / objects, right / np.arange(1, len(hits) + 1)
    return float(np.mean([max(precision[recall >= r], default=0.0) for r in np.linspace(0, 1, 101)]))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=20), st.integers(0, 5))
def test_ap_is_the_area_under_the_interpolated_curve(hits: list[bool], missed: int) -> None:
    """One object a frame, one detection on it or beside it, with falling scores."""
    detections = [found([("mug", A if hit else C, 1 - 0.02 * k)], k) for k, hit in enumerate(hits)]
    truth = [true([("mug", A, 1.0)], k) for k in range(len(hits))]
    empty = range(len(hits), len(hits) + missed)
    detections += [found([], k) for k in empty]
    truth += [true([("mug", A, 1.0)], k) for k in empty]
    figures = score(detections, truth)
    assert figures["ap50"] == pytest.approx(average_precision(hits, len(hits) + missed), abs=1e-9)


def test_precision_and_recall_are_those_of_the_operating_point() -> None:
    truth = [true([("mug", A, 1.0), ("mug", B, 1.0)])]
    detections = [found([("mug", A, 0.9), ("mug", C, 0.4), ("mug", B, 0.2)])]
    at = {t: score(detections, truth, score_threshold=t) for t in (0.1, 0.3, 0.5)}
    assert [at[t]["precision"] for t in at] == [pytest.approx(2 / 3), 0.5, 1.0]
    assert [at[t]["recall"] for t in at] == [1.0, 0.5, 0.5]
    assert len({figures["ap50"] for figures in at.values()}) == 1


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"frame": "other"}, "of one camera"), ({"width": 150}, "aspect ratios"), ({"names": ()}, "has no class_names")],
)
def test_boxes_that_cannot_be_compared_are_refused(wrong: dict[str, Any], message: str) -> None:
    metrics = DetectionMetrics()
    metrics.setup()
    item: Item = ("0" if wrong.get("names") == () else "mug", A, 0.9)
    with pytest.raises(ValueError, match=message):
        metrics.process(found([item], **wrong), (true([("mug", A, 1.0)]),))


def test_the_file_holds_the_figures_and_a_row_for_each_class(tmp_path: Path) -> None:
    out = tmp_path / "made" / "score.json"
    figures = score([found([("mug", A, 0.9)])], [true([("mug", A, 1.0), ("ball", B, 1.0)])], out=str(out))
    written = json.loads(out.read_text())
    assert written["figures"] == figures
    found_ap = {name: row["ap50"] for name, row in written["classes"].items()}
    assert found_ap == {"mug": pytest.approx(1), "ball": 0.0, "chair": None}
