"""The second look at each box: what it sees, what it changes, how it is trained, and files with and without one."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from interrupted import trained_twice
from numpy.typing import NDArray

from dataflow.messages import Image
from operators.detection import CustomDetector
from operators.detection.custom.closeup import closeups, moved, numbers, places, windows
from operators.detection.custom.dataset import DetectionData, LabelledImage, labelled
from operators.detection.custom.first_look import FirstStage, FirstStageDetections
from operators.detection.custom.refiner import Refiner, RefinerSettings, look_again
from operators.detection.custom.surroundings import GRID, surroundings
from operators.detection.decode import Candidates
from operators.detection.nms import intersection_over_union
from operators.image.letterbox import ImageFit
from operators.learning.augmentation import Variation
from operators.training.options import ImageTraining
from operators.training.refining import add_second
from operators.weights import NetworkFileError, open_network

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.detection.custom.network import STRIDES, GridDetector
    from operators.detection.custom.refiner_training import RefinerTask, astray, matched
    from operators.learning.export import attach_second, export_network, without_second
    from operators.learning.files import TrainingFileError, load_safely
    from operators.learning.loop import Settings, train
    from operators.training.quantization import quantize_network

CLASSES = ("crate", "ball")
GENTLE = Variation(flip=0.5, color=0.1, noise=3, blur=0)
Boxes = NDArray[np.float32]
Refined = tuple[Path, Path, DetectionData]


def scene(seed: int) -> tuple[NDArray[np.uint8], Boxes, NDArray[np.int32]]:
    """A noisy image (H, W, 3) of a red rectangle, a crate, in its left half and a blue disc, a ball, in the right."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(90, 150, (96, 160, 3), dtype=np.uint8)
    w, h, d = (int(v) for v in rng.integers(16, 48, 3))
    x, y, u, v = (int(rng.integers(2, limit)) for limit in (78 - w, 94 - h, 78 - d, 94 - d))
    pixels[y : y + h, x : x + w] = (200, 60, 40)
    cv2.circle(pixels, (80 + u + d // 2, v + d // 2), d // 2, (40, 90, 210), -1)
    size = d // 2 * 2 + 1
    return (
        pixels,
        np.array([[x, y, x + w, y + h], [80 + u, v, 80 + u + size, v + size]], np.float32),
        np.array([0, 1], np.int32),
    )


def data_of(folder: Path, training: int, validation: int) -> DetectionData:
    folder.mkdir()
    images: list[LabelledImage] = []
    for k in range(training + validation):
        pixels, boxes, classes = scene(k)
        cv2.imwrite(str(folder / f"{k:03d}.png"), pixels[..., ::-1])
        images.append(labelled(folder / f"{k:03d}.png", (boxes / [160, 96, 160, 96]).tolist(), classes.tolist()))
    return DetectionData(CLASSES, tuple(images[:training]), tuple(images[training:]))


def untrained(folder: Path, classes: tuple[str, ...] = CLASSES) -> Path:
    """A detector's file that has learned nothing."""
    torch.manual_seed(1)
    network = GridDetector(len(classes), width=0.25, channels=32).eval()
    anchors = np.array([[[10, 10], [20, 20], [40, 40]]] * 3, np.float32)
    facts = {"kind": "detector", "classes": classes, "width": 160, "height": 96}
    facts |= {"anchors": anchors.tolist(), "strides": list(STRIDES)}
    file = folder / f"detector{len(classes)}.onnx"
    export_network(network, (160, 96), ["a", "b", "c"], facts, file)
    return file


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> Refined:
    """A detector's file, the same with a refiner that has learned crates and balls, and what it learned from."""
    folder = tmp_path_factory.mktemp("refined")
    data, plain, out = data_of(folder / "data", 48, 4), untrained(folder), folder / "refined.onnx"
    own = ImageTraining(epochs=30, batch=8, learning_rate=4e-3, evaluate_every=30, threads=1, json=True)
    add_second(RefinerTask(data, plain, variation=GENTLE), plain, out, own)
    return plain, out, data


def again(file: Path, pixels: NDArray[np.uint8], found: Candidates) -> Candidates:
    """What a file's refiner makes of boxes, by falling score."""
    first = FirstStage(file)
    refiner = Refiner.within(first.network)
    assert refiner is not None
    first.reveal(refiner.maps)
    looked = first.look(pixels, 0.5, 0.5, 1)
    return refiner.refined(pixels, FirstStageDetections(found, looked.inner, looked.fit), 0.5)


# ---- what it sees


def test_closeup_shows_the_pixels_of_its_window() -> None:
    pixels = np.zeros((60, 100, 3), np.uint8)
    pixels[20:40, 30:50] = (255, 128, 0)
    whole = closeups(pixels, np.array([[20, 10, 60, 50]], np.float32), 40)[0]
    assert np.array_equal(whole, pixels[10:50, 20:60])  # a pixel for a pixel
    twice = closeups(pixels, np.array([[30, 20, 50, 40]], np.float32), 40)[0]
    assert np.abs(twice[2:-2, 2:-2].astype(int) - [255, 128, 0]).max() == 0
    beyond = closeups(pixels, np.array([[-40, -40, 0, 0]], np.float32), 40)[0]
    assert (beyond[:-1, :-1] == 114).all()


def test_a_shrunken_closeup_passes_over_no_pixels() -> None:
    stripes = np.zeros((480, 640, 3), np.uint8)
    stripes[:, ::8] = 240  # one column of eight: their mean is 30
    seen = closeups(stripes, np.array([[0, 0, 640, 240]], np.float32), 40)[0]
    assert np.abs(seen.astype(int) - 30).max() <= 30


@given(
    st.lists(st.tuples(*[st.floats(-20, 180, width=32)] * 4), min_size=1, max_size=5),
    st.lists(st.floats(0, 1, width=32), min_size=5, max_size=5),
)
@settings(max_examples=50, deadline=None)
def test_any_box_gives_finite_numbers_and_moves_inside_the_image(
    rows: list[tuple[float, ...]], scores: list[float]
) -> None:
    corners = np.array(rows, np.float32)
    boxes = np.concatenate([np.minimum(corners[:, :2], corners[:, 2:]), np.maximum(corners[:, :2], corners[:, 2:])], 1)
    known = places(boxes, np.array(scores[: len(boxes)], np.float32), np.zeros(len(boxes), np.int32), 3, (160, 96))
    assert known.shape == (len(boxes), numbers(3))
    assert np.isfinite(known).all()
    there = moved(boxes, np.full_like(boxes, 0.2), (160, 96))
    assert (there >= 0).all()
    assert (there <= [160, 96, 160, 96]).all()
    assert (there[:, 2:] >= there[:, :2]).all()


def test_sides_are_shares_of_the_window() -> None:
    boxes, wanted = np.array([[40, 30, 80, 60]], np.float32), np.array([[44, 27, 90, 58]], np.float32)
    seen = windows(boxes)
    sides = (wanted - boxes) / np.tile(seen[:, 2:] - seen[:, :2], 2)
    assert np.allclose(moved(boxes, sides, (160, 96)), wanted, atol=1e-4)


# ---- what it changes


@pytest.mark.long
def test_boxes_that_are_astray_come_to_their_objects(refined: Refined) -> None:
    before, after = [], []
    for seed in range(500, 530):
        pixels, boxes, classes = scene(seed)
        led = np.clip(astray(boxes, 0.12, np.random.default_rng(seed)), 0, [160, 96, 160, 96]).astype(np.float32)
        found = again(refined[1], pixels, Candidates(led, np.array([0.9, 0.8], np.float32), classes))
        assert found.scores.tolist() == [np.float32(0.9), np.float32(0.8)]
        for box, label in zip(found.boxes, found.classes, strict=True):
            after.append(float(intersection_over_union(box, boxes[label][None])[0]))
        before += [float(intersection_over_union(a, b[None])[0]) for a, b in zip(led, boxes, strict=True)]
    assert np.mean(before) < 0.75
    assert np.mean(after) > 0.87


def looked_at(found: Candidates) -> FirstStageDetections:
    return FirstStageDetections(
        found, [np.zeros((1, 4, 6, 10), np.float32)], ImageFit.plan("letterbox", (160, 96), (160, 96))
    )


LOOK = RefinerSettings(classes=2, side=24, least=0.05, most=8)


def test_boxes_that_come_to_the_same_object_are_one() -> None:
    pixels = scene(0)[0]
    boxes = np.array([[10, 10, 50, 50], [40, 10, 80, 50], [100, 10, 140, 50]], np.float32)
    found = Candidates(boxes, np.array([0.9, 0.6, 0.02], np.float32), np.zeros(3, np.int32))
    share = -25 / (40 * 1.5 + 4)
    sides = np.array([[0, 0, 0, 0], [share, 0, share, 0]], np.float32)
    second = look_again(lambda *_: sides, pixels, looked_at(found), LOOK, 0.5)
    assert second.scores.tolist() == [np.float32(0.9), np.float32(0.02)]  # the first and the second are one
    assert np.array_equal(second.boxes, boxes[[0, 2]])  # the third is too unsure for a second look
    other = Candidates(boxes, found.scores, np.array([0, 1, 0], np.int32))
    apart = look_again(lambda *_: sides, pixels, looked_at(other), LOOK, 0.5)
    assert np.allclose(apart.boxes[1], [15, 10, 55, 50], atol=1e-3)  # of another class
    assert len(apart.scores) == 3


def test_only_the_best_boxes_are_looked_at_again_and_none_needs_none() -> None:
    pixels = scene(0)[0]
    boxes = np.array([[10, 10, 50, 50], [100, 10, 140, 50]], np.float32)
    found = Candidates(boxes, np.array([0.9, 0.8], np.float32), np.zeros(2, np.int32))
    few = RefinerSettings(classes=2, side=24, least=0.05, most=1)
    second = look_again(lambda *_: np.full((1, 4), 0.1, np.float32), pixels, looked_at(found), few, 0.5)
    assert np.array_equal(second.boxes[1], boxes[1])
    assert (second.boxes[0] > boxes[0]).all()
    nothing = found.select(np.zeros(2, np.bool_))
    assert len(look_again(lambda *_: boxes, pixels, looked_at(nothing), LOOK, 0.5).scores) == 0


def test_surroundings_are_samples_over_the_window() -> None:
    """Of a map whose value is its place: the samples lie on a grid over the window, whatever its size."""
    fit = ImageFit.plan("letterbox", (320, 192), (160, 96))
    rows, columns = np.mgrid[:12, :20].astype(np.float32) + 0.5
    place = np.stack([columns * 8, rows * 8])[None]  # of each cell's middle, in the input
    shares = (np.arange(GRID) + 0.5) / GRID
    for window in ([40, 40, 88, 64], [20, 20, 300, 172], [100, 60, 101, 61]):
        found = surroundings([place], np.array([window], np.float32), fit).reshape(GRID, GRID, 2)
        x = (window[0] + shares * (window[2] - window[0])) / 2
        y = (window[1] + shares * (window[3] - window[1])) / 2
        assert np.allclose(found[..., 0], np.broadcast_to(x, (GRID, GRID)), atol=0.5)
        assert np.allclose(found[..., 1], np.broadcast_to(y[:, None], (GRID, GRID)), atol=0.5)


@given(
    st.lists(st.tuples(*[st.floats(-50, 400, width=32)] * 4), min_size=1, max_size=4),
    st.integers(1, 9),
    st.integers(1, 9),
)
@settings(max_examples=40, deadline=None)
def test_surroundings_of_any_window_lie_between_the_least_and_the_greatest_value(
    corners: list[tuple[float, ...]], height: int, width: int
) -> None:
    seen = np.sort(np.array(corners, np.float32).reshape(-1, 2, 2), axis=1).reshape(-1, 4)
    map = np.random.default_rng(height * width).random((1, 3, height, width)).astype(np.float32)
    found = surroundings([map], seen, ImageFit.plan("letterbox", (320, 192), (160, 96)))
    assert found.shape == (len(seen), GRID * GRID * 3)
    assert found.min() >= map.min() - 1e-5
    assert found.max() <= map.max() + 1e-5


def test_a_window_far_larger_than_a_small_map_has_samples_of_its_coarsest_cells() -> None:
    """A map of 6 cells is halved once, then too small: the largest window takes what the halved one has."""
    map, fit = np.full((1, 2, 6, 6), 3.5, np.float32), ImageFit.plan("letterbox", (160, 96), (160, 96))
    seen = np.array([[-3000, -3000, 3000, 3000]] * 50 + [[10, 10, 20, 20]], np.float32)
    assert (surroundings([map], seen, fit) == 3.5).all()


# ---- the operator and its files


def test_a_detector_without_a_refiner_answers_as_its_first_look(refined: Refined) -> None:
    plain, _, data = refined
    detector = CustomDetector(weights=str(plain), score_threshold=0.001)
    detector.setup()
    pixels = data.validation[0].read()
    found = detector.process(Image(stamp=1, frame="camera", data=pixels))
    first = FirstStage(plain).look(pixels, 0.001, 0.5, 100).found
    assert found.count > 0
    assert np.array_equal(found.boxes, first.boxes)
    assert np.array_equal(found.scores, first.scores)


def test_a_detector_with_a_refiner_repeats_itself_and_keeps_to_its_threshold(refined: Refined) -> None:
    _, file, data = refined
    detectors = [CustomDetector(weights=str(file), score_threshold=threshold) for threshold in (0.0, 0.0, 0.3)]
    for each in detectors:
        each.setup()
    image = Image(stamp=1, frame="camera", data=data.validation[0].read())
    first, again, few = (each.process(image) for each in detectors)
    assert first.digest() == again.digest()
    assert (np.diff(first.scores) <= 0).all()
    assert (few.scores >= 0.3).all()


def test_exported_file_agrees_with_the_trained_network(refined: Refined) -> None:
    plain, file, data = refined
    task = RefinerTask(data, plain, variation=GENTLE)
    task.network.load_state_dict(load_safely(file.with_suffix(".refiner.pt"))["ema"])
    task.network.eval()
    batch = task.batch([0], [np.random.default_rng(0)])
    with torch.inference_mode():
        sides = task.network(batch.closeups, batch.surroundings.float(), batch.places)
    refiner = Refiner.within(open_network(file, "detector"))
    assert refiner is not None
    there = refiner._answer(batch.closeups.numpy(), batch.surroundings.float().numpy(), batch.places.numpy())
    assert np.abs(there - sides.numpy()).max() < 0.005


@pytest.mark.long
def test_8_bits_leave_the_refiner_as_it_is(refined: Refined, tmp_path: Path) -> None:
    _, file, data = refined
    small = tmp_path / "small.onnx"
    quantize_network(file, [image.read() for image in data.training[:4]], small)
    pixels, boxes, classes = scene(701)
    found = Candidates(boxes, np.array([0.9, 0.5], np.float32), classes)
    first, second = (again(each, pixels, found) for each in (file, small))
    assert np.abs(first.boxes - second.boxes).max() < 1.5  # its surroundings come from a network of 8 bits


def test_the_detector_in_the_file_is_the_same_bytes(refined: Refined) -> None:
    plain, file, _ = refined
    assert without_second(file) == without_second(plain)
    assert file.stat().st_size > plain.stat().st_size


def test_a_second_network_that_does_not_fit_is_refused(refined: Refined, tmp_path: Path) -> None:
    import onnx

    plain, file, _ = refined
    model = onnx.load(str(file))
    kept = {each.key: each.value for each in model.metadata_props}
    for second, fault in (
        ("no base64!", "second network in .* is not base64"),
        ("AAAA", "second network in .* cannot be loaded as an ONNX model"),
    ):
        onnx.helper.set_model_props(model, kept | {"dataflow.second": second})
        onnx.save(model, str(tmp_path / "spoiled.onnx"))
        with pytest.raises(ValueError, match=fault):
            CustomDetector(weights=str(tmp_path / "spoiled.onnx")).setup()
    attach_second(plain, plain, tmp_path / "twice.onnx")
    with pytest.raises(
        NetworkFileError, match=r"must be of the kind refiner and of the classes .* it is of the kind detector"
    ):
        CustomDetector(weights=str(tmp_path / "twice.onnx")).setup()
    other, refiner = untrained(tmp_path, ("crate", "ball", "lamp")), tmp_path / "refiner.onnx"
    refiner.write_bytes(base64.b64decode(kept["dataflow.second"]))
    attach_second(other, refiner, tmp_path / "o.onnx")
    with pytest.raises(NetworkFileError, match=r"must be of the kind refiner .*lamp"):
        CustomDetector(weights=str(tmp_path / "o.onnx")).setup()


# ---- training


def test_a_box_is_of_the_object_of_its_class_that_it_overlaps_most() -> None:
    truth = np.array([[0, 0, 10, 10], [8, 0, 20, 10], [40, 0, 60, 10]], np.float32)
    classes, ignored = np.array([0, 0, 0], np.int32), np.array([False, False, True])
    boxes = np.array([[1, 0, 11, 10], [9, 0, 20, 10], [41, 0, 60, 10], [0, 0, 10, 10], [80, 0, 90, 9]], np.float32)
    wanted, known = matched(boxes, np.array([0, 0, 0, 1, 0], np.int32), truth, classes, ignored)
    assert known.tolist() == [True, True, False, False, False]  # nor what lies on an ignored object
    assert np.array_equal(wanted[:2], truth[:2])


def test_training_closeups_show_the_objects_mirrored_or_not(refined: Refined) -> None:
    plain, _, data = refined
    task = RefinerTask(data, plain, variation=GENTLE)
    red = left = 0
    for k in range(task.samples):
        batch = task.batch([k], [np.random.default_rng(k)])
        assert batch.boxes.shape == batch.wanted.shape == (len(batch.places), 4)
        for seen, box, wanted, known in zip(batch.closeups, batch.boxes, batch.wanted, batch.places, strict=True):
            if known[-2] != 1:
                continue  # a crate's numbers end in 1, 0
            window = windows(box[None].numpy())[0]
            share = (wanted.numpy() - np.tile(window[:2], 2)) / np.tile(window[2:] - window[:2], 2) * task.side
            x1, y1, x2, y2 = (int(v) for v in np.clip(np.round(share + np.array([2, 2, -2, -2])), 0, task.side))
            inner = seen[y1:y2, x1:x2].float()
            assert float((inner[..., 0] - inner[..., 2]).mean()) > 60
            red, left = red + 1, left + int(wanted[0] < 80)
    assert red == 48
    assert 12 < left < 36  # crates are in the left half, but for the mirror images


@pytest.mark.long
def test_an_interrupted_training_ends_with_the_same_bits(refined: Refined, tmp_path: Path) -> None:
    plain, _, data = refined
    few = DetectionData(data.classes, data.training[:8], data.validation)
    own = Settings(epochs=2, batch=4, threads=1)
    trained_twice(lambda: RefinerTask(few, plain, seed=2, variation=GENTLE), own, tmp_path)


@pytest.mark.long
def test_refiner_refuses_other_classes_and_another_detector(refined: Refined, tmp_path: Path) -> None:
    plain, _, data = refined
    other = untrained(tmp_path, ("crate", "ball", "lamp"))
    with pytest.raises(TrainingFileError, match=r"has crate, ball, lamp; the data have crate, ball"):
        RefinerTask(data, other)
    few = DetectionData(data.classes, data.training[:4], data.validation)
    own = Settings(epochs=1, batch=4, threads=1)
    train(RefinerTask(few, plain), own, tmp_path / "a.onnx")
    torch.manual_seed(9)
    network = GridDetector(2, width=0.25, channels=32).eval()
    facts = json.loads(json.dumps(dict(open_network(plain, "detector").facts)))
    export_network(network, (160, 96), ["a", "b", "c"], facts, tmp_path / "new.onnx")
    with pytest.raises(TrainingFileError, match="cannot be resumed: its detector is"):
        train(RefinerTask(few, tmp_path / "new.onnx"), own, tmp_path / "a.onnx", resume=True)
