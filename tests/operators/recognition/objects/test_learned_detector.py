"""Objects learned from a few made images by command, found in others with the classes known before."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Image
from dataflow.testing import play
from operators.detection import CustomDetector
from operators.recognition import LearnedDetector
from operators.recognition.objects.learned_object import (
    ImageExamples,
    LearnedObject,
    LearnedObjectError,
    learn,
    shown_in,
)
from operators.recognition.objects.proposals import Trunk, inner_maps
from operators.scene.map.file import LearnedFile, SavedMap
from operators.training.learning import learn as command
from operators.weights import shipped

pytest.importorskip("onnx", reason="learning needs the extra [train]")

WIDTH, HEIGHT = 320, 240
NO_OUTLINE = np.zeros((0, 2), np.float32), np.zeros((0, 4), np.float32)


def scenery(seed: int, *, sign: bool) -> tuple[np.ndarray, tuple[int, int, int, int]]:
    """A wall, a floor and boxes of any colour; with a round red and white sign, and where it is (x, y, w, h)."""
    rng = np.random.default_rng(seed)
    pixels = np.full((HEIGHT, WIDTH, 3), 190, np.uint8)
    pixels[150:] = (110, 95, 80)
    for _ in range(4):
        x, y = rng.integers(0, WIDTH - 60), rng.integers(100, 180)
        color = tuple(int(c) for c in rng.integers(20, 230, 3))
        cv2.rectangle(pixels, (int(x), int(y)), (int(x + rng.integers(20, 60)), int(y + 50)), color, -1)
    radius = int(rng.integers(18, 34))
    x, y = int(rng.integers(40, WIDTH - 40)), int(rng.integers(50, 190))
    if sign:
        for share, color in ((1.0, (210, 30, 30)), (0.7, (245, 245, 245)), (0.4, (210, 30, 30))):
            cv2.circle(pixels, (x, y), int(share * radius), color, -1, cv2.LINE_AA)
    noise = rng.normal(0, 3, pixels.shape)
    return np.clip(pixels + noise, 0, 255).astype(np.uint8), (x - radius, y - radius, 2 * radius, 2 * radius)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("signs")
    images, annotations = [], []
    for k in range(5):
        pixels, box = scenery(k, sign=True)
        cv2.imwrite(str(folder / f"{k}.png"), pixels[..., ::-1])
        images.append({"id": k, "file_name": f"{k}.png", "width": WIDTH, "height": HEIGHT})
        annotations.append({"id": k, "image_id": k, "category_id": 0, "bbox": list(box), "area": 1, "iscrowd": 0})
    content = {"images": images, "annotations": annotations, "categories": [{"id": 0, "name": "sign"}]}
    (folder / "annotations.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def learned(labelled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("learned") / "sign.object.npz"
    done = CliRunner().invoke(command, ["object", "sign", str(labelled), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "sign from 5 images of 5" in done.output
    return out


def image(pixels: np.ndarray, stamp: int = 0) -> Image:
    return Image(stamp=stamp, frame="camera", data=pixels)


@pytest.mark.long
def test_a_learned_object_is_found_where_it_is_and_nowhere_else(learned: Path) -> None:
    hits = false = 0
    operator = LearnedDetector(objects=[str(learned)])
    shown = [scenery(100 + k, sign=k % 2 == 0) for k in range(12)]
    found = play(operator, {"image": [image(p, k) for k, (p, _) in enumerate(shown)]})["detections"]
    for k, (message, (_, (x, y, w, h))) in enumerate(zip(found, shown, strict=True)):
        for box, label in zip(message.boxes, message.labels(), strict=True):
            if label == "sign":
                there = np.abs(box - [x, y, x + w, y + h]).max() < 0.3 * w and k % 2 == 0
                hits, false = hits + there, false + (not there)
    assert hits >= 5
    assert false <= 1


@pytest.mark.long
def test_known_classes_are_those_of_the_detector_where_nothing_was_learned(learned: Path) -> None:
    pixels, _ = scenery(201, sign=False)
    (known,) = play(CustomDetector(), {"image": [image(pixels)]})["detections"]
    (both,) = play(LearnedDetector(objects=[str(learned)]), {"image": [image(pixels)]})["detections"]
    old = [k for k, label in enumerate(both.labels()) if label != "sign"]
    assert both.class_names == (*known.class_names, "sign")
    np.testing.assert_allclose(both.boxes[old], known.boxes, atol=1e-3)


def test_equal_images_give_equal_boxes(learned: Path) -> None:
    shown = [image(scenery(300 + k, sign=True)[0], k) for k in range(3)]
    runs = [play(LearnedDetector(objects=[str(learned)]), {"image": shown}).digests() for _ in range(2)]
    assert runs[0] == runs[1]


def test_a_file_is_not_replaced_unasked_and_an_unknown_class_is_named(labelled: Path, learned: Path) -> None:
    again = CliRunner().invoke(command, ["object", "sign", str(labelled), "--out", str(learned)])
    assert again.exit_code == 2
    assert "exists already" in again.output
    other = CliRunner().invoke(command, ["object", "signal", str(labelled), "--out", str(learned) + ".x"])
    assert other.exit_code == 2
    assert "no class 'signal'" in other.output


def test_files_that_are_no_learned_objects_or_of_another_detector_are_refused(learned: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"nothing")
    with pytest.raises(OperatorFailure, match="is no learned object"):
        play(LearnedDetector(objects=[str(broken)]), {"image": [image(scenery(0, sign=True)[0])]})
    known = LearnedObject.read(learned)
    strange = tmp_path / "strange.npz"
    LearnedObject(**(vars(known) | {"detector": "0" * 64})).write(strange)
    with pytest.raises(OperatorFailure, match="was learned with another detector"):
        play(LearnedDetector(objects=[str(strange)]), {"image": [image(scenery(0, sign=True)[0])]})


def test_learned_object_survives_its_file(learned: Path, tmp_path: Path) -> None:
    known = LearnedObject.read(learned)
    known.write(tmp_path / "copy.npz")
    copy = LearnedObject.read(tmp_path / "copy.npz")
    assert (copy.name, copy.detector, copy.threshold, copy.images) == ("sign", known.detector, known.threshold, 5)
    np.testing.assert_array_equal(copy.direction, known.direction)


def test_uninformative_feature_axis_gets_little_weight() -> None:
    """The first axis differs most but at random; the second tells."""
    rng = np.random.default_rng(0)

    def vectors(count: int, second: float) -> np.ndarray:
        return np.stack([rng.normal(0, 1, count), rng.normal(second, 0.1, count)], axis=1).astype(np.float32)

    shown = [ImageExamples(vectors(8, 1.0), vectors(60, 0.0), *NO_OUTLINE) for _ in range(5)]
    found = learn("thing", shown, "", ())
    assert abs(found.direction[1]) > 3 * abs(found.direction[0])
    assert (found.probability(vectors(50, 1.0)) > 0.5).mean() > 0.9
    assert (found.probability(vectors(50, 0.0)) < 0.5).mean() > 0.9


@pytest.mark.parametrize("box", [(280.3, 190.4, 320.0, 239.7), (0.0, 0.0, 320.0, 240.0), None], ids=str)
def test_objects_at_the_edge_and_images_without_one_are_learned_from(box: tuple[float, ...] | None) -> None:
    network = shipped("detector.onnx")
    trunk = Trunk(network, inner_maps(network))
    pixels, _ = scenery(0, sign=False)
    boxes = np.array([] if box is None else [box], np.float32).reshape(-1, 4)
    shown = shown_in(trunk, pixels, boxes, np.random.default_rng(0))
    assert (len(shown.object) > 0) == (box is not None)
    assert len(shown.touching) == len(shown.changes)
    assert len(shown.others) or box is not None


def test_no_example_is_an_error() -> None:
    with pytest.raises(LearnedObjectError, match="no image shows mug"):
        learn("mug", [ImageExamples(np.zeros((0, 3), np.float32), np.ones((4, 3), np.float32), *NO_OUTLINE)], "", ())


def test_boxes_are_drawn_to_the_outline_that_their_vectors_tell() -> None:
    """A vector that tells how far the box is off teaches how to mend it; one step cannot go farther than half a box."""
    rng = np.random.default_rng(1)
    changes = rng.uniform(-0.3, 0.3, (200, 4)).astype(np.float32)
    told = (10 * changes + rng.normal(0, 0.05, changes.shape)).astype(np.float32)
    found = learn("thing", [ImageExamples(told[:20], -told[20:60] + 9, told, changes)], "", ())
    size, change = np.array([40.0, 20.0], np.float32), np.array([0.2, -0.1, 0.15, -0.2], np.float32)
    (drawn,) = found.drawn(np.array([[0, 0, *size]], np.float32), 10 * change[None])
    np.testing.assert_allclose((drawn[:2] + drawn[2:]) / 2, size * (0.5 + change[:2]), atol=0.5)
    np.testing.assert_allclose(drawn[2:] - drawn[:2], size * np.exp(change[2:]), rtol=0.02)
    (far,) = found.drawn(np.array([[0, 0, *size]], np.float32), np.full((1, 4), 100, np.float32))
    np.testing.assert_allclose((far[:2] + far[2:]) / 2, size, atol=1e-3)


def test_a_file_without_an_outline_leaves_boxes_where_they_are(learned: Path, tmp_path: Path) -> None:
    with np.load(learned) as kept:
        first = {name: kept[name] for name in kept.files if name != "outline"}
    np.savez(tmp_path / "first.npz", **first)
    boxes = np.array([[3, 4, 30, 50]], np.float32)
    described = np.ones((1, len(first["direction"])), np.float32)
    np.testing.assert_allclose(LearnedObject.read(tmp_path / "first.npz").drawn(boxes, described), boxes)


def test_a_saved_map_brings_back_the_classes_that_were_learned_for_it(learned: Path, tmp_path: Path) -> None:
    room, empty = tmp_path / "room.map.npz", tmp_path / "empty.map.npz"
    file = LearnedFile(learned.name, learned.read_bytes())
    SavedMap((), "", 0.03, {}, {}, (file,)).write(room)
    SavedMap((), "", 0.03, {}, {}).write(empty)
    shown = [image(scenery(400 + k, sign=True)[0], k) for k in range(3)]
    by_file, by_map = (play(LearnedDetector(objects=[str(f)]), {"image": shown}).digests() for f in (learned, room))
    assert by_map == by_file
    with pytest.raises(OperatorFailure, match="no map that was saved with one"):
        play(LearnedDetector(objects=[str(empty)]), {"image": shown})
