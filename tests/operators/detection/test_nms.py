"""Non-maximum suppression against OpenCV and its own laws."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.detection.nms import class_wise_nms, intersection_over_union, merging_nms


def random_boxes(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes that overlap often, scores with ties, three classes."""
    rng = np.random.default_rng(seed)
    corner = rng.uniform(0, 60, (count, 2))
    boxes = np.concatenate([corner, corner + rng.uniform(1, 40, (count, 2))], axis=1).astype(np.float32)
    return boxes, (rng.integers(1, 20, count) / 20).astype(np.float32), rng.integers(0, 3, count).astype(np.int32)


SEEDS, COUNTS, THRESHOLDS = st.integers(0, 10_000), st.integers(0, 60), st.sampled_from([0.1, 0.3, 0.5, 0.9])


@settings(max_examples=60, deadline=None)
@given(SEEDS, COUNTS, THRESHOLDS)
def test_it_is_idempotent(seed: int, count: int, threshold: float) -> None:
    boxes, scores, classes = random_boxes(seed, count)
    kept = class_wise_nms(boxes, scores, classes, threshold)
    again = class_wise_nms(boxes[kept], scores[kept], classes[kept], threshold)
    assert again.tolist() == list(range(len(kept)))


@settings(max_examples=60, deadline=None)
@given(SEEDS, COUNTS, THRESHOLDS)
def test_the_order_of_the_boxes_does_not_matter_even_with_ties(seed: int, count: int, threshold: float) -> None:
    boxes, scores, classes = random_boxes(seed, count)
    shuffle = np.random.default_rng(seed + 1).permutation(count)
    kept = class_wise_nms(boxes, scores, classes, threshold)
    shuffled = shuffle[class_wise_nms(boxes[shuffle], scores[shuffle], classes[shuffle], threshold)]
    np.testing.assert_array_equal(boxes[kept], boxes[shuffled])
    np.testing.assert_array_equal(scores[kept], scores[shuffled])


@settings(max_examples=60, deadline=None)
@given(SEEDS, COUNTS, THRESHOLDS)
def test_kept_boxes_do_not_overlap_and_dropped_ones_do(seed: int, count: int, threshold: float) -> None:
    boxes, scores, classes = random_boxes(seed, count)
    kept = class_wise_nms(boxes, scores, classes, threshold).tolist()
    for i in range(count):
        rivals = [
            j for j in kept if j != i and classes[j] == classes[i] and (i not in kept or kept.index(j) < kept.index(i))
        ]
        overlaps = bool((intersection_over_union(boxes[i], boxes[rivals]) > threshold).any())
        assert overlaps == (i not in kept)


@pytest.mark.parametrize("seed", range(20))
def test_it_agrees_with_opencv(seed: int) -> None:
    boxes, _, classes = random_boxes(seed, 200)
    scores = (1 + np.random.default_rng(seed).permutation(200).astype(np.float32)) / 200  # without ties
    theirs: list[int] = []
    for label in range(3):
        of_class = np.flatnonzero(classes == label)
        corner_and_size = np.hstack([boxes[of_class, :2], boxes[of_class, 2:] - boxes[of_class, :2]])
        kept = cv2.dnn.NMSBoxes(corner_and_size.tolist(), scores[of_class].tolist(), 0.0, 0.45)
        theirs += of_class[np.asarray(kept)].tolist()
    assert class_wise_nms(boxes, scores, classes, 0.45).tolist() == sorted(theirs, key=lambda i: -scores[i])


def test_boxes_without_area_overlap_nothing() -> None:
    boxes = np.array([[5, 5, 5, 5], [0, 0, 10, 10]], np.float32)
    assert intersection_over_union(boxes[0], boxes).tolist() == [0, 0]
    assert len(class_wise_nms(boxes, np.ones(2, np.float32), np.zeros(2, np.int32), 0.0)) == 2


