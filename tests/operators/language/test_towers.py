"""The two halves of an image-text network, on small ones of CLIP's signature."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_towers import SIDE, write_image_tower, write_merges, write_text_tower

from operators.inference import ModelError
from operators.language.image_tower import ImageTower
from operators.language.text_tower import TextTower

pytest.importorskip("onnx")

ORANGE = np.full((SIDE, SIDE, 3), (255, 128, 0), np.uint8)
GREY = np.full((SIDE, SIDE, 3), 51, np.uint8)


@pytest.mark.parametrize("batch", [True, False], ids=["batch", "one by one"])
@pytest.mark.parametrize("half", [True, False], ids=["float16", "float32"])
def test_images_become_unit_vectors(tmp_path: Path, half: bool, batch: bool) -> None:
    tower = ImageTower(write_image_tower(tmp_path / "i.onnx", half=half, batch=batch), "unit", 16)
    found = tower([ORANGE, GREY])
    assert tower.side == SIDE
    assert found.dtype == np.float32
    expected = np.array([[1, 128 / 255, 0], [0.2, 0.2, 0.2]])
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=2e-3)


def test_pixels_are_normalised_as_clips_authors_do(tmp_path: Path) -> None:
    tower = ImageTower(write_image_tower(tmp_path / "i.onnx", side=None), "clip", 48)
    assert tower.side == 48
    expected = (np.array([1, 128 / 255, 0]) - [0.48145466, 0.4578275, 0.40821073]) / [
        0.26862954,
        0.26130258,
        0.27577711,
    ]
    (found,) = tower([np.full((48, 48, 3), (255, 128, 0), np.uint8)])
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-5)


@pytest.mark.parametrize("mask", [True, False], ids=["with a mask", "tokens alone"])
def test_texts_become_unit_vectors_of_the_same_space(tmp_path: Path, mask: bool) -> None:
    merges = write_merges(tmp_path / "m.txt")
    tower = TextTower(write_text_tower(tmp_path / "t.onnx", merges, mask=mask), merges)
    found = tower(["red", "a blue and green"])
    if mask:  # what follows the end of a text does not count
        np.testing.assert_allclose(found, [[1, 0, 0], [0, 0.5**0.5, 0.5**0.5]], atol=1e-6)
    assert found.shape == (2, 3)


def test_networks_of_other_signatures_are_refused(tmp_path: Path) -> None:
    merges = write_merges(tmp_path / "m.txt")
    image, text = write_image_tower(tmp_path / "i.onnx"), write_text_tower(tmp_path / "t.onnx", merges)
    with pytest.raises(ModelError, match=r"i\.onnx must take tokens \[N, L\] of int64 or int32"):
        TextTower(image, merges)
    with pytest.raises(ModelError, match=r"t\.onnx must have one input"):
        ImageTower(text, "clip", SIDE)
