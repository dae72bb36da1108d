"""Several cameras in one call of a network: the answers of each camera alone, whatever comes and whatever does not."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_checkpoints import write_checkpoint

import dataflow
from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Image
from dataflow.operator import Out
from dataflow.testing import play
from operators.detection import TorchvisionDetector, TorchvisionRigDetector
from operators.segmentation import TorchvisionRigSegmenter, TorchvisionSegmenter

SSD, RCNN, LRASPP = (
    "ssdlite320_mobilenet_v3_large",
    "fasterrcnn_mobilenet_v3_large_320_fpn",
    "lraspp_mobilenet_v3_large",
)
CLASSES = ("__background__", "person", "mug", "chair")
CAMERAS = ("front", "left", "rear")


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("weights")
    return {name: str(write_checkpoint(folder / f"{name}.pt", name, CLASSES)) for name in (SSD, RCNN, LRASPP)}


def image(camera: str, stamp: int = 0, size: tuple[int, int] = (96, 128)) -> Image:
    rng = np.random.default_rng([CAMERAS.index(camera), stamp])
    return Image(stamp=stamp, frame=camera, data=rng.integers(0, 255, (*size, 3), dtype=np.uint8))


def calls_of(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many images each call of a network got, filled while operators run."""
    sizes: list[int] = []
    from operators.torch_models import Runner

    whole = Runner.__call__

    def counted(self: Runner, tensor: Any, call: Any) -> Any:
        sizes.append(len(tensor))
        return whole(self, tensor, call)

    monkeypatch.setattr(Runner, "__call__", counted)
    return sizes


def one_by_one(operator: Any, images: Sequence[Image]) -> list[Any]:
    """What an operator for one camera gives of each image."""
    operator.setup()
    return [operator.process(each) for each in images]


def streams(*images: Image) -> dict[str, Mapping[str, list[Image]]]:
    by_camera: dict[str, list[Image]] = {}
    for each in images:
        by_camera.setdefault(each.frame, []).append(each)
    return {"images": by_camera}


@pytest.mark.long
@pytest.mark.parametrize("model", [SSD, RCNN])
def test_boxes_are_those_of_each_camera_alone_and_the_network_is_called_once(
    checkpoints: dict[str, str], model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"model": model, "checkpoint": checkpoints[model], "score_threshold": 0.3}
    alone = one_by_one(TorchvisionDetector(**options), [image(c) for c in CAMERAS])
    calls = calls_of(monkeypatch)
    rig = play(TorchvisionRigDetector(cameras=CAMERAS, **options), streams(*(image(c) for c in CAMERAS)))
    assert calls == [3]
    for k, camera in enumerate(CAMERAS):
        (found,) = rig[f"detections_{k + 1}"]
        assert len(alone[k].scores) > 3
        assert found.frame == camera
        np.testing.assert_allclose(found.boxes, alone[k].boxes, atol=1e-4)
        np.testing.assert_allclose(found.scores, alone[k].scores, atol=1e-5)
        assert found.class_ids.tolist() == alone[k].class_ids.tolist()
    assert rig["detections_4"] == []


@pytest.mark.long
def test_images_of_other_sizes_are_not_given_borders_by_their_neighbours(
    checkpoints: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"model": RCNN, "checkpoint": checkpoints[RCNN], "score_threshold": 0.3}
    seen = [image("front"), image("left", size=(64, 160)), image("rear")]
    alone = one_by_one(TorchvisionDetector(**options), seen)
    calls = calls_of(monkeypatch)
    rig = play(TorchvisionRigDetector(cameras=CAMERAS, **options), streams(*seen))
    assert sorted(calls) == [1, 2]
    for k, one in enumerate(alone):
        np.testing.assert_allclose(rig[f"detections_{k + 1}"][0].boxes, one.boxes, atol=1e-4)


