"""torchvision's networks learn one's own classes, resume exactly, and are loaded by the operators with their names."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from interrupted import Interrupted, interrupted
from typer.testing import CliRunner

from dataflow.messages import Image
from operators.detection import TorchvisionDetector
from operators.detection.custom.folder import read_detection_data
from operators.learning.augmentation import NONE
from operators.segmentation import TorchvisionSegmenter
from operators.torch_models import family_of, new_model
from operators.training.commands import train

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="training needs the extra [train]")
    pytest.importorskip("torchvision", reason="needs the extra [torch]")
    from operators.learning.files import TrainingFileError, load_safely
    from operators.learning.loop import Settings
    from operators.learning.loop import train as loop
    from operators.training.torchvision_tasks import TorchvisionDetectorTask, weights_in

DETECTOR, SEGMENTER = "ssdlite320_mobilenet_v3_large", "lraspp_mobilenet_v3_large"
NAMES = ("block", "disc")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images of a block and a disc on grey, with boxes (COCO) and masks."""
    folder = tmp_path_factory.mktemp("data")
    for name in ("images", "masks", "annotations"):
        (folder / name).mkdir()
    rng = np.random.default_rng(1)
    rows: dict[str, list[dict[str, object]]] = {"train": [], "val": []}
    boxes: dict[str, list[dict[str, object]]] = {"train": [], "val": []}
    for k in range(6):
        split = "val" if k == 5 else "train"
        pixels, mask = np.full((96, 128, 3), 90, np.uint8), np.zeros((96, 128), np.uint8)
        x, y = (int(v) for v in rng.integers(4, 40, 2))
        pixels[y : y + 30, x : x + 36], mask[y : y + 30, x : x + 36] = (200, 40, 40), 1
        cv2.circle(pixels, (96, 60), 18, (40, 60, 220), -1)
        cv2.circle(mask, (96, 60), 18, 2, -1)
        cv2.imwrite(str(folder / "images" / f"{k}.png"), pixels)
        cv2.imwrite(str(folder / "masks" / f"{k}.png"), mask)
        rows[split].append({"id": k, "file_name": f"{k}.png", "width": 128, "height": 96})
        for label, box in enumerate(([x, y, 36, 30], [78, 42, 36, 36])):
            boxes[split].append({"id": 2 * k + label, "image_id": k, "category_id": label, "bbox": box})
    for split in rows:
        categories = [{"id": i, "name": n} for i, n in enumerate(NAMES)]
        content = {"images": rows[split], "annotations": boxes[split], "categories": categories}
        (folder / "annotations" / f"instances_{split}.json").write_text(json.dumps(content))
    (folder / "classes.txt").write_text("background\nblock\ndisc\n")
    (folder / "val.txt").write_text("5.png\n")
    return folder


def trained(name: str, data: Path, out: Path, *words: str) -> dict[str, object]:
    given = [name, str(data), "--out", str(out), "--epochs", "1", "--batch", "3", "--threads", "1", "--device", "cpu"]
    done = CliRunner().invoke(train, ["torchvision", *given, "--json", *words])
    assert done.exit_code == 0, done.output
    told: dict[str, object] = json.loads(done.stdout)
    return told


def picture() -> Image:
    return Image(stamp=0, frame="camera", data=np.random.default_rng(2).integers(0, 255, (96, 128, 3), np.uint8))


@pytest.mark.long
def test_a_trained_detector_is_loaded_with_its_own_classes(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine.pth"
    told = trained(DETECTOR, data, out)
    assert told["weights"] == str(out)
    assert {"ap50", "ap"} <= dict(told["scores"]).keys()
    detector = TorchvisionDetector(model=DETECTOR, checkpoint=str(out), score_threshold=0.0)
    detector.setup()
    found = detector.process(picture())
    assert found.class_names == ("__background__", *NAMES)
    assert set(found.labels()) <= set(NAMES)


@pytest.mark.long
def test_a_trained_segmenter_is_loaded_with_its_own_classes(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "masks.pth"
    told = trained(SEGMENTER, data, out, "--size", "64x64")
    assert "miou" in dict(told["scores"])
    segmenter = TorchvisionSegmenter(model=SEGMENTER, checkpoint=str(out), side=64)
    segmenter.setup()
    assert segmenter.process(picture()).class_names == ("background", *NAMES)


def test_given_weights_are_taken_but_for_the_layers_of_other_classes(data: Path, tmp_path: Path) -> None:
    given = new_model("detection", DETECTOR, 91).state_dict()
    torch.save(given, tmp_path / "coco.pth")
    task = TorchvisionDetectorTask(read_detection_data(data), DETECTOR, (128, 96), variation=NONE)
    taken, known = task.begin_with(weights_in(tmp_path / "coco.pth"))
    own = task.network.state_dict()
    other = [name for name in own if not torch.equal(own[name], given[name])] if taken == known else []
    assert not other
    assert 0 < taken < known
    fit = [name for name in own if own[name].shape == given[name].shape]
    assert all(torch.equal(own[name], given[name]) for name in fit)
    assert {name.split(".")[1] for name in own if name not in fit} == {"classification_head"}
    with pytest.raises(TrainingFileError, match="of another model"):
        task.begin_with({"other": torch.zeros(3)})


@pytest.mark.long
def test_a_run_that_was_resumed_ends_with_the_same_bits(data: Path, tmp_path: Path) -> None:
    settings = Settings(epochs=2, batch=3, threads=1, device="cpu", evaluate_every=2)

    def task() -> TorchvisionDetectorTask:
        return TorchvisionDetectorTask(read_detection_data(data), DETECTOR, (96, 64), variation=NONE)

    loop(task(), settings, tmp_path / "whole.pth")
    with pytest.raises(Interrupted):
        loop(task(), settings, tmp_path / "halved.pth", progress=interrupted(1))
    loop(task(), settings, tmp_path / "halved.pth", resume=True)
    whole, halved = (load_safely(tmp_path / f"{name}.pth")["model"] for name in ("whole", "halved"))
    assert all(torch.equal(whole[name], halved[name]) for name in whole)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["ssdlite320_mobilenet_v3_larg", "DATA"], "did you mean 'ssdlite320_mobilenet_v3_large'"),
        ([DETECTOR, "DATA", "--out", "mine.onnx"], "should end in .pth"),
        ([DETECTOR, "DATA", "--weights", "COCO_V7"], "torchvision has COCO_V1"),
        ([DETECTOR, "DATA", "--weights", "COCO_V1", "--from", "x.pth"], "either --weights or --from"),
        ([DETECTOR, "nowhere"], "no data folder 'nowhere'"),
    ],
)
def test_wrong_arguments_are_refused_with_a_hint(
    words: list[str], told: str, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(data, tmp_path / "DATA")
    done = CliRunner().invoke(train, ["torchvision", *words])
    assert done.exit_code == 2
    assert told in " ".join(done.output.split())


def test_models_are_known_by_what_they_do() -> None:
    assert (family_of(DETECTOR), family_of(SEGMENTER)) == ("detection", "segmentation")
