"""Rendered data, and networks that were trained on them, which the tests of learning and training share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def worlds(once: Callable[..., Path]) -> Path:
    """A data folder of one world to train on and one to score on, four images each."""
    from operators.training import simulated_worlds

    words = ["--worlds", "1", "--validation", "1", "--frames", "4"]
    return once("worlds", lambda folder: simulated_worlds.main([str(folder), *words]))


@pytest.fixture(scope="session")
def trained(worlds: Path, once: Callable[..., Path]) -> Path:
    """A folder with detector.onnx and segmenter.onnx, which have a trunk in common and take 160 by 128 pixels."""
    pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.detection.custom.folder import read_detection_data
    from operators.learning.loop import Settings, train
    from operators.segmentation.dataset import read_segmentation_data
    from operators.training.pair import PairTask

    def make(folder: Path) -> None:
        task = PairTask(read_detection_data(worlds), read_segmentation_data(worlds), (160, 128), width=0.25, seed=1)
        train(task, Settings(epochs=2, batch=4, threads=1), folder / "pair.onnx")

    return once("trained", make)