def test_a_camera_that_is_silent_holds_up_no_other(
    checkpoints: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = calls_of(monkeypatch)
    made = TorchvisionRigDetector(model=SSD, checkpoint=checkpoints[SSD], cameras=CAMERAS)
    images = [image("front", 10), image("rear", 10), image("left", 13), image("front", 20)]
    rig = play(made, streams(*images))
    assert calls == [2, 1, 1]  # one call for the two of stamp 10
    assert [[m.stamp for m in rig[f"detections_{k}"]] for k in (1, 2, 3)] == [[10, 20], [13], [10]]


def test_maps_are_those_of_each_camera_alone(checkpoints: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    options = {"model": LRASPP, "checkpoint": checkpoints[LRASPP], "side": 64, "with_confidence": True}
    alone = one_by_one(TorchvisionSegmenter(**options), [image(c) for c in CAMERAS])
    calls = calls_of(monkeypatch)
    rig = play(TorchvisionRigSegmenter(cameras=CAMERAS, **options), streams(*(image(c) for c in CAMERAS)))
    assert calls == [3]
    for k, one in enumerate(alone):
        (found,) = rig[f"segmentation_{k + 1}"]
        assert (found.classes == one.classes).mean() > 0.999
        np.testing.assert_allclose(found.confidence, one.confidence, atol=1e-4)


class Seven(TorchvisionRigDetector, merge=True):
    """A rig of seven cameras."""

    detections_7: Out[dataflow.messages.Detections2D]


@pytest.mark.parametrize(
    ("cameras", "frames", "words"),
    [
        (("front", "front"), ("front",), "must name the frame of each camera once"),
        (tuple("abcdefg"), ("front",), "names 7 cameras, but there are 6 outputs"),
        (("left", "rear"), ("front",), r"an image is in frame 'front'; TorchvisionRigDetector.cameras has left, rear"),
    ],
)
def test_cameras_that_do_not_fit_are_named(
    checkpoints: dict[str, str], cameras: tuple[str, ...], frames: tuple[str, ...], words: str
) -> None:
    made = TorchvisionRigDetector(model=SSD, checkpoint=checkpoints[SSD], cameras=cameras)
    with pytest.raises(OperatorFailure, match=words):
        play(made, streams(*(image(f) for f in frames)))


def test_rig_refuses_two_images_of_one_frame_and_takes_seven_cameras(
    checkpoints: dict[str, str],
) -> None:
    made = TorchvisionRigDetector(model=SSD, checkpoint=checkpoints[SSD], cameras=("front",))
    with pytest.raises(OperatorFailure, match="two images of one stamp are in frame 'front'"):
        play(made, {"images": {"a": [image("front")], "b": [image("front")]}})
    many = Seven(model=SSD, checkpoint=checkpoints[SSD], cameras=("a", "b", "c", "d", "e", "f", "front"))
    assert len(play(many, streams(image("front")))["detections_7"]) == 1


GRAPH = """
graph: rig
namespace: robot
operators:
  front:
    use: operators.sources:SyntheticRgbd
    params: {{frames: 3, width: 128, height: 96, image_frame: front}}
  rear:
    use: operators.sources:SyntheticRgbd
    params: {{frames: 3, width: 128, height: 96, image_frame: rear, seed: 1}}
  detector:
    use: operators.detection:TorchvisionRigDetector
    inputs: {{images: [front/image, rear/image]}}
    params: {{model: {model}, checkpoint: {file}, cameras: [front, rear], score_threshold: 0.2}}
"""


@pytest.mark.long
def test_a_graph_with_two_cameras_is_recorded_and_verifies(checkpoints: dict[str, str], tmp_path: Path) -> None:
    graph, file = tmp_path / "rig.yaml", tmp_path / "rig.mcap"
    graph.write_text(GRAPH.format(model=SSD, file=checkpoints[SSD]))
    for words in (("run", graph, "--one-process", "--record", file), ("verify", file, "--jobs", 1, "--json")):
        done = subprocess.run(
            [sys.executable, "-m", "dataflow.cli.main", *map(str, words), "-q"],
            capture_output=True,
            text=True,
            timeout=100,
        )
        assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["identical"] is True
    recording = dataflow.open(file)
    for port, frame in (("detections_1", "front"), ("detections_2", "rear")):
        found = list(recording[f"detector/{port}"])
        assert [m.frame for m in found] == [frame] * 3
        assert any(len(m.scores) for m in found)
