"""Detector and segmenter trained together, on rendered data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from operators.detection import CustomDetector
from operators.detection.custom.dataset import DataError
from operators.detection.custom.folder import read_detection_data
from operators.learning.augmentation import Variation
from operators.segmentation import Segmenter
from operators.segmentation.dataset import VOID, read_segmentation_data
from operators.simulator.classes import CLASSES
from operators.training import simulated_worlds

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.learning.backbone import SmallResNet
    from operators.learning.loop import Settings, train
    from operators.training.pair import PairTask

SIZE = (160, 128)


def pair(folder: Path, variation: Variation | None = None) -> PairTask:
    boxes, masks = read_detection_data(folder, 0), read_segmentation_data(folder, 0)
    return PairTask(boxes, masks, SIZE, width=0.25, variation=variation)


@pytest.mark.long
def test_rendered_worlds_are_data_for_both_networks(worlds: Path) -> None:
    boxes, masks = read_detection_data(worlds, 0), read_segmentation_data(worlds, 0)
    assert [len(part) for part in (boxes.training, boxes.validation)] == [4, 4]
    assert {i.file.name for i in boxes.validation} == {i.image.name for i in masks.validation}
    assert masks.classes == CLASSES
    assert set(boxes.classes) <= set(CLASSES)
    before = {file: file.stat().st_mtime_ns for file in (worlds / "images").iterdir()}
    simulated_worlds.main([str(worlds), "--worlds", "1", "--validation", "1", "--frames", "4"])
    assert {file: file.stat().st_mtime_ns for file in (worlds / "images").iterdir()} == before  # kept, not drawn anew


def test_boxes_and_masks_of_a_batch_are_of_the_same_view(worlds: Path) -> None:
    task = pair(worlds, Variation(scale=1.4, shift=0.2))
    right, mirrored = [], []
    for seed in range(6):
        images, truth, masks = task.batch([0, 1, 2, 3], [np.random.default_rng((seed, k)) for k in range(4)])
        assert images.shape == (4, 3, SIZE[1], SIZE[0])
        assert masks.shape == (4, SIZE[1], SIZE[0])
        for k, label, box, ignored in zip(truth.image, truth.classes, truth.boxes, truth.ignored, strict=True):
            x1, y1, x2, y2 = (round(float(v)) for v in box)
            if ignored or (x2 - x1) * (y2 - y1) < 200:
                continue
            here = masks[k] == CLASSES.index(task.boxes.data.classes[label])
            right.append(float(here[y1:y2, x1:x2].float().mean()))
            mirrored.append(float(here.flip(1)[y1:y2, x1:x2].float().mean()))
    assert len(right) > 5
    assert np.mean(right) > 0.4
    assert np.mean(right) > 2 * np.mean(mirrored)
    assert VOID in masks


@pytest.mark.long
def test_training_writes_two_networks_that_the_operators_take(worlds: Path, tmp_path: Path) -> None:
    task = pair(worlds)
    outcome = train(task, Settings(epochs=1, batch=4, threads=1), tmp_path / "pair.onnx")
    assert {"ap50", "miou"} <= outcome.best.keys()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["detector.onnx", "pair.pt", "segmenter.onnx"]
    CustomDetector(weights=str(tmp_path / "detector.onnx")).setup()
    Segmenter(weights=str(tmp_path / "segmenter.onnx")).setup()


def test_an_image_without_a_mask_is_named(worlds: Path) -> None:
    boxes, masks = read_detection_data(worlds, 0), read_segmentation_data(worlds, 0)
    fewer = type(masks)(masks.classes, masks.training[1:], masks.validation)
    with pytest.raises(
        DataError, match=f"1 images have boxes and no mask, the first is .*{masks.training[0].image.name}"
    ):
        PairTask(boxes, fewer, SIZE, width=0.25)


def test_the_small_network_has_a_map_at_every_stride() -> None:
    network = SmallResNet(0.5).eval()
    maps = network(torch.zeros(1, 3, 96, 128))
    assert {s: tuple(m.shape[1:]) for s, m in maps.items()} == {
        s: (network.channels[s], 96 // s, 128 // s) for s in (2, 4, 8, 16, 32)
    }


def test_variation_of_no_strength_changes_nothing_but_the_side() -> None:
    assert Variation().times(0) == Variation(scale=1, shift=0, color=0, noise=0, blur=0)
    assert Variation().times(1) == Variation()
