"""The Kalman filters of tracks against filterpy."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages import Detections2D
from dataflow.testing import play
from operators.tracking import MultiObjectTracker
from operators.tracking.box_filter import BoxFilter, BoxNoise, FilterpyBoxFilter, boxes_of, predict

sizes = st.floats(5, 400)
steps = st.lists(
    st.tuples(st.floats(0, 2), st.floats(-60, 60), sizes, sizes, st.floats(0, 1), st.booleans()), max_size=12
)


@settings(deadline=None)
@given(steps)
def test_filter_equals_filterpy(course: list[tuple[float, float, float, float, float, bool]]) -> None:
    noise, first = BoxNoise(), np.array([100.0, 80, 160, 260])
    ours, theirs = BoxFilter(first, 0.8, noise), FilterpyBoxFilter(first, 0.8, noise)
    for seconds, x, width, height, score, seen in course:
        predict([ours], noise, seconds)
        predict([theirs], noise, seconds)
        box = np.array([x, x, x + width, x + height])
        for each in (ours, theirs):
            each.update(box, score) if seen else each.hold_size()
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-7, atol=1e-6)
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-7, atol=1e-6)


def test_predicting_together_equals_predicting_alone() -> None:
    noise = BoxNoise()
    boxes = [np.array([k, 2 * k, 50.0 + k, 90 + 3 * k]) for k in range(5)]
    together, alone = [BoxFilter(box, 0.9, noise) for box in boxes], [BoxFilter(box, 0.9, noise) for box in boxes]
    predict(together, noise, 0.3)
    for each in alone:
        each.predict(0.3)
    np.testing.assert_array_equal(boxes_of(together), boxes_of(alone))


def test_tracks_by_filterpy_equal_those_by_numpy() -> None:
    rng = np.random.default_rng(0)
    places = [np.array([[20.0 + 9 * k, 100, 80 + 9 * k, 260], [500 - 7 * k, 90, 560 - 7 * k, 250]]) for k in range(30)]
    images = [
        Detections2D(
            stamp=(k + 1) * 100_000_000, frame="camera", width=640, height=480, class_names=("person",),
            boxes=place + rng.normal(0, 1, (2, 4)), scores=[0.9, 0.7], class_ids=np.zeros(2, np.int32),
        )
        for k, place in enumerate(places)
        if k % 11
    ]  # fmt: skip
    ours, theirs = (
        play(MultiObjectTracker(filter=each), {"detections": images})["tracks"] for each in ("numpy", "filterpy")
    )
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(mine.ids, other.ids)
        np.testing.assert_allclose(mine.boxes, other.boxes, rtol=1e-5)
