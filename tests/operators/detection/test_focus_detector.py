"""Small things found anew in the image's own resolution: where it looks, what it keeps, and how it is trained."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dataflow.firing.failure import OperatorFailure
from dataflow.messages import Detections2D, Image
from dataflow.testing import play
from operators.detection import FocusDetector
from operators.detection.focus.cells import MULTIPLE
from operators.detection.focus.model import FocusModel, found_in
from operators.detection.focus.regions import MARGIN, pixels_of, regions
from operators.weights import NetworkFileError, shipped
from tests.support.drives import Drive, right

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]


def boxes_in(width: int, height: int) -> st.SearchStrategy[list[tuple[float, float, float, float]]]:
    def box(draw: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        x, y, w, h = draw
        return x, y, min(x + w, width), min(y + h, height)

    place = st.tuples(
        st.floats(0, width - 1, width=32), st.floats(0, height - 1, width=32),
        st.floats(1, 60, width=32), st.floats(1, 60, width=32),
    )  # fmt: skip
    return st.lists(place.map(box), max_size=12)


@settings(max_examples=60, deadline=None)
@given(boxes_in(150, 100))
def test_each_box_and_what_is_near_it_is_in_a_region(drawn: list[tuple[float, float, float, float]]) -> None:
    found = np.array(drawn, np.float32).reshape(-1, 4)
    made = regions(found, (150, 100))
    assert bool(made) == bool(drawn)
    for x1, y1, x2, y2 in made:
        assert not any(side % MULTIPLE for side in (x1, y1, x2, y2))
        assert 0 <= x1 < x2 <= 160
        assert 0 <= y1 < y2 <= 112
    for box in found:
        near = np.clip(box + np.array([-MARGIN, -MARGIN, MARGIN, MARGIN]), 0, [149, 99, 149, 99])
        holds = [(near[:2] >= each[:2]).all() and (near[2:] <= each[2:]).all() for each in made]
        assert sum(holds) >= 1


def answered(sides: tuple[float, float, float, float], at: list[tuple[int, int]]) -> Any:
    """A network that is sure of things at some cells (row, column) of each region, so far from their sides."""

    def answer(pixels: U8) -> tuple[F32, F32]:
        shape = pixels.shape[0] // 2, pixels.shape[1] // 2
        scores, found = np.zeros((2, *shape), np.float32), np.zeros((4, *shape), np.float32)
        found[:] = np.array(sides)[:, None, None]
        for row, column in at:
            scores[1, row, column] = 0.8
        return scores, found

    return answer


def test_boxes_are_in_the_pixels_of_the_image_and_those_cut_off_by_a_region_are_left_out() -> None:
    pixels = np.zeros((100, 150, 3), np.uint8)
    answer = answered((5, 6, 7, 8), [(10, 10), (2, 10)])  # the second ends above the region
    found = found_in(answer, pixels, [(48, 32, 96, 80)], 0.5, 0.5, 10)
    np.testing.assert_allclose(found.boxes, [[48 + 21 - 5, 32 + 21 - 6, 48 + 21 + 7, 32 + 21 + 8]])
    assert found.classes.tolist() == [1]
    at_the_border = found_in(answer, pixels, [(48, 0, 96, 48)], 0.5, 0.5, 10)  # of the image: nothing is beyond
    assert sorted(at_the_border.boxes[:, 1].tolist()) == [0, 15]


def test_more_small_things_are_found_and_no_more_boxes_are_wrong(drive: Drive) -> None:
    operator = FocusDetector()
    operator.setup()
    made = [operator.process(*each) for each in zip(drive.images, drive.detections, strict=True)]
    names = FocusModel.open(shipped("focus.onnx")).classes
    before, after = right(drive, drive.detections, names), right(drive, made, names)
    assert before[0] > 40
    assert after[1] > before[1]
    assert after[2] <= before[2]


def test_what_it_does_not_look_at_stays_as_it_is(drive: Drive) -> None:
    image, detections = drive.images[0], drive.detections[0]

    def found(**params: Any) -> Detections2D:
        operator = FocusDetector(**params)
        operator.setup()
        return operator.process(image, detections)

    small = np.isin(detections.labels(), ("mug", "book"))
    assert small.any()
    made = found(classes=("mug", "book"))
    for box, label in zip(detections.boxes[~small], np.array(detections.labels())[~small], strict=True):
        assert (made.boxes[[each == label for each in made.labels()]] == box).all(axis=1).any()
    assert found(most_pixels=0) is detections
    assert found(largest=1.0) is detections
    foreign = detections.replace(class_names=tuple(f"other {k}" for k, _ in enumerate(detections.class_names)))
    operator = FocusDetector()
    operator.setup()
    assert operator.process(image, foreign) is foreign
    nothing = foreign.replace(boxes=np.zeros((0, 4)), scores=np.zeros(0), class_ids=np.zeros(0, int))
    assert operator.process(image, nothing) is nothing


def test_the_surest_come_first_where_not_all_can_be_looked_at(drive: Drive) -> None:
    blank = Image(stamp=0, frame="lens", data=np.full((240, 320, 3), 90, np.uint8))
    boxes = [[40, 40, 60, 60], [200, 150, 215, 170]]
    detections = Detections2D(
        stamp=0, frame="lens", width=320, height=240, class_names=("ball",), boxes=boxes, scores=[0.3, 0.6],
        class_ids=[0, 0],
    )  # fmt: skip
    parts = regions(np.array(boxes, np.float32), (320, 240))
    assert len(parts) == 2
    operator = FocusDetector(classes=("ball",), width=320, most_pixels=max(map(pixels_of, parts)), score_threshold=0.9)
    operator.setup()
    assert operator.process(blank, detections).boxes.tolist() == [boxes[0]]  # the surer one is not found again
    assert operator.summary() == {"images": 1, "regions": 1, "looked at": 1, "beyond most_pixels": 1}


def test_equal_images_give_equal_boxes(drive: Drive) -> None:
    streams = {"image": drive.images, "detections": drive.detections}
    first, again = (play(FocusDetector(), streams).outputs["refined"] for _ in range(2))
    assert len(first) == len(drive.images)
    assert [m.digest() for m in first] == [m.digest() for m in again]


def test_detections_of_another_image_and_unknown_classes_are_refused(drive: Drive) -> None:
    image = Image(stamp=drive.detections[0].stamp, frame="lens", data=np.zeros((100, 100, 3), np.uint8))
    with pytest.raises(OperatorFailure, match="an image of 320x240 pixels, this one has 100x100"):
        play(FocusDetector(), {"image": [image], "detections": drive.detections[:1]})
    with pytest.raises(ValueError, match=r"knows no kettle; it knows mug, ball"):
        FocusDetector(classes=("kettle",)).setup()
    with pytest.raises(NetworkFileError, match="is a detector; a focus network is needed: `dataflow train focus"):
        FocusDetector(weights=str(shipped("detector.onnx"))).setup()
