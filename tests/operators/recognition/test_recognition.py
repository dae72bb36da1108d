"""Classifier and features: trained by command on made images, then used on images and on detected objects."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dataflow.firing.failure import OperatorFailure
from dataflow.messages import Detections2D, Image
from dataflow.testing import play
from operators.detection.custom.dataset import DataError
from operators.recognition import FeatureExtractor, ImageClassifier
from operators.recognition.crops import covering, views
from operators.recognition.dataset import read_classification_data
from operators.weights import shipped

torch = pytest.importorskip("torch", reason="training needs the extra [train]")

from operators.training.commands import train  # noqa: E402

SHAPES = ("cross", "disc", "stripes")


def picture(shape: str, seed: int) -> np.ndarray:
    """A bright shape of any colour on a noisy dark ground, 64x64."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 60, (64, 64, 3), dtype=np.uint8)
    color = tuple(int(c) for c in rng.integers(140, 255, 3))
    x, y = (int(v) for v in rng.integers(26, 38, 2))
    if shape == "disc":
        cv2.circle(pixels, (x, y), 14, color, -1)
    elif shape == "cross":
        cv2.line(pixels, (x - 16, y - 16), (x + 16, y + 16), color, 5)
        cv2.line(pixels, (x - 16, y + 16), (x + 16, y - 16), color, 5)
    else:
        for row in range(y - 18, y + 18, 9):
            cv2.line(pixels, (4, row), (60, row), color, 3)
    return pixels


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shapes")
    for label, shape in enumerate(SHAPES):
        (folder / shape).mkdir()
        for i in range(24):
            cv2.imwrite(str(folder / shape / f"{i:02d}.png"), picture(shape, 100 * label + i)[..., ::-1])
    return folder


@pytest.fixture(scope="module")
def weights(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command makes of the folder in a few epochs."""
    out = tmp_path_factory.mktemp("trained") / "shapes.onnx"
    words = ["classifier", str(folder), "--out", str(out), "--size", "64x64", "--epochs", "14", "--variation", "0.3"]
    done = CliRunner().invoke(train, [*words, "--threads", "1", "--workers", "1", "--evaluate-every", "7"])
    assert done.exit_code == 0, done.output
    assert "operators.recognition:ImageClassifier" in done.output
    return out


def image(pixels: np.ndarray, stamp: int = 0) -> Image:
    return Image(stamp=stamp, frame="camera", data=pixels)


def scene() -> tuple[Image, Detections2D]:
    """A disc at the left, stripes at the right, and where they are."""
    pixels = np.concatenate([picture("disc", 901), picture("stripes", 902)], axis=1)
    boxes = Detections2D(
        stamp=0, frame="camera", width=128, height=64, class_names=("thing",),
        boxes=[[0, 0, 64, 64], [64, 0, 128, 64]], scores=[1, 1], class_ids=[0, 0], ids=[7, 9],
    )  # fmt: skip
    return image(pixels), boxes


def test_new_images_get_their_class(weights: Path) -> None:
    shown = [(shape, image(picture(shape, 500 + i), i)) for i, shape in enumerate(SHAPES * 5)]
    found = play(ImageClassifier(weights=str(weights)), {"image": [i for _, i in shown]})["classes"]
    right = [message.labels() == (shape,) for (shape, _), message in zip(shown, found, strict=True)]
    assert np.mean(right) >= 0.9
    assert found[0].class_names == SHAPES
    np.testing.assert_allclose([message.probabilities.sum() for message in found], 1.0, rtol=1e-4)


def test_each_object_of_the_image_gets_its_class_and_keeps_its_id(weights: Path) -> None:
    shown, boxes = scene()
    operator = ImageClassifier(weights=str(weights), per="object")
    (found,) = play(operator, {"image": [shown], "detections": [boxes]})["classes"]
    assert found.labels() == ("disc", "stripes")
    assert found.ids.tolist() == [7, 9]


def test_an_image_without_detections_of_its_own_has_no_rows_and_is_counted(weights: Path) -> None:
    shown, boxes = scene()
    operator = ImageClassifier(weights=str(weights), per="object")
    played = play(operator, {"image": [shown.replace(stamp=5)], "detections": [boxes]})
    assert len(played["classes"][0].class_ids) == 0
    assert operator.summary() == {"images_without_detections": 1}


def test_features_have_length_one_and_are_alike_for_alike_things(weights: Path) -> None:
    shown = [image(picture(shape, 700 + i), i) for i, shape in enumerate(SHAPES * 4)]
    played = play(FeatureExtractor(weights=str(weights)), {"image": shown})
    vectors = np.concatenate([message.vectors for message in played["features"]])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=1e-5)
    alike = vectors @ vectors.T
    np.fill_diagonal(alike, -1)
    nearest = alike.argmax(axis=1)
    assert np.mean(nearest % 3 == np.arange(len(shown)) % 3) >= 0.9
    assert played.digests() == play(FeatureExtractor(weights=str(weights)), {"image": shown}).digests()


def test_a_network_of_torchvision_describes_without_its_head(tmp_path: Path) -> None:
    models = pytest.importorskip("torchvision.models", reason="needs the extra [torch]")
    torch.manual_seed(0)
    file = tmp_path / "mobile.pt"
    torch.save(models.get_model("mobilenet_v3_small", weights=None, num_classes=4).state_dict(), file)
    operator = FeatureExtractor(model="mobilenet_v3_small", checkpoint=str(file), per="object")
    shown, boxes = scene()
    (found,) = play(operator, {"image": [shown], "detections": [boxes]})["features"]
    assert found.vectors.shape == (2, 576)
    assert found.model == "torchvision-mobilenet_v3_small-own"
    np.testing.assert_allclose(np.linalg.norm(found.vectors, axis=1), 1.0, rtol=1e-5)


def test_files_of_another_kind_and_missing_weights_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OperatorFailure, match="is a detector; a classifier is needed"):
        play(ImageClassifier(weights=str(shipped("detector.onnx"))), {"image": [scene()[0]]})
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(OperatorFailure, match="are not on this machine"):
        play(FeatureExtractor(), {"image": [scene()[0]]})


def test_data_that_are_not_sorted_by_class_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a folder of images for each of two classes"):
        read_classification_data(tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with pytest.raises(DataError, match="holds no image"):
        read_classification_data(tmp_path)
    (tmp_path / "train").mkdir()
    with pytest.raises(DataError, match=r"has train/ but no val/"):
        read_classification_data(tmp_path)
    read = read_classification_data(folder, seed=1)
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
    assert ids is not None
    assert ids.tolist() == [0, 1, 2, 3]
    assert covering(shown[0], 32).shape == (32, 32, 3)
