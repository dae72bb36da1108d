"""The grid detector from a folder of labelled images to boxes, and each part against a second way to its answer."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_onnx import with_facts
from typer.testing import CliRunner, Result

from dataflow.messages import Image
from operators.detection import CustomDetector
from operators.detection.custom.augmentation import view
from operators.detection.custom.dataset import DataError, labelled
from operators.detection.custom.decode import decode_grid, find_boxes
from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.custom.folder import read_detection_data
from operators.detection.custom.yolo_folder import read_yolo
from operators.detection.decode import Candidates
from operators.detection.nms import intersection_over_union
from operators.learning.augmentation import NONE, Variation, fitted, tensor_of, warp
from operators.training import commands
from operators.weights import NetworkFileError, open_network, open_second, shipped

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="training needs the extra [train]")
    from operators.detection.custom.loss import Truth, assign, complete_iou, decode_maps, detection_loss
    from operators.detection.custom.network import STRIDES, GridDetector
    from operators.detection.custom.training import fit_anchors, mean_best_iou, size_iou

COLORS = {"crate": (200, 60, 40), "ball": (40, 90, 210)}


def scene(seed: int, size: tuple[int, int] = (160, 128)) -> tuple[np.ndarray, list[tuple[int, list[int]]]]:
    """A noisy image with one to three objects that do not overlap: red rectangles are crates, blue discs balls."""
    rng = np.random.default_rng(seed)
    width, height = size
    pixels = rng.integers(90, 150, (height, width, 3), dtype=np.uint8)
    objects: list[tuple[int, list[int]]] = []
    for _ in range(int(rng.integers(1, 4))):
        kind = int(rng.integers(0, 2))
        w = int(rng.integers(24, 52))
        h = w if kind else int(rng.integers(24, 52))
        x, y = int(rng.integers(0, width - w)), int(rng.integers(0, height - h))
        if any(x < b[2] and y < b[3] and x + w > b[0] and y + h > b[1] for _, b in objects):
            continue
        if kind:
            cv2.circle(pixels, (x + w // 2, y + h // 2), w // 2, COLORS["ball"], -1)
        else:
            pixels[y : y + h, x : x + w] = COLORS["crate"]
        objects.append((kind, [x, y, x + w, y + h]))
    return pixels, objects


def write_yolo(folder: Path, count: int, seed: int = 0) -> Path:
    """A folder in YOLO format."""
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    (folder / "data.yaml").write_text("names: [crate, ball]\n")
    for i in range(count):
        pixels, objects = scene(seed + i)
        height, width = pixels.shape[:2]
        cv2.imwrite(str(folder / "images" / f"{i:03d}.png"), pixels[..., ::-1])
        rows = [
            f"{kind} {(x1 + x2) / 2 / width} {(y1 + y2) / 2 / height} {(x2 - x1) / width} {(y2 - y1) / height}"
            for kind, (x1, y1, x2, y2) in objects
        ]
        (folder / "labels" / f"{i:03d}.txt").write_text("\n".join(rows))
    return folder


def write_coco(folder: Path, count: int, seed: int = 0) -> Path:
    """The same images in COCO format, categories numbered 7 and 3."""
    (folder / "images").mkdir(parents=True)
    images, annotations = [], []
    for i in range(count):
        pixels, objects = scene(seed + i)
        cv2.imwrite(str(folder / "images" / f"{i:03d}.png"), pixels[..., ::-1])
        images.append({"id": 100 + i, "file_name": f"{i:03d}.png", "width": 160, "height": 128})
        for kind, (x1, y1, x2, y2) in objects:
            annotations.append(
                {
                    "id": len(annotations),
                    "image_id": 100 + i,
                    "category_id": (3, 7)[kind],
                    "bbox": [x1, y1, x2 - x1, y2 - y1],
                }
            )
    categories = [{"id": 7, "name": "ball"}, {"id": 3, "name": "crate"}]
    content = {"images": images, "categories": categories, "annotations": annotations}
    (folder / "annotations.json").write_text(json.dumps(content))
    return folder


def dataflow_command(*words: str) -> subprocess.CompletedProcess[str]:
    """The command line of training and evaluation, in a process of its own."""
    script = "import sys; from operators.training import commands; getattr(commands, sys.argv.pop(1))()"
    return subprocess.run([sys.executable, "-c", script, *words], capture_output=True, text=True, timeout=100)


def called(command: str, *words: str) -> Result:
    """The same command line in this process, which has imported torch."""
    return CliRunner().invoke(getattr(commands, command), words)


# ---- the first command of a user


@pytest.mark.long
def test_a_users_own_folder_becomes_a_detector_that_finds_their_objects(tmp_path: Path) -> None:
    data, out = write_yolo(tmp_path / "mine", 40), tmp_path / "mine.onnx"
    options = ["--epochs", "24", "--batch", "8", "--size", "128x96", "--width", "0.25", "--threads", "1"]
    options += ["--learning-rate", "0.005", "--evaluate-every", "12", "--json"]
    trained = dataflow_command("train", "detector", str(data), "--out", str(out), *options)
    assert trained.returncode == 0, trained.stderr
    told = json.loads(trained.stdout)
    assert told["scores"]["ap50"] > 0.5
    assert told["refiner"]["epochs"] == 8
    assert open_second(open_network(out, "detector"), "refiner") is not None
    assert sorted(file.name for file in tmp_path.glob("mine.*")) == ["mine.onnx", "mine.pt", "mine.refiner.pt"]

    unseen = write_coco(tmp_path / "unseen", 30, seed=1000)
    scored = dataflow_command("evaluate", "detector", str(unseen), "--weights", str(out), "--all", "--json")
    assert scored.returncode == 0, scored.stderr
    assert json.loads(scored.stdout)["ap50"] > 0.5

    detector, again = CustomDetector(weights=str(out)), CustomDetector(weights=str(out))
    detector.setup()
    again.setup()
    near = total = 0
    for seed in range(2000, 2010):
        pixels, objects = scene(seed)
        large = np.ascontiguousarray(np.kron(pixels, np.ones((3, 3, 1), np.uint8)))
        image = Image(stamp=seed, frame="camera", data=large)
        found = detector.process(image)
        assert found.digest() == again.process(image).digest()
        assert (found.stamp, found.frame, found.width, found.height) == (seed, "camera", 480, 384)
        assert found.class_names == ("crate", "ball")
        for kind, box in objects:
            total += 1
            same = found.boxes[found.class_ids == kind]
            near += bool((intersection_over_union(np.array(box, np.float32) * 3, same) > 0.5).any())
    assert near / total > 0.6  # boxes in the pixels of the larger image


@pytest.mark.long
def test_the_terminal_shows_the_score_and_how_to_use_the_file(tmp_path: Path) -> None:
    data, out = write_coco(tmp_path / "mine", 6), tmp_path / "mine.onnx"
    options = f"--epochs 1 --batch 4 --size 64x64 --width 0.25 --refiner-epochs 1 --out {out}".split()
    first = called("train", "detector", str(data), *options)
    assert first.exit_code == 0, first.stderr
    assert "CustomDetector" in first.stdout
    assert "6 images" not in first.stderr  # one was set aside, and it says so
    assert "set aside" in first.stderr
    second = called("train", "detector", str(data), *options)
    assert second.exit_code == 2
    assert "exist already" in second.stderr
    assert "--resume" in second.stderr


@pytest.mark.long
def test_a_network_is_scored_on_the_images_that_its_own_training_set_aside(tmp_path: Path) -> None:
    file, _ = exported(tmp_path, 2, {"classes": ["crate [old]", "[ball]"], "seed": 5})
    data = write_yolo(tmp_path / "mine", 9)
    (data / "data.yaml").write_text("names: ['crate [old]', '[ball]']\n")
    scored = called("evaluate", "detector", str(data), "--weights", str(file))
    assert scored.exit_code == 0, scored.stderr
    assert "1 of 9 were set aside by seed 5" in scored.stderr
    assert "network.onnx: 1 validation images of 9" in scored.stdout
    assert "[old]" in scored.stdout or "[ball]" in scored.stdout
    other = called("evaluate", "detector", str(data), "--weights", str(file), "--seed", "3")
    assert "1 of 9 were set aside by seed 3" in other.stderr


def test_an_error_keeps_its_square_brackets(tmp_path: Path) -> None:
    missing = tmp_path / "v[old]"
    failed = called("train", "detector", str(missing), "--out", str(tmp_path / "a.onnx"))
    assert failed.exit_code == 2
    assert f"error: no data folder {str(missing)!r}" in failed.stderr


def test_classes_can_be_chosen_and_a_wrong_one_is_named(tmp_path: Path) -> None:
    data = read_detection_data(write_coco(tmp_path / "mine", 12))
    assert data.classes == ("crate", "ball")
    only = data.only(["ball"])
    wanted = sum((image.classes == 1).sum() for image in data.training)
    assert sum(len(image.classes) for image in only.training) == wanted > 0
    with pytest.raises(DataError, match=r"no class 'bal'; their classes: crate, ball"):
        data.only(["bal"])


# ---- reading folders


def test_coco_and_yolo_say_the_same(tmp_path: Path) -> None:
    coco = read_detection_data(write_coco(tmp_path / "coco", 9))
    yolo = read_detection_data(write_yolo(tmp_path / "yolo", 9))
    assert coco.classes == yolo.classes
    assert len(coco.validation) == len(yolo.validation) == 1
    for a, b in zip((*coco.training, *coco.validation), (*yolo.training, *yolo.validation), strict=True):
        assert a.file.name == b.file.name
        assert a.classes.tolist() == b.classes.tolist()
        np.testing.assert_allclose(a.boxes, b.boxes, atol=1e-6)


def test_named_validation_images_are_kept_apart(tmp_path: Path) -> None:
    for split, count in (("train", 4), ("val", 2)):
        write_yolo(tmp_path / split, count)
    (tmp_path / "data.yaml").write_text("names: {0: crate, 1: ball}\ntrain: train/images\nval: val/images\n")
    data = read_detection_data(tmp_path)
    assert (len(data.training), len(data.validation)) == (4, 2)
    assert {f.file.parent.parent.name for f in data.validation} == {"val"}
    assert all(len(image.boxes) for image in data.validation)


def test_polygons_become_their_bounding_boxes(tmp_path: Path) -> None:
    write_yolo(tmp_path, 2)
    (tmp_path / "labels" / "000.txt").write_text("1 0.1 0.2 0.5 0.3 0.4 0.9")
    images = {i.file.stem: i for i in (lambda d: (*d.training, *d.validation))(read_detection_data(tmp_path))}
    np.testing.assert_allclose(images["000"].boxes, [[0.1, 0.2, 0.5, 0.9]], atol=1e-6)


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ("0 0.5 0.5 0.1", r"002\.txt:2: .*has 4 numbers; a row is `class cx cy w h`"),
        ("2 0.5 0.5 0.1 0.1", r"002\.txt:2: .*class 2 is not one of the 2 classes"),
        ("0 0.5 0.5 -0.1 0.1", r"002\.txt:2: .*must be positive"),
        ("0 50 50 10 10", r"002\.txt:2: .*lie in \[0, 1\]"),
        ("crate 0.5 0.5 0.1 0.1", r"002\.txt:2: .*not a row of numbers"),
        ("0 0.5 nan 0.1 0.1", r"002\.txt:2: .*lie in \[0, 1\]"),
        ("0 0.5 0.5 nan 0.6 0.7 0.7", r"002\.txt:2: .*lie in \[0, 1\]"),
        ("inf 0.5 0.5 0.1 0.1", r"002\.txt:2: .*class inf is not one of the 2 classes"),
        ("nan 0.5 0.5 0.1 0.1", r"002\.txt:2: .*class nan is not one of the 2 classes"),
        ("0.5 0.5 0.5 0.1 0.1", r"002\.txt:2: .*class 0.5 is not one of the 2 classes"),
    ],
)
def test_a_bad_yolo_row_is_named_with_file_and_line(tmp_path: Path, row: str, fault: str) -> None:
    write_yolo(tmp_path, 3)
    (tmp_path / "labels" / "002.txt").write_text(f"0 0.5 0.5 0.1 0.1\n{row}\n")
    with pytest.raises(DataError, match=fault):
        read_detection_data(tmp_path)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda c: c["annotations"][1].update(bbox=[1, 2, 3]), r"annotations\[1\] \(id 1\): bbox is \[1, 2, 3\]"),
        (lambda c: c["annotations"][1].update(bbox=[1, 2, -1, 3]), r"annotations\[1\] .*has no area"),
        (lambda c: c["annotations"][1].update(bbox=[150, 2, 50, 3]), r"reaches over the image of 160x128"),
        (lambda c: c["annotations"][1].update(image_id=1), r"image_id 1 is not among the images"),
        (lambda c: c["annotations"][1].update(category_id=9), r"category_id 9 is not among the categories \[3, 7\]"),
        (lambda c: c["images"][0].update(file_name="x.png"), r"no image 'x\.png' \(looked in "),
        (lambda c: c["images"][0].pop("width"), r"images\[0\] needs `id`, `file_name`, `width` and `height`"),
        (lambda c: c.pop("images"), r"has no list 'images'"),
        (lambda c: c["images"].insert(0, None), r"annotations\.json: images\[0\] is None; it should be an object"),
        (lambda c: c["annotations"].insert(1, None), r"annotations\.json: annotations\[1\] is None"),
        (lambda c: c["annotations"][0].update(image_id=[1]), r"annotations\[0\] .*image_id \[1\] is not among"),
        (lambda c: c["annotations"][0].update(category_id="ball"), r"category_id 'ball' is not among"),
        (lambda c: c["annotations"][0].update(bbox=[math.nan, 1, 2, 3]), r"annotations\[0\] .*bbox is \[nan, 1,"),
        (lambda c: c["categories"][0].update(id="a"), r"annotations\.json: categories\[0\] .*an `id` \(an integer\)"),
    ],
)
def test_a_bad_coco_entry_is_named(tmp_path: Path, change, fault: str) -> None:
    file = write_coco(tmp_path, 3) / "annotations.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    with pytest.raises(DataError, match=fault):
        read_detection_data(tmp_path)


def test_boxes_without_width_or_height_are_left_out_and_counted(tmp_path: Path) -> None:
    file = write_coco(tmp_path, 3) / "annotations.json"
    before = read_detection_data(tmp_path)
    content = json.loads(file.read_text())
    flat = content["annotations"][0] | {"id": 918, "bbox": [29.5, 88.0, 1.0, 0.0]}
    file.write_text(json.dumps(content | {"annotations": [*content["annotations"], flat]}))

    data = read_detection_data(tmp_path)

    assert [len(image.boxes) for image in data.training] == [len(image.boxes) for image in before.training]
    assert data.notes[0] == "annotations.json: 1 boxes without width or height left out (id 918)"


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        ("names: crate", r"data\.yaml: `names` is 'crate'; it should be a list, such as \[crate\]"),
        ("names: {a: crate, b: ball}", r"data\.yaml: `names` must be numbered 0 to 1, got \['a', 'b'\]"),
        ("names: {0: crate, 2: ball}", r"data\.yaml: `names` must be numbered 0 to 1, got \[0, 2\]"),
        ("nc: 3\nnames: [crate, ball]", r"data\.yaml: `nc` is 3, but `names` has 2"),
        ("names:", r"data\.yaml names no class"),
        ("names: [crate, crate]", r"data\.yaml names the class 'crate' twice"),
    ],
)
def test_bad_class_names_are_named_with_their_file(tmp_path: Path, settings: str, fault: str) -> None:
    (write_yolo(tmp_path, 2) / "data.yaml").write_text(settings)
    with pytest.raises(DataError, match=fault):
        read_detection_data(tmp_path)


@pytest.mark.parametrize("name", ["labels/001.txt", "data.yaml"])
def test_text_that_is_not_utf8_is_named_with_its_line(tmp_path: Path, name: str) -> None:
    file = write_yolo(tmp_path, 2) / name
    file.write_bytes(file.read_bytes() + b"\n\xff")
    line = file.read_bytes().count(b"\n") + 1
    with pytest.raises(DataError, match=rf"{name}:{line}: byte 0xff is not UTF-8"):
        read_detection_data(tmp_path)


def test_images_named_for_both_are_trained_and_scored_on(tmp_path: Path) -> None:
    (write_yolo(tmp_path, 4) / "data.yaml").write_text("names: [crate, ball]\ntrain: images\nval: images\n")
    data = read_detection_data(tmp_path)
    assert len(data.training) == 4
    assert data.training == data.validation
    (note,) = data.notes
    assert "data.yaml names the images to train on for validation too" in note


def test_images_without_labels_and_labels_without_images_are_counted(tmp_path: Path) -> None:
    write_yolo(tmp_path, 9)
    (tmp_path / "labels" / "classes.txt").write_text("crate\nball\n")
    assert not any("label" in note for note in read_yolo(tmp_path).notes)
    for i in (2, 3):
        (tmp_path / "labels" / f"00{i}.txt").unlink()
        (tmp_path / "images" / f"00{i + 3}.png").unlink()
    bare, orphans = read_yolo(tmp_path).notes
    assert bare.startswith("2 images have no label file")
    assert bare.endswith("images/002.png")
    assert orphans.startswith("2 label files have no image")
    assert orphans.endswith("labels/005.txt")


def test_an_image_that_a_list_names_must_be_there(tmp_path: Path) -> None:
    (write_yolo(tmp_path, 2) / "data.yaml").write_text("names: [crate, ball]\ntrain: list.txt\n")
    (tmp_path / "list.txt").write_text("images/000.png\nimages/009.png\n")
    with pytest.raises(DataError, match=r"list\.txt:2: no image 'images/009\.png'"):
        read_detection_data(tmp_path)


def test_broken_json_is_named_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "annotations.json").write_text('{"images": [],\n "categories": [}')
    with pytest.raises(DataError, match=r"annotations\.json:2: not valid JSON"):
        read_detection_data(tmp_path)


def test_folder_of_neither_format_is_refused_with_the_expected_formats(tmp_path: Path) -> None:
    (tmp_path / "photo.txt").write_text("")
    with pytest.raises(DataError, match=r"neither COCO .* nor YOLO .*it holds photo\.txt"):
        read_detection_data(tmp_path)
    with pytest.raises(FileNotFoundError, match="looked for"):
        read_detection_data(tmp_path / "none")


@pytest.mark.data
def test_a_folder_of_real_photographs_is_read(data_dir: Path) -> None:
    data = read_detection_data(data_dir / "coco128")
    assert len(data.training) + len(data.validation) == 128
    assert len(data.classes) == 80
    assert any("images/ is used" in note for note in data.notes)
    objects = sum(len(image.boxes) for image in (*data.training, *data.validation))
    images = {file.stem for file in (data_dir / "coco128" / "images").iterdir()}
    labels = [file for file in (data_dir / "coco128" / "labels").iterdir() if file.stem in images]
    assert objects == sum(len(file.read_text().splitlines()) for file in labels) > 900


# ---- anchors


def test_anchors_are_the_sizes_where_there_are_few() -> None:
    sizes = np.array([[10, 20]] * 5 + [[40, 30]] * 3, np.float32)
    assert fit_anchors(sizes, 2, seed=0).tolist() == [[10, 20], [40, 30]]
    more = fit_anchors(sizes, 9, seed=0)
    assert more.shape == (9, 2)
    assert (np.diff(more.prod(axis=1)) >= 0).all()
    assert mean_best_iou(sizes, more) == pytest.approx(1)


def test_fitted_anchors_cover_better_than_a_grid_of_guesses() -> None:
    rng = np.random.default_rng(3)
    sizes = np.exp(rng.normal([2.5, 3.2], 0.5, (400, 2))).astype(np.float32)
    guesses = np.array([[s * a, s / a] for s in (8, 24, 64) for a in (0.7, 1, 1.4)], np.float32)
    assert mean_best_iou(sizes, fit_anchors(sizes, 9, seed=1)) > mean_best_iou(sizes, guesses) + 0.05
    assert size_iou(np.array([[4, 4]], np.float32), np.array([[2, 8]], np.float32))[0, 0] == pytest.approx(8 / 24)


# ---- decoding


def encoded(
    box: list[float], label: int, level: int, anchor: int, anchors: np.ndarray, classes: int
) -> list[np.ndarray]:
    """Maps in which one cell says exactly this box; found by inverting the definition."""
    maps = [np.full((1, 3 * (5 + classes), 128 // s, 160 // s), -20, np.float32) for s in STRIDES]
    stride = STRIDES[level]
    center, size = (
        np.array([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]),
        np.array([box[2] - box[0], box[3] - box[1]]),
    )
    column, row = (center // stride).astype(int)
    share = np.concatenate([(center / stride - [column, row] + 0.5) / 2, np.sqrt(size / anchors[level, anchor]) / 2])
    rows = maps[level].reshape(3, 5 + classes, 128 // stride, 160 // stride)
    rows[anchor, :4, row, column] = np.log(share / (1 - share))
    rows[anchor, 4, row, column] = 3
    rows[anchor, 5 + label, row, column] = 2
    return maps


ANCHORS = np.array(
    [[[10, 10], [14, 20], [20, 14]], [[30, 30], [40, 60], [60, 40]], [[80, 80], [90, 60], [120, 100]]], np.float32
)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2), st.integers(0, 2), st.integers(0, 4), st.integers(0, 10_000))
def test_an_encoded_box_is_decoded(level: int, anchor: int, label: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = ANCHORS[level, anchor] * rng.uniform(0.4, 1.6, 2)
    corner = rng.uniform(0, np.array([160, 128]) - np.minimum(size, [159, 127]))
    box = [*corner, *np.minimum(corner + size, [160, 128])]
    maps = encoded(box, label, level, anchor, ANCHORS, 5)
    found = decode_grid(maps, ANCHORS, STRIDES, 5, 0.5)
    np.testing.assert_allclose(found.boxes, [box], atol=1e-3)
    assert found.classes.tolist() == [label]
    np.testing.assert_allclose(found.scores, [1 / (1 + np.exp(-3)) / (1 + np.exp(-2))], rtol=1e-5)


@pytest.mark.parametrize("threshold", [0.0, 0.01, 0.3, 0.6])
def test_training_and_operator_decode_the_output_alike(threshold: float) -> None:
    """The loss and the operator read the network's output alike: two implementations, random maps."""
    rng = np.random.default_rng(0)
    maps = [rng.normal(0, 2, (1, 3 * 9, 128 // s, 160 // s)).astype(np.float32) for s in STRIDES]
    found = decode_grid(maps, ANCHORS, STRIDES, 4, threshold)
    boxes, scores = [], []
    for box, raw in decode_maps([torch.from_numpy(m) for m in maps], torch.from_numpy(ANCHORS), STRIDES, 4):
        probability = raw.sigmoid()
        score = probability[..., 0] * probability[..., 1:].amax(dim=-1)
        keep = score >= threshold
        boxes.append(box[keep].numpy())
        scores.append(score[keep].numpy())
    theirs = np.concatenate(scores)
    near = np.abs(np.concatenate([theirs, found.scores]) - threshold).min() < 1e-6
    assert near or len(theirs) == len(found.scores)
    np.testing.assert_allclose(np.sort(found.scores), np.sort(theirs), atol=1e-6)
    np.testing.assert_allclose(
        found.boxes[np.argsort(found.scores)], np.concatenate(boxes)[np.argsort(theirs)], rtol=1e-4, atol=1e-3
    )


def test_suppression_is_within_a_class() -> None:
    one, other = (encoded([20, 20, 50, 50], label, 1, 0, ANCHORS, 2) for label in (0, 1))
    twin = encoded([21, 20, 51, 50], 0, 1, 1, ANCHORS, 2)
    same = [np.maximum(a, b) for a, b in zip(one, twin, strict=True)]
    assert len(find_boxes(same, ANCHORS, STRIDES, 2, 0.3, 0.5, 10).scores) == 1
    both = encoded([20, 20, 50, 50], 1, 1, 2, ANCHORS, 2)
    mixed = [np.maximum(a, b) for a, b in zip(one, both, strict=True)]
    assert sorted(find_boxes(mixed, ANCHORS, STRIDES, 2, 0.3, 0.5, 10).classes.tolist()) == [0, 1]
    assert len(find_boxes(other, ANCHORS, STRIDES, 2, 0.9, 0.5, 10).scores) == 0


def test_a_map_of_another_shape_is_refused_with_the_right_one() -> None:
    with pytest.raises(ValueError, match=r"has shape \(1, 3 \* \(5 \+ 4\), H, W\), got \(1, 24, 16, 20\)"):
        decode_grid([np.zeros((1, 24, 128 // s, 160 // s), np.float32) for s in STRIDES], ANCHORS, STRIDES, 4, 0.5)


# ---- the loss


def truth_of(*rows: tuple[int, int, list[float], bool]) -> Truth:
    return Truth(
        torch.tensor([r[0] for r in rows], dtype=torch.int64),
        torch.tensor([r[1] for r in rows], dtype=torch.int64),
        torch.tensor([r[2] for r in rows], dtype=torch.float32).reshape(-1, 4),
        torch.tensor([r[3] for r in rows], dtype=torch.bool),
    )


def test_every_object_is_answered_for_by_a_cell_at_its_centre() -> None:
    rng = np.random.default_rng(1)
    rows = []
    for k in range(60):
        size = rng.uniform(2, [160, 128])
        corner = rng.uniform(0, [160, 128] - size)
        rows.append((k % 4, 0, [*corner, *(corner + size)], False))
    rows.append((0, 0, [5.0, 5.0, 5.5, 100.0], False))  # unlike every anchor
    truth = truth_of(*rows, (0, 0, [10, 10, 60, 60], True))
    found = assign(truth, torch.from_numpy(ANCHORS), STRIDES, [(128 // s, 160 // s) for s in STRIDES])
    answered = torch.cat([cells.target for cells in found]).unique().tolist()
    assert answered == list(range(61))  # all but the ignored one
    for cells, stride in zip(found, STRIDES, strict=True):
        center = (truth.boxes[cells.target, :2] + truth.boxes[cells.target, 2:]) / 2 / stride
        offset = center - torch.stack([cells.column, cells.row], dim=1)
        assert (offset >= -0.5 - 1e-4).all()  # what 2σ - 0.5 can reach
        assert (offset <= 1.5 + 1e-4).all()


def test_complete_iou_is_one_for_equal_boxes_and_falls_with_distance() -> None:
    box = torch.tensor([[10.0, 10, 30, 20]])
    assert complete_iou(box, box).item() == pytest.approx(1)
    near, far = (complete_iou(box, box + shift).item() for shift in (40.0, 90.0))
    assert 0 > near > far  # a gradient where nothing overlaps
    taller = torch.tensor([[15.0, 5, 25, 25]])
    assert complete_iou(box, taller).item() < 1 / 3  # IoU alone


def test_the_right_answer_costs_least_and_ignored_objects_nothing() -> None:
    box, anchors = [40.0, 30.0, 70.0, 62.0], torch.from_numpy(ANCHORS)
    maps = [torch.from_numpy(m) for m in encoded(box, 1, 1, 0, ANCHORS, 2)]

    def cost(truth: Truth) -> float:
        return float(sum(detection_loss(maps, truth, anchors, STRIDES, 2).values()))

    right, elsewhere, other_class = (
        cost(truth_of((0, label, b, False))) for label, b in ((1, box), (1, [100.0, 80.0, 130.0, 112.0]), (0, box))
    )
    assert right < elsewhere
    assert right < other_class
    nothing = cost(truth_of())
    ignored = cost(truth_of((0, 1, [30.0, 20.0, 90.0, 80.0], True)))
    assert ignored < 1e-4 < nothing  # finding it where nothing is costs; where something ignored is, it does not


@pytest.mark.long
def test_training_steps_lower_the_loss_and_do_not_depend_on_the_order_of_objects() -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    network, anchors = GridDetector(2, width=0.25, channels=32), torch.from_numpy(ANCHORS)
    images = torch.rand(2, 3, 64, 64)
    rows = [(0, 0, [4.0, 10, 24, 40], False), (1, 1, [10.0, 8, 60, 60], False), (0, 1, [5.0, 11, 25, 42], False)]
    maps = network(images)
    one, other = (detection_loss(maps, truth_of(*r), anchors, STRIDES, 2) for r in (rows, rows[::-1]))
    for name in one:
        assert one[name].item() == pytest.approx(other[name].item(), rel=1e-5)
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    costs = []
    for _ in range(30):
        cost = torch.stack(list(detection_loss(network(images), truth_of(*rows), anchors, STRIDES, 2).values())).sum()
        optimizer.zero_grad()
        cost.backward()
        optimizer.step()
        costs.append(cost.item())
    assert costs[-1] < 0.8 * costs[0]


# ---- augmentation


@pytest.mark.parametrize("seed", range(8))
def test_boxes_follow_the_pixels_through_every_variation(tmp_path: Path, seed: int) -> None:
    """The object's colour is found again in the varied image: that is where the box must be."""
    pixels = np.full((120, 200, 3), 128, np.uint8)
    pixels[40:70, 90:140] = (255, 0, 0)
    file = tmp_path / "one.png"
    cv2.imwrite(str(file), pixels[..., ::-1])
    image = labelled(file, [[90 / 200, 40 / 120, 140 / 200, 70 / 120]], [0])
    seen = view(image, (160, 128), Variation(color=0, noise=0, blur=0), np.random.default_rng(seed))
    rows, columns = np.nonzero((seen.pixels[..., 0] > 190) & (seen.pixels[..., 1] < 65))
    around = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    np.testing.assert_allclose(seen.boxes[0], around, atol=1.01)


def test_training_without_variation_sees_the_operators_input(tmp_path: Path) -> None:
    from operators.image.letterbox import ImageFit

    for size, target in (((640, 480), (320, 240)), ((200, 120), (160, 128)), ((100, 160), (160, 128))):
        pixels = cv2.resize(np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8), size)
        mine = warp(pixels, fitted(size, target), target).astype(int)
        theirs = ImageFit.plan("letterbox", size, target).apply(pixels).astype(int)
        different = np.abs(mine - theirs).max(axis=2) > 3
        assert different.mean() < 0.03  # the seam between image and border, where warping blends


def test_an_object_cut_off_by_the_view_is_ignored_and_one_out_of_sight_is_gone(tmp_path: Path) -> None:
    file = tmp_path / "one.png"
    cv2.imwrite(str(file), np.zeros((128, 160, 3), np.uint8))
    image = labelled(file, [[0.0, 0.4, 0.1, 0.6], [0.4, 0.4, 0.6, 0.6]], [0, 1])
    shifts = [view(image, (160, 128), Variation(shift=0.4), np.random.default_rng(k)) for k in range(60)]
    assert {len(v.boxes) for v in shifts} == {1, 2}
    assert any(v.ignored.any() for v in shifts)
    whole = view(image, (160, 128), NONE, np.random.default_rng(0))
    np.testing.assert_allclose(whole.boxes, image.boxes * [160, 128, 160, 128], atol=1e-4)


# ---- the score


def boxes_of(*rows: list[float]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, 4)


def scored(found: np.ndarray, scores: list[float], *, ignored: bool = False) -> float:
    truth = boxes_of([10, 10, 30, 30], [50, 50, 90, 90])
    image = ScoredImage(
        truth,
        np.zeros(2, np.int32),
        np.array([False, ignored]),
        Candidates(found, np.array(scores, np.float32), np.zeros(len(scores), np.int32)),
    )
    return score_detections([image], ["thing"]).ap50


def test_the_score_is_the_known_one_in_cases_done_by_hand() -> None:
    both = boxes_of([10, 10, 30, 30], [50, 50, 90, 90])
    assert scored(both, [0.9, 0.8]) == pytest.approx(1)
    assert scored(both[:1], [0.9]) == pytest.approx(51 / 101)  # half of the recall, at 101 points
    assert scored(np.concatenate([both[:1] + 200, both]), [0.95, 0.9, 0.8]) == pytest.approx(2 / 3, abs=0.01)
    assert scored(boxes_of(), []) == 0


def test_every_labelled_class_is_scored_where_nothing_is_found() -> None:
    nothing = Candidates(boxes_of(), np.zeros(0, np.float32), np.zeros(0, np.int32))
    truth = boxes_of([10, 10, 30, 30], [50, 50, 90, 90], [20, 50, 40, 90])
    labels, ignored = np.array([0, 2, 3], np.int32), np.array([False, False, True])
    score = score_detections([ScoredImage(truth, labels, ignored, nothing)], ["crate", "ball", "cup", "lamp"])
    assert score.per_class == {"crate": 0, "cup": 0}


def test_an_ignored_object_is_neither_missed_nor_wrong_to_find() -> None:
    both = boxes_of([50, 50, 90, 90], [10, 10, 30, 30])
    assert scored(both[1:], [0.9], ignored=True) == pytest.approx(1)
    assert scored(both, [0.95, 0.9], ignored=True) == pytest.approx(1)
    inside = boxes_of([60, 60, 70, 70], [10, 10, 30, 30])  # in the ignored one, but not it
    assert scored(inside, [0.95, 0.9], ignored=True) == pytest.approx(0.5)


# ---- the network file


def exported(tmp_path: Path, classes: int = 3, more: dict[str, object] | None = None) -> tuple[Path, GridDetector]:
    from operators.learning.export import export_network

    torch.manual_seed(0)
    network = GridDetector(classes, width=0.25, channels=32).eval()
    facts = {
        "kind": "detector",
        "classes": [f"thing {k}" for k in range(classes)],
        "width": 160,
        "height": 128,
        "anchors": ANCHORS.tolist(),
        "strides": list(STRIDES),
        **(more or {}),
    }
    file = tmp_path / "network.onnx"
    export_network(network, (160, 128), ["a", "b", "c"], facts, file)
    return file, network


def test_exported_file_agrees_with_the_trained_network(tmp_path: Path) -> None:
    file, network = exported(tmp_path)
    pixels = scene(4)[0]
    with torch.inference_mode():
        theirs = network(torch.from_numpy(tensor_of(pixels))[None])
    for a, b in zip(open_network(file, "detector").run(pixels), theirs, strict=True):
        assert np.abs(a - b.numpy()).max() < 2e-3 * max(1.0, float(b.abs().max()))  # half-precision storage
    parameters = sum(p.numel() for p in network.parameters())
    assert file.stat().st_size < 2.6 * parameters + 40_000


def test_a_file_of_another_kind_or_origin_is_refused_by_name(tmp_path: Path) -> None:
    import onnx

    file, _ = exported(tmp_path)
    for change, fault in (
        ({"kind": "segmenter"}, "is a segmenter; a detector is needed"),
        ({"width": 64}, r"must have one input tensor\(float\) \[1, 3, 128, 64\]"),
        ({"strides": [8, 16]}, "a stride for each level"),
    ):
        changed = with_facts(file, tmp_path / "changed.onnx", **change)
        with pytest.raises(NetworkFileError, match=fault):
            CustomDetector(weights=str(changed)).setup()
    with pytest.raises(NetworkFileError, match=r"activity\.onnx is an activity network; a detector is needed"):
        CustomDetector(weights=str(shipped("activity.onnx"))).setup()
    model = onnx.load(str(file))
    del model.metadata_props[:]
    onnx.save(model, str(tmp_path / "bare.onnx"))
    with pytest.raises(NetworkFileError, match=r"no metadata .*OnnxDetector"):
        CustomDetector(weights=str(tmp_path / "bare.onnx")).setup()
    with pytest.raises(FileNotFoundError, match=r"looked for .*none\.onnx"):
        CustomDetector(weights=str(tmp_path / "none.onnx")).setup()


def test_metadata_that_do_not_fit_the_output_are_named(tmp_path: Path) -> None:
    file, _ = exported(tmp_path)
    with_facts(file, file, classes=["one"])
    detector = CustomDetector(weights=str(file))
    detector.setup()
    with pytest.raises(NetworkFileError, match=r"does not fit its metadata: a map has shape \(1, 3 \* \(5 \+ 1\)"):
        detector.process(Image(stamp=1, frame="camera", data=scene(1)[0]))


def test_grey_images_are_taken_and_the_best_are_kept(tmp_path: Path) -> None:
    file, _ = exported(tmp_path)
    detector = CustomDetector(weights=str(file), score_threshold=0.0, max_detections=5)
    detector.setup()
    grey = Image(stamp=1, frame="camera", data=scene(1)[0][..., 0])
    found = detector.process(grey)
    assert found.count == 5
    assert (np.diff(found.scores) <= 0).all()
    color = detector.process(grey.replace(data=np.repeat(grey.data[..., None], 3, axis=2)))
    assert found.digest() == color.digest()
