"""An exported network for several cameras: the boxes of each alone, with one call where its batch is open."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_onnx import node, write_model

from dataflow.messages import Image
from dataflow.testing import play
from operators.detection import OnnxDetector, OnnxRigDetector
from operators.inference import ModelError

pytest.importorskip("onnx")

CAMERAS = ("front", "left", "rear")


def image(camera: str, red: int, size: tuple[int, int] = (48, 64), stamp: int = 5) -> Image:
    data = np.full((*size, 3), 90, np.uint8)
    data[..., 0] = red
    return Image(stamp=stamp, frame=camera, data=data)


IMAGES = [image("front", 255), image("left", 120, (90, 70)), image("rear", 10)]


def network(
    file: Path, *, batch: bool = True, joined: bool = False, doubled: bool = False, told: int | str = "n"
) -> str:
    """A model of YOLOv8's signature that finds one box, whose score and middle are the mean of the image.

    With `joined` its answers are not apart by image, with `doubled` it gives each twice; `told` is the first extent of
    the output that it tells.
    """
    nodes = [
        node("ReduceMean", "images", "mean", axes=[1, 2, 3], keepdims=0),
        node("Unsqueeze", "mean behind", "share"),
        node("Mul", "share factors", "scaled"),
        node("Add", "scaled added", "row"),
        node("Reshape", "row shape", "apart"),
        node("Concat", "apart " * (1 + doubled), "output", axis=0),
    ]
    values = {
        "behind": np.array([1]),
        "factors": np.array([32, 32, 0, 0, 1], np.float32),
        "added": np.array([16, 16, 12, 20, 0], np.float32),
        "shape": np.array([1, 5, -1] if joined else [-1, 5, 1]),
    }
    shapes = {"images": ["n" if batch else 1, 3, 64, 64]}, {"output": [told if batch else 1, 5, "m"]}
    return write_model(file, nodes, *shapes, values=values)


class Counted:
    """A session that counts the images of each call."""

    def __init__(self, session: Any) -> None:
        self.session, self.calls = session, list[int]()

    def run(self, names: None, given: dict[str, np.ndarray]) -> Any:
        self.calls.append(len(given["images"]))
        return self.session.run(names, given)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.session, name)


def opened(monkeypatch: pytest.MonkeyPatch) -> list[Counted]:
    from operators.detection import exported

    made: list[Counted] = []
    whole = exported.open_session
    monkeypatch.setattr(exported, "open_session", lambda *given: made.append(Counted(whole(*given))) or made[-1])
    return made


@pytest.mark.parametrize("batch", [True, False], ids=["open batch", "one image"])
def test_each_camera_has_its_own_boxes(tmp_path: Path, batch: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    sessions = opened(monkeypatch)
    model = network(tmp_path / "m.onnx", batch=batch)
    options: dict[str, Any] = {"model": model, "decoder": "yolov8", "classes": "thing", "score_threshold": 0.05}
    rig = play(OnnxRigDetector(cameras=CAMERAS, **options), {"images": {each.frame: [each] for each in IMAGES}})
    assert sessions[0].calls == ([3] if batch else [1, 1, 1])
    for k, each in enumerate(IMAGES):
        alone = OnnxDetector(**options)
        alone.setup()
        (found,) = rig[f"detections_{k + 1}"]
        assert found.count == 1
        assert found.digest() == alone.process(each).digest()
    assert rig["detections_4"] == []


def test_answers_that_are_not_apart_by_image_are_refused(tmp_path: Path) -> None:
    model = network(tmp_path / "m.onnx", doubled=True)
    made = OnnxRigDetector(cameras=CAMERAS, model=model, decoder="yolov8", classes="a")
    made.setup()
    with pytest.raises(ModelError, match=r"was given 3 images and answered \(6, 5, 1\), .* export it for one image"):
        made.process({each.frame: each for each in IMAGES})


@pytest.mark.parametrize("told", [1, "m"])
def test_a_network_that_does_not_tell_its_answers_apart_gets_each_image_alone(
    tmp_path: Path, told: int | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sessions = opened(monkeypatch)
    model = network(tmp_path / "m.onnx", joined=True, told=told)
    made = OnnxRigDetector(cameras=CAMERAS, model=model, decoder="yolov8", classes="a", score_threshold=0.05)
    made.setup()
    found = made.process({each.frame: each for each in IMAGES})
    assert [found[f"detections_{k}"].count for k in (1, 2, 3)] == [1, 1, 1]
    assert sessions[0].calls == [1, 1, 1]


def test_rows_of_all_images_in_one_list_are_not_dealt_out_to_the_cameras(tmp_path: Path) -> None:
    """YOLOv7's export for a batch calls its list of boxes (N, 7) as long as the batch; two boxes are of two images."""
    rows = np.array([[0, 4, 6, 40, 50, 0, 0.9], [0, 1, 1, 30, 20, 0, 0.8]], np.float32)
    ports = {"images": ["batch", 3, 64, 64]}, {"output": ["batch", 7]}
    model = write_model(tmp_path / "m.onnx", [node("Identity", "rows", "output")], *ports, values={"rows": rows})
    made = OnnxRigDetector(cameras=CAMERAS, model=model, decoder="end2end", classes="a")
    made.setup()
    found = made.process({each.frame: each for each in IMAGES[:2]})
    assert [found[f"detections_{k}"].count for k in (1, 2)] == [2, 2]


def test_rows_of_detectors_are_for_rigs_too() -> None:
    made = OnnxRigDetector(cameras=("front",), model="simulated")
    made.setup()
    assert "simulated (row)" in made.files
    alone = OnnxDetector(model="simulated")
    alone.setup()
    assert made.process({"a": IMAGES[0]})["detections_1"].digest() == alone.process(IMAGES[0]).digest()
