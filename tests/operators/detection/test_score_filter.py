"""Sure detections pass with all that is known of them, others do not."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.messages import Detections2D
from operators.detection import ScoreFilter

FOUND = Detections2D(
    stamp=7,
    frame="camera",
    width=100,
    height=80,
    class_names=("cup", "box"),
    boxes=np.array([[0, 0, 10, 10], [5, 5, 20, 30], [40, 40, 60, 60]]),
    scores=np.array([0.9, 0.39, 0.4], np.float32),
    class_ids=[0, 1, 1],
    ids=[3, 4, 5],
)


def test_each_detection_keeps_its_row_and_equal_to_the_limit_is_enough() -> None:
    sure = ScoreFilter(min_score=0.4).process(FOUND)
    assert (sure.stamp, sure.frame, sure.width, sure.height) == (7, "camera", 100, 80)
    assert sure.labels() == ("cup", "box")
    assert sure.boxes.tolist() == FOUND.boxes[[0, 2]].tolist()
    assert sure.ids is not None
    assert sure.ids.tolist() == [3, 5]
    assert sure.visible is None


def test_where_nothing_is_sure_the_message_is_empty() -> None:
    assert ScoreFilter(min_score=1.0).process(FOUND).count == 0


def test_only_classes_that_are_asked_for_pass() -> None:
    sure = ScoreFilter(min_score=0.0, classes=("box",)).process(FOUND)
    assert sure.boxes.tolist() == FOUND.boxes[1:].tolist()
    assert sure.ids is not None
    assert sure.ids.tolist() == [4, 5]
    assert sure.class_names == FOUND.class_names


def test_a_class_that_the_detector_does_not_know_is_an_error_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match=r"the detector has no class 'cups'; did you mean 'cup'[?] it has cup, box"):
        ScoreFilter(classes=("cups",)).process(FOUND)
