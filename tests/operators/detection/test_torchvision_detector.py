"""torchvision's detectors by name: the same answers as the model called directly, names from its own weights."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from made_checkpoints import new_network, write_checkpoint

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Image
from dataflow.testing import play
from operators.detection import TorchvisionDetector

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="needs the extra [torch]")
    models = pytest.importorskip("torchvision.models", reason="needs the extra [torch]")

NAME = "ssdlite320_mobilenet_v3_large"
CLASSES = ("__background__", "person", "mug", "N/A", "chair")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small network with random weights and five classes of its own."""
    return write_checkpoint(tmp_path_factory.mktemp("weights") / "mine.pt", NAME, CLASSES)


def image(seed: int = 0, *, gray: bool = False) -> Image:
    rng = np.random.default_rng(seed)
    shape = (96, 128) if gray else (96, 128, 3)
    return Image(stamp=seed, frame="camera", data=rng.integers(0, 255, shape, dtype=np.uint8))


def detector(checkpoint: Path, **params: object) -> TorchvisionDetector:
    return TorchvisionDetector(model=NAME, checkpoint=str(checkpoint), score_threshold=0.2, **params)


def test_boxes_are_those_of_the_model_itself(checkpoint: Path) -> None:
    (found,) = play(detector(checkpoint), {"image": [image()]})["detections"]
    model = new_network(NAME, CLASSES)
    model.load_state_dict(torch.load(checkpoint, weights_only=True)["model"])
    with torch.inference_mode():
        direct = model.eval()([torch.from_numpy(image().data.transpose(2, 0, 1)).float() / 255])[0]
    wanted = [i for i, (s, c) in enumerate(zip(direct["scores"], direct["labels"], strict=True)) if s >= 0.2 and c != 3]
    wanted = wanted[:100]
    assert len(wanted) > 3
    np.testing.assert_allclose(found.boxes, direct["boxes"][wanted], atol=1e-4)
    np.testing.assert_allclose(found.scores, direct["scores"][wanted], atol=1e-6)
    assert found.class_ids.tolist() == direct["labels"][wanted].tolist()
    assert found.class_names == CLASSES


def test_only_the_classes_asked_for_are_given(checkpoint: Path) -> None:
    (found,) = play(detector(checkpoint, classes=("mug",)), {"image": [image()]})["detections"]
    assert set(found.labels()) == {"mug"}
    with pytest.raises(OperatorFailure, match="did you mean 'mug'"):
        play(detector(checkpoint, classes=("mugg",)), {"image": [image()]})


def test_equal_images_give_equal_boxes_and_grey_ones_are_taken(checkpoint: Path) -> None:
    streams = {"image": [image(1), image(2, gray=True)]}
    once, again = play(detector(checkpoint), streams), play(detector(checkpoint), streams)
    assert once.digests() == again.digests()


@pytest.mark.long
def test_a_lower_threshold_is_not_cut_off_by_the_model(checkpoint: Path) -> None:
    few = play(detector(checkpoint), {"image": [image()]})["detections"][0]
    operator = TorchvisionDetector(
        model=NAME, checkpoint=str(checkpoint), score_threshold=0.0, max_detections=1000, nms_iou=1.0
    )
    many = play(operator, {"image": [image()]})["detections"][0]
    assert len(many.scores) > len(few.scores)


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"model": "fasterrcn_resnet50_fpn"}, "did you mean 'fasterrcnn_resnet50_fpn'"),
        ({"model": NAME, "weights": "COCO_V7"}, "torchvision has COCO_V1"),
        ({"model": NAME, "device": "cuda:9"}, "device 'cuda:9' is not available here; there is cpu"),
        ({"model": NAME, "device": "gpu"}, "device 'gpu' is unknown"),
    ],
)
def test_unknown_choice_is_refused_with_the_available_ones(params: dict[str, str], words: str) -> None:
    with pytest.raises(OperatorFailure, match=words):
        play(TorchvisionDetector(**params), {"image": [image()]})


def test_missing_weights_error_gives_the_download_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(OperatorFailure, match=rf"looked for {tmp_path}.*ssdlite320.*get them with"):
        play(TorchvisionDetector(model=NAME), {"image": [image()]})


def test_weights_in_the_cache_bring_their_own_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    weights = models.get_model_weights(NAME).COCO_V1
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    model = models.get_model(NAME, weights=None, weights_backbone=None)
    torch.save(model.state_dict(), tmp_path / "hub" / "checkpoints" / weights.url.rsplit("/", 1)[-1])
    operator = TorchvisionDetector(model=NAME, score_threshold=0.0)
    (found,) = play(operator, {"image": [image()]})["detections"]
    assert found.class_names[:3] == ("__background__", "person", "bicycle")
    assert found.class_names[90] == "toothbrush"
    assert "N/A" not in found.labels()


@pytest.mark.long
def test_weights_of_another_model_or_no_weights_at_all_are_refused(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(OperatorFailure, match=r"mine\.pt do not fit ssd300_vgg16"):
        play(TorchvisionDetector(model="ssd300_vgg16", checkpoint=str(checkpoint)), {"image": [image()]})
    (tmp_path / "text.pt").write_text("no checkpoint")
    with pytest.raises(OperatorFailure, match=r"no checkpoint of torch\.save .* which are not read") as told:
        play(TorchvisionDetector(model=NAME, checkpoint=str(tmp_path / "text.pt")), {"image": [image()]})
    assert "arbitrary code" not in str(told.value), "how to run it is not told"


def test_half_precision_needs_a_gpu(checkpoint: Path) -> None:
    with pytest.raises(OperatorFailure, match="half precision needs a GPU"):
        play(detector(checkpoint, half=True), {"image": [image()]})
