"""Keypoints against what the authors of the networks do with the same image and outputs, as they publish it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from made_onnx import node, write_model

from dataflow.messages import Detections2D, Image, Keypoints2D
from operators.detection import KeypointDetector
from operators.detection.keypoint_detector import COCO_KEYPOINTS, Cut
from operators.inference import ModelError

onnx = pytest.importorskip("onnx")

WIDTH, HEIGHT = 200, 150
IMAGE = Image(
    stamp=3, frame="camera", data=np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
)
BOXES = np.array([[20.5, 10, 80, 140.25], [90, 60, 199, 100], [-30, -20, 40, 60]], np.float32)


def persons(scores: tuple[float, ...] = (0.9, 0.8, 0.7), classes: tuple[int, ...] = (0, 0, 0)) -> Detections2D:
    return Detections2D(
        stamp=3,
        frame="camera",
        width=WIDTH,
        height=HEIGHT,
        class_names=("person", "dog"),
        boxes=BOXES,
        scores=scores,
        class_ids=classes,
        ids=[7, 8, 9],
    )


def simcc(file: Path, x: np.ndarray, y: np.ndarray, *, kind: str = "FLOAT", batch: bool = True) -> str:
    """A model of 48x64 pixels that answers x (K, Wx) and y (K, Wy) plus the mean of its input, for each image."""
    nodes = [
        node("Cast", "input", "real", to=onnx.TensorProto.FLOAT),
        node("ReduceMean", "real", "mean", axes=[1, 2, 3], keepdims=1),
        node("Squeeze", "mean last", "each"),
        node("Add", "x each", "simcc_x"),
        node("Add", "y each", "simcc_y"),
    ]
    count = "n" if batch else 1
    outputs = {"simcc_x": [count, *x.shape], "simcc_y": [count, *y.shape]}
    values = {"x": x[None], "y": y[None], "last": np.array([3])}
    return write_model(file, nodes, {"input": (kind, [count, 3, 64, 48])}, outputs, values=values)


def detector(**params: Any) -> KeypointDetector:
    made = KeypointDetector(**params)
    made.setup()
    return made


def mmpose_cut(box: np.ndarray, size: tuple[int, int], padding: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """MMPose's bbox_xyxy2cs, aspect ratio, get_warp_matrix without rotation, warpAffine: input, centre, scale."""
    center = np.array([box[0] + box[2], box[1] + box[3]]) * 0.5
    w, h = np.array([box[2] - box[0], box[3] - box[1]]) * padding
    aspect = size[0] / size[1]
    scale = np.array([w, w / aspect]) if w > h * aspect else np.array([h * aspect, h])
    ends = [center, center + np.array([0.0, scale[0] * -0.5])]
    goals = [np.array(size) * 0.5, np.array(size) * 0.5 + np.array([0.0, size[0] * -0.5])]
    for points in (ends, goals):  # the third point: turned by 90 degrees around the second
        away = points[0] - points[1]
        points.append(points[1] + np.array([-away[1], away[0]]))
    warp = cv2.getAffineTransform(np.float32(ends), np.float32(goals))
    return cv2.warpAffine(IMAGE.data, warp, size, flags=cv2.INTER_LINEAR), center, scale


@pytest.mark.parametrize("box", BOXES, ids=["tall", "wide", "partly outside"])
@pytest.mark.parametrize("padding", [1.0, 1.25])
def test_the_part_of_the_image_is_mmposes(box: np.ndarray, padding: float) -> None:
    cut = Cut.around(box.tolist(), (48, 64), padding)
    expected, center, scale = mmpose_cut(box.astype(np.float64), (48, 64), padding)
    off = np.abs(cut.of(IMAGE.data).astype(int) - expected.astype(int))
    assert (off > 2).mean() < 0.01  # their matrix goes through float32
    np.testing.assert_allclose((cut.center, cut.extent), (center, scale), atol=1e-4)


