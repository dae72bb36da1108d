"""torchvision's segmentation networks by name: the same answers as the model called directly."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from made_checkpoints import new_network, write_checkpoint

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Image
from dataflow.testing import Played, play
from operators.segmentation import TorchvisionSegmenter

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="needs the extra [torch]")

NAME = "lraspp_mobilenet_v3_large"
CLASSES = ("__background__", "floor", "wall")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("weights") / "mine.pt", NAME, CLASSES)


def image(seed: int = 0) -> Image:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return Image(stamp=seed, frame="camera", data=np.kron(coarse, np.ones((16, 16, 1), np.uint8)))


def test_classes_are_those_of_the_model_itself(checkpoint: Path) -> None:
    operator = TorchvisionSegmenter(model=NAME, checkpoint=str(checkpoint), side=64, with_confidence=True)
    (found,) = play(operator, {"image": [image()]})["segmentation"]
    model = new_network(NAME, CLASSES)
    model.load_state_dict(torch.load(checkpoint, weights_only=True)["model"])
    preset = __import__("torchvision.transforms._presets", fromlist=["x"]).SemanticSegmentation(resize_size=64)
    with torch.inference_mode():
        tensor = torch.from_numpy(image().data.transpose(2, 0, 1))
        scores = model.eval()(preset(tensor)[None])["out"]
        scores = torch.nn.functional.interpolate(scores, size=(96, 128), mode="bilinear", align_corners=False)
        confidence, classes = scores.softmax(1)[0].max(0)
    assert found.class_names == ("background", "floor", "wall")
    assert (found.classes == classes.numpy()).mean() > 0.999
    np.testing.assert_allclose(found.confidence, confidence, atol=1e-3)


def test_unsure_pixels_become_void_and_equal_images_give_equal_maps(checkpoint: Path) -> None:
    def run(**params: Any) -> Played:
        operator = TorchvisionSegmenter(model=NAME, checkpoint=str(checkpoint), side=0, **params)
        return play(operator, {"image": [image(1)]})

    unsure = run(confidence_threshold=0.99)
    assert set(np.unique(unsure["segmentation"][0].classes)) == {255}
    assert run(confidence_threshold=0.99).digests() == unsure.digests()
    with pytest.raises(OperatorFailure, match=r"TorchvisionSegmenter\.class_thresholds has 'sky': 0\.5; it takes"):
        run(class_thresholds={"sky": 0.5})
    assert 255 in run(class_thresholds={"background": 0.99})["segmentation"][0].classes


def test_a_detection_model_is_no_segmentation_model() -> None:
    with pytest.raises(OperatorFailure, match="no segmentation model 'ssd300_vgg16'"):
        play(TorchvisionSegmenter(model="ssd300_vgg16"), {"image": [image()]})
