"""Trainings that begin with a network file: they answer as it does, in 8 bits or not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from operators.detection.custom.folder import read_detection_data
from operators.learning.augmentation import fitted, tensor_of, warp
from operators.segmentation.dataset import read_segmentation_data
from operators.simulator.classes import CLASSES, THINGS
from operators.weights import open_network, read_facts, shipped, trained_in_simulation

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="training needs the extra [train]")
    from torch import nn

    from operators.detection.custom.network import FINE_STRIDES, GridHead
    from operators.detection.custom.training import DetectorTask
    from operators.learning.backbone import SmallResNet
    from operators.learning.files import TrainingFileError
    from operators.learning.loop import Settings, train
    from operators.learning.network_weights import begin_with, sample_images
    from operators.segmentation.network import ClassDecoder
    from operators.segmentation.training import SegmenterTask
    from operators.training.pair import PairTask

SIZE = (160, 128)


def pair(folder: Path, size: tuple[int, int] = SIZE, width: float = 0.25, seed: int = 0) -> PairTask:
    return PairTask(read_detection_data(folder), read_segmentation_data(folder), size, width=width, seed=seed)


def scene(folder: Path, size: tuple[int, int]) -> np.ndarray:
    pixels = read_detection_data(folder).validation[0].read()
    return warp(pixels, fitted((pixels.shape[1], pixels.shape[0]), size), size)


@pytest.mark.long
def test_training_starts_with_the_outputs_of_the_file(trained: Path, worlds: Path) -> None:
    task = pair(worlds)
    task.begin_with(trained / "detector.onnx")

    image = scene(worlds, SIZE)
    with torch.inference_mode():
        maps, _ = task.network.eval()(torch.from_numpy(tensor_of(image))[None])
    for mine, theirs in zip(maps, open_network(trained / "detector.onnx", "detector").run(image), strict=True):
        assert np.abs(mine.numpy() - theirs).max() < 0.02  # weights are stored in half precision
    anchors = read_facts(trained / "detector.onnx")["anchors"]
    assert np.allclose(task.boxes.anchors, anchors, atol=1e-3)


@pytest.mark.long
def test_networks_of_rendered_worlds_are_marked_as_trained_in_simulation(trained: Path) -> None:
    assert all(trained_in_simulation(trained / name) for name in ("detector.onnx", "segmenter.onnx"))


@pytest.mark.long
def test_normalisation_in_training_agrees_with_the_stored_statistics(trained: Path, worlds: Path) -> None:
    task = pair(worlds)
    task.begin_with(trained / "detector.onnx")
    images = sample_images(task)

    with torch.inference_mode():
        still, _ = task.network.eval()(images)
        moving, _ = task.network.train()(images)  # by the statistics of these very images
    for one, other in zip(still, moving, strict=True):
        assert float((one - other).abs().mean()) < 0.05 * float(one.std()) + 0.01


@pytest.mark.long
def test_the_shipped_networks_in_8_bits_can_be_trained_on(worlds: Path) -> None:
    backbone, images = SmallResNet(), sample_images(pair(worlds, (384, 288)))
    grid = nn.Sequential(backbone, GridHead(len(THINGS), backbone.channels, 64, FINE_STRIDES)).eval()
    decoder = nn.Sequential(backbone, ClassDecoder(len(CLASSES), backbone.channels)).eval()
    begin_with(decoder, shipped("segmenter.onnx"), images)
    begin_with(grid, shipped("detector.onnx"), images)

    image = scene(worlds, (384, 288))
    seen = torch.from_numpy(tensor_of(image))[None]
    with torch.inference_mode():
        maps, scores = grid(seen), decoder(seen)
    for mine, theirs in zip(maps, open_network(shipped("detector.onnx"), "detector").run(image), strict=True):
        assert np.abs(mine.numpy() - theirs).mean() < 0.05 * theirs.std()  # theirs are rounded between layers
    labels = scores.argmax(dim=1)[0].numpy()
    shown = open_network(shipped("segmenter.onnx"), "segmenter").run(image)[0][0].argmax(axis=0)
    assert (labels == shown).mean() > 0.95


@pytest.mark.long
def test_a_detector_and_a_segmenter_alone_begin_so_too(trained: Path, worlds: Path, tmp_path: Path) -> None:
    boxes = DetectorTask(read_detection_data(worlds), SIZE, seed=1)
    train(boxes, Settings(epochs=1, batch=4, threads=1), tmp_path / "boxes.onnx")
    again = DetectorTask(read_detection_data(worlds), SIZE)
    again.begin_with(tmp_path / "boxes.onnx")
    masks = SegmenterTask(read_segmentation_data(worlds), SIZE, width=0.25, architecture="smallresnet")
    masks.begin_with(trained / "segmenter.onnx")

    image = scene(worlds, SIZE)
    with torch.inference_mode():
        found = again.network.eval()(torch.from_numpy(tensor_of(image))[None])
    for mine, theirs in zip(found, open_network(tmp_path / "boxes.onnx", "detector").run(image), strict=True):
        assert np.abs(mine.numpy() - theirs).max() < 0.05


@pytest.mark.long
def test_anchors_grow_with_the_input(trained: Path, worlds: Path) -> None:
    task = pair(worlds, (2 * SIZE[0], 2 * SIZE[1]))
    task.begin_with(trained / "detector.onnx")
    assert np.allclose(task.boxes.anchors, 2 * np.array(read_facts(trained / "detector.onnx")["anchors"]), atol=1e-3)


@pytest.mark.long
def test_mismatched_weights_file_is_refused_with_the_difference(trained: Path, worlds: Path) -> None:
    with pytest.raises(
        TrainingFileError, match=r"its architecture is 'smallresnet-0[.]25 fpn grid', and this one's 'sm"
    ):
        pair(worlds, width=0.5).begin_with(trained / "detector.onnx")
    with pytest.raises(TrainingFileError, match="its kind is 'segmenter', and this one's 'detector'"):
        pair(worlds).begin_with(trained / "segmenter.onnx")
    fewer = DetectorTask(read_detection_data(worlds).only(["chair"]), SIZE, width=0.25, architecture="smallresnet")
    with pytest.raises(TrainingFileError, match=r"its classes is|its strides is"):
        fewer.begin_with(trained / "detector.onnx")