@pytest.mark.parametrize("batch", [True, False], ids=["all boxes at once", "one by one"])
@pytest.mark.parametrize("kind", ["FLOAT", "FLOAT16"])
def test_simcc_as_in_mmpose(tmp_path: Path, kind: str, batch: bool) -> None:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 0.6, (17, 96)).astype(np.float32), rng.uniform(0, 0.6, (17, 128)).astype(np.float32)
    x[3], y[3] = -9, -9  # not found, whatever the image adds
    made = detector(model=simcc(tmp_path / "m.onnx", x, y, kind=kind, batch=batch), decoder="simcc")
    found = made.process(IMAGE, persons())
    assert isinstance(found, Keypoints2D)
    assert (found.names, found.ids.tolist()) == (COCO_KEYPOINTS, [7, 8, 9])
    for row, box in enumerate(BOXES.astype(np.float64)):
        seen, center, scale = mmpose_cut(box, (48, 64), 1.25)
        mean = ((seen - [123.675, 116.28, 103.53]) / [58.395, 57.12, 57.375]).mean()
        value = np.minimum(x.max(axis=1), y.max(axis=1)) + mean  # get_simcc_maximum
        locs = np.stack([x.argmax(axis=1), y.argmax(axis=1)], axis=-1).astype(np.float32)
        expected = locs / 2.0 / np.array([48, 64]) * scale + center - scale / 2  # split ratio 2
        there = value > 0
        np.testing.assert_allclose(found.points[row][there], expected[there], atol=2e-3)
        assert np.isnan(found.points[row][~there]).all()
        np.testing.assert_allclose(found.scores[row], np.clip(value, 0, 1), atol=0.02)
        assert there.sum() in (0, 16)
    assert np.isfinite(found.points).any()


def movenet(file: Path, answer: np.ndarray) -> str:
    """A model of 64x64 pixels of int32 that answers (y, x, score), and as the last score the corner's red by 255."""
    nodes = [
        node("Slice", "input begin end", "corner"),
        node("Cast", "corner", "real", to=onnx.TensorProto.FLOAT),
        node("Div", "real most", "share"),
        node("Concat", "place share", "last", axis=3),
        node("Concat", "rest last", "output", axis=2),
    ]
    values = {
        "begin": np.array([0, 0, 0, 0]), "end": np.array([1, 1, 1, 1]), "most": np.float32(255),
        "rest": answer[None, None, :-1], "place": answer[None, None, -1:, :2],
    }  # fmt: skip
    return write_model(file, nodes, {"input": ("INT32", [1, 64, 64, 3])}, {"output": [1, 1, 17, 3]}, values=values)


def test_movenet_finds_the_person_of_the_whole_image(tmp_path: Path) -> None:
    answer = np.random.default_rng(2).uniform(0, 1, (17, 3)).astype(np.float32)
    made = detector(model=movenet(tmp_path / "m.onnx", answer), decoder="movenet")
    found = made.process(IMAGE)
    assert (found.count, found.ids) == (1, None)
    side = max(WIDTH, HEIGHT)  # resize_with_pad: the image in the middle of a black square
    expected = answer[:, 1::-1] * side - [(side - WIDTH) / 2, (side - HEIGHT) / 2]
    np.testing.assert_allclose(found.points[0], expected, atol=1e-3)
    np.testing.assert_allclose(found.scores[0, :-1], answer[:-1, 2], atol=1e-6)
    assert found.scores[0, -1] == 0, "the corner is black"


def test_only_persons_of_the_same_image_are_looked_at(tmp_path: Path) -> None:
    x, y = np.full((17, 96), 5, np.float32), np.full((17, 128), 5, np.float32)
    made = detector(model=simcc(tmp_path / "m.onnx", x, y), decoder="simcc")
    assert made.process(IMAGE, persons((0.9, 0.2, 0.5), (0, 0, 1))).ids.tolist() == [7]
    assert made.process(IMAGE, persons().replace(stamp=2)).points.shape == (0, 17, 2)
    unnamed = made.process(IMAGE, persons().replace(ids=None))
    assert unnamed.count == 3
    assert unnamed.ids is None


def test_a_model_of_another_family_is_named(tmp_path: Path) -> None:
    x, y = np.zeros((17, 96), np.float32), np.zeros((17, 128), np.float32)
    file = simcc(tmp_path / "m.onnx", x, y)
    with pytest.raises(ModelError, match=r"m\.onnx: MoveNet's output is \(N, 1, K, 3\), got"):
        detector(model=file, decoder="movenet").process(IMAGE)
    with pytest.raises(ModelError, match=r"KeypointDetector\.decoder must name its family: simcc, movenet"):
        detector(model=file)
