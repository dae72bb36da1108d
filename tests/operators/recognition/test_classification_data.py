"""Folders of images sorted by class, and what is cut out of an image to be recognised."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_pictures import scene

from dataflow.messages import Detections2D
from operators.detection.custom.dataset import DataError
from operators.recognition.crops import covering, views
from operators.recognition.dataset import read_classification_data


def test_data_that_are_not_sorted_by_class_are_refused(shapes: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a folder of images for each of two classes"):
        read_classification_data(tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with pytest.raises(DataError, match="holds no image"):
        read_classification_data(tmp_path)
    (tmp_path / "train").mkdir()
    with pytest.raises(DataError, match=r"has train/ but no val/"):
        read_classification_data(tmp_path)
    read = read_classification_data(shapes, seed=1)
    assert {len([i for i in read.validation if i.label == label]) for label in range(3)} == {4}
    assert not {i.file for i in read.training} & {i.file for i in read.validation}


def test_views_stay_within_the_image_whatever_the_boxes() -> None:
    boxes = Detections2D(
        stamp=0, frame="camera", width=128, height=64, class_names=("thing",),
        boxes=[[-50, -50, -20, -20], [200, 10, 300, 20], [10, 10, 10, 10], [0, 0, 500, 500]],
        scores=[1, 1, 1, 1], class_ids=[0, 0, 0, 0],
    )  # fmt: skip
    shown, ids = views(scene()[0], boxes)
    assert [view.shape[0] * view.shape[1] >= 1 for view in shown] == [True] * 4
    assert shown[3].shape == (64, 128, 3)
    assert ids.tolist() == [0, 1, 2, 3]
    assert covering(shown[0], 32).shape == (32, 32, 3)
