"""Decoding network outputs whose content is known."""

from __future__ import annotations

import numpy as np
import pytest

from operators.detection.suppressed import decode_end2end, decode_ssd, decode_torchvision
from operators.detection.yolo import decode_fastestdet, decode_yolov5, decode_yolov8


def test_fastestdet_reads_offset_size_and_score_of_a_cell() -> None:
    output = np.zeros((1, 5 + 80, 22, 22), np.float32)
    output[0, 0, 3, 7] = 0.81  # objectness
    output[0, 1:3, 3, 7] = np.arctanh([0.5, -0.25])  # offsets in cells
    output[0, 3:5, 3, 7] = np.log([0.2 / 0.8, 0.4 / 0.6])  # size as share of the image, before the sigmoid
    output[0, 5 + 16, 3, 7] = 0.64
    found = decode_fastestdet([output], (352, 176), 0.1)
    center, size = np.array([(7 + 0.5) / 22 * 352, (3 - 0.25) / 22 * 176]), np.array([0.2 * 352, 0.4 * 176])
    np.testing.assert_allclose(found.boxes, [[*(center - size / 2), *(center + size / 2)]], rtol=1e-5)
    np.testing.assert_allclose(found.scores, [0.81**0.6 * 0.64**0.4], rtol=1e-5)
    assert found.classes.tolist() == [16]


def test_the_threshold_itself_passes() -> None:
    output = np.zeros((1, 6, 1, 2), np.float32)
    output[0, 0] = output[0, 5] = [[1.0, 0.999]]
    assert len(decode_fastestdet([output], (8, 8), 1.0).scores) == 1


def test_yolov5_and_yolov8_agree_on_the_same_boxes() -> None:
    rows = np.array([[50, 40, 20, 10, 0.1, 0.8], [10, 10, 4, 4, 0.05, 0.02]], np.float32)
    v8 = decode_yolov8([np.ascontiguousarray(rows.T[None])], (64, 64), 0.25)
    with_objectness = np.insert(rows, 4, 1.0, axis=1)
    v5 = decode_yolov5([with_objectness[None]], (64, 64), 0.25)
    for found in (v8, v5):
        assert found.boxes.tolist() == [[40, 35, 60, 45]]
        assert found.classes.tolist() == [1]
        np.testing.assert_allclose(found.scores, [0.8])


def test_yolov5_multiplies_by_objectness() -> None:
    found = decode_yolov5([np.array([[[5, 5, 2, 2, 0.5, 0.8]]], np.float32)], (64, 64), 0.1)
    np.testing.assert_allclose(found.scores, [0.4])


def test_an_end_to_end_output_is_read_as_it_is() -> None:
    rows = np.array([[[1, 2, 30, 40, 0.9, 16], [0, 0, 5, 5, 0.1, 3]]], np.float32)

    found = decode_end2end([rows], (64, 64), 0.25)

    assert found.boxes.tolist() == [[1, 2, 30, 40]]
    assert (found.scores.tolist(), found.classes.tolist()) == ([np.float32(0.9)], [16])


@pytest.mark.parametrize(
    ("outputs", "reason"),
    [
        ([np.zeros((1, 300, 6), np.float32)], "decoder end2end"),
        ([np.zeros((1, 30, 8400), np.float32), np.zeros((1, 32, 160, 160), np.float32)], "32 coefficients of masks"),
    ],
)
def test_outputs_of_other_exports_than_yolov8_decodes_are_refused_with_the_reason(
    outputs: list[np.ndarray], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        decode_yolov8(outputs, (640, 640), 0.25)


@pytest.mark.parametrize("decode", [decode_fastestdet, decode_yolov5, decode_yolov8])
def test_scores_that_are_not_numbers_give_no_boxes(decode) -> None:
    shape = (1, 85, 4, 4) if decode is decode_fastestdet else (1, 85, 85)
    assert len(decode([np.full(shape, np.nan, np.float32)], (64, 64), 0.0).scores) == 0


@pytest.mark.parametrize("decode", [decode_fastestdet, decode_yolov5, decode_yolov8])
def test_an_output_of_another_shape_is_refused_with_the_right_one(decode) -> None:
    with pytest.raises(ValueError, match=r"has shape \(1, .*got \(3, 7\)"):
        decode([np.zeros((3, 7), np.float32)], (64, 64), 0.1)


def test_an_ssd_gives_a_box_for_every_class_of_a_prior_but_the_background() -> None:
    scores = np.array([[[0.9, 0.05, 0.05], [0.1, 0.5, 0.4]]], np.float32)
    boxes = np.array([[[0, 0, 1, 1], [0.25, 0.5, 0.75, 1.0]]], np.float32)
    for outputs in ([scores, boxes], [boxes, scores]):
        found = decode_ssd(outputs, (200, 100), 0.3)
        assert found.boxes.tolist() == [[50, 50, 150, 100]] * 2
        assert found.classes.tolist() == [0, 1]
        np.testing.assert_allclose(found.scores, [0.5, 0.4])
    with pytest.raises(ValueError, match=r"\(1, N, 4\), got"):
        decode_ssd([scores], (200, 100), 0.3)


def test_torchvisions_labels_count_from_one() -> None:
    boxes, labels = np.array([[1, 2, 3, 4], [5, 6, 7, 8]], np.float32), np.array([1, 17])
    found = decode_torchvision([boxes, labels, np.array([0.9, 0.2], np.float32)], (8, 8), 0.5)
    assert found.boxes.tolist() == [[1, 2, 3, 4]]
    assert found.classes.tolist() == [0]
    with pytest.raises(ValueError, match="torchvision's outputs"):
        decode_torchvision([boxes], (8, 8), 0.5)