@settings(max_examples=60, deadline=None)
@given(SEEDS, COUNTS, THRESHOLDS, st.integers(1, 30))
def test_merging_nms_is_independent_of_the_box_order(seed: int, count: int, threshold: float, most: int) -> None:
    boxes, scores, classes = random_boxes(seed, count)
    shuffle = np.random.default_rng(seed + 1).permutation(count)
    kept, merged = merging_nms(boxes, scores, classes, threshold, most)
    plain = class_wise_nms(boxes, scores, classes, threshold)[:most].tolist()
    assert kept.tolist() == [k for k in plain if k in kept]
    for i in range(len(kept)):
        better = np.flatnonzero(classes[kept[:i]] == classes[kept[i]])
        assert not (intersection_over_union(merged[i], merged[better]) > max(threshold, 0.6)).any()
    _, again = merging_nms(boxes[shuffle], scores[shuffle], classes[shuffle], threshold, most)
    np.testing.assert_array_equal(merged, again)


def test_a_merged_box_lies_among_those_that_were_one_and_nearer_to_the_likelier() -> None:
    boxes = np.array([[10, 10, 30, 30], [12, 10, 32, 30], [60, 10, 80, 30], [11, 10, 31, 30]], np.float32)
    scores, classes = np.array([0.9, 0.3, 0.5, 0.8], np.float32), np.array([0, 0, 0, 1], np.int32)
    kept, merged = merging_nms(boxes, scores, classes, 0.5, 10)
    assert kept.tolist() == [0, 3, 2]
    assert 10 < merged[0, 0] < 11
    np.testing.assert_allclose(merged[0], [merged[0, 0], 10, merged[0, 0] + 20, 30], atol=1e-4)
    np.testing.assert_allclose(merged[1:], boxes[[3, 2]], atol=1e-4)  # another class, and one that stands alone


def test_two_boxes_that_merging_moves_onto_each_other_are_one() -> None:
    between = [[0, 20, 40, 120]] * 12  # suppressed by the first, towards the second
    boxes = np.array([[0, 0, 40, 100], [0, 40, 40, 140], [0, 35, 40, 135], *between], np.float32)
    scores = np.array([0.7, 0.6, 0.5, *[0.69] * 12], np.float32)
    classes = np.zeros(len(boxes), np.int32)
    assert class_wise_nms(boxes, scores, classes, 0.5).tolist() == [0, 1]
    kept, merged = merging_nms(boxes, scores, classes, 0.5, 10)
    assert kept.tolist() == [0]
    assert merged.shape == (1, 4)
    classes[1:3] = 1  # of another class
    assert merging_nms(boxes, scores, classes, 0.5, 10)[0].tolist() == [0, 1]


def test_merging_takes_away_errors_that_are_independent() -> None:
    rng = np.random.default_rng(0)
    true = np.array([100, 100, 160, 180], np.float32)
    boxes = (true + rng.normal(0, 3, (200, 8, 4))).astype(np.float32)
    scores, classes = rng.uniform(0.3, 1, (200, 8)).astype(np.float32), np.zeros(8, np.int32)
    errors = np.array([
        [np.abs(b[0] - true).mean(), np.abs(a[0] - true).mean()]
        for one, s in zip(boxes, scores, strict=True)
        for b, a in [(one[class_wise_nms(one, s, classes, 0.5)], merging_nms(one, s, classes, 0.5, 1)[1])]
    ])  # fmt: skip
    assert errors[:, 1].mean() < 0.6 * errors[:, 0].mean()


def test_boxes_of_no_score_are_left_where_they_are() -> None:
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10]], np.float32)
    kept, merged = merging_nms(boxes, np.zeros(2, np.float32), np.zeros(2, np.int32), 0.5, 5)
    assert kept.tolist() == [0]
    np.testing.assert_array_equal(merged, boxes[:1])
    assert merging_nms(boxes[:0], np.zeros(0, np.float32), np.zeros(0, np.int32), 0.5, 5)[1].shape == (0, 4)
