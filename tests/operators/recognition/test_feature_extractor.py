"""Vectors of images and objects, by our own classifier and by a network of torchvision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_pictures import SHAPES, image, picture, scene
from made_towers import write_row

from dataflow.execution.failure import OperatorFailure
from dataflow.testing import play
from operators.recognition import FeatureExtractor


@pytest.mark.long
def test_vectors_have_length_one_and_are_alike_for_alike_things(good_classifier: Path) -> None:
    shown = [image(picture(shape, 700 + i), i) for i, shape in enumerate(SHAPES * 4)]
    played = play(FeatureExtractor(weights=str(good_classifier)), {"image": shown})
    vectors = np.concatenate([message.vectors for message in played["features"]])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=1e-5)
    alike = vectors @ vectors.T
    np.fill_diagonal(alike, -1)
    nearest = alike.argmax(axis=1)
    assert np.mean(nearest % 3 == np.arange(len(shown)) % 3) >= 0.9


@pytest.mark.long
def test_an_object_has_the_vector_of_its_part_of_the_image_and_its_id(good_classifier: Path) -> None:
    shown, boxes = scene()
    operator = FeatureExtractor(weights=str(good_classifier), per="object")
    (found,) = play(operator, {"image": [shown], "detections": [boxes]})["features"]
    assert found.ids.tolist() == [7, 9]
    alone = [image(picture("disc", 901)), image(picture("stripes", 902), 1)]
    whole = play(FeatureExtractor(weights=str(good_classifier)), {"image": alone})["features"]
    alike = found.vectors @ np.concatenate([m.vectors for m in whole]).T
    assert alike[0, 0] > alike[0, 1]
    assert alike[1, 1] > alike[1, 0]


def test_the_model_is_named_by_its_file_so_that_vectors_of_two_are_not_compared(classifier: Path) -> None:
    (found,) = play(FeatureExtractor(weights=str(classifier)), {"image": [scene()[0]]})["features"]
    assert found.model.startswith("classifier-")
    assert found.ids is None
    assert found.vectors.shape == (1, 256)


def test_image_without_detections_has_no_vectors_and_is_counted(classifier: Path) -> None:
    shown, boxes = scene()
    operator = FeatureExtractor(weights=str(classifier), per="object")
    (found,) = play(operator, {"image": [shown.replace(stamp=5)], "detections": [boxes]})["features"]
    assert len(found.vectors) == 0
    assert operator.summary() == {"images_without_detections": 1}


def test_a_network_of_torchvision_describes_without_its_head(tmp_path: Path) -> None:
    models = pytest.importorskip("torchvision.models", reason="needs the extra [torch]")
    import torch

    torch.manual_seed(0)
    file = tmp_path / "mobile.pt"
    torch.save(models.get_model("mobilenet_v3_small", weights=None, num_classes=4).state_dict(), file)
    operator = FeatureExtractor(model="mobilenet_v3_small", checkpoint=str(file), per="object")
    shown, boxes = scene()
    (found,) = play(operator, {"image": [shown], "detections": [boxes]})["features"]
    assert found.vectors.shape == (2, 576)
    assert found.model == "torchvision-mobilenet_v3_small-own"
    np.testing.assert_allclose(np.linalg.norm(found.vectors, axis=1), 1.0, rtol=1e-5)


def test_named_embedding_describes_images_and_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATAFLOW_MODELS", str(write_row(tmp_path)))
    monkeypatch.setenv("DATAFLOW_MODEL_CACHE", str(tmp_path / "cache"))
    shown = image(
        np.concatenate([np.full((64, 64, 3), color, np.uint8) for color in ((255, 0, 0), (0, 0, 255))], axis=1)
    )
    operator = FeatureExtractor(model="colors", per="object")
    (found,) = play(operator, {"image": [shown], "detections": [scene()[1]]})["features"]
    assert found.model.startswith("colors-")
    assert "colors (row)" in operator.files
    np.testing.assert_allclose(found.vectors, [[1, 0, 0], [0, 0, 1]], atol=0.05)  # boxes are cut out with a rim
    few = FeatureExtractor(model=str(tmp_path / "cache" / "colors.onnx"), per="object", most=1)
    played = play(few, {"image": [shown.replace(stamp=k) for k in range(12)],
                        "detections": [scene()[1].replace(stamp=k) for k in range(12)]})  # fmt: skip
    described = np.array([message.vectors.any(axis=1) for message in played["features"]])
    assert (described.sum(axis=1) == 1).all()
    assert described.any(axis=0).all(), "each is described in some image"


def test_missing_weights_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torchvision", reason="needs the extra [torch]")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(OperatorFailure, match="are not on this machine"):
        play(FeatureExtractor(), {"image": [scene()[0]]})
