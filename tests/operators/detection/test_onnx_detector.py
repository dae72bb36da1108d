"""The detector on models made here, whose answers are known, and FastestDet on real photographs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from made_onnx import node, write_model

from dataflow.messages import Image
from operators.detection import CustomDetector, OnnxDetector
from operators.inference import ModelError, open_content

pytest.importorskip("onnx")


def save_model(file: Path, output: np.ndarray, size: tuple[int | str, int | str] = (64, 64), **metadata: str) -> str:
    """A model whose answer is `output` times the mean of its red channel (input channel 0), so it reads its input."""
    nodes = [
        node("Gather", "x channel", "red", axis=1),
        node("ReduceMean", "red", "mean", keepdims=0),
        node("Mul", "rows mean", "y"),
    ]
    values = {"rows": output.astype(np.float32), "channel": np.array([0])}
    return write_model(file, nodes, {"x": [1, 3, *size]}, {"y": output.shape}, values=values, metadata=metadata)


def yolov8_rows(*rows: tuple[float, ...]) -> np.ndarray:
    return np.array(rows, np.float32).T[None]


def red(width: int = 200, height: int = 100, stamp: int = 7) -> Image:
    data = np.zeros((height, width, 3), np.uint8)
    data[..., 0] = 255
    return Image(stamp=stamp, frame="camera", data=data)


def detector(**params: object) -> OnnxDetector:
    made = OnnxDetector(**params)
    made.setup()
    return made


def names(folder: Path, *classes: str) -> str:
    file = folder / "names.txt"
    file.write_text("\n".join(classes))
    return str(file)


def test_boxes_come_back_in_the_pixels_of_the_image(tmp_path: Path) -> None:
    # The image 200x100 is stretched on 64x64: x by 3.125, y by 1.5625. Two boxes overlap; the weaker one goes.
    rows = yolov8_rows((32, 32, 16, 32, 0.9, 0.1), (33, 32, 16, 32, 0.8, 0.1), (8, 8, 8, 8, 0.1, 0.7))
    options = {"decoder": "yolov8", "fit": "stretch", "classes": names(tmp_path, "person", "bicycle")}
    found = detector(model=save_model(tmp_path / "m.onnx", rows), **options).process(red())
    np.testing.assert_allclose(found.boxes, [[75, 25, 125, 75], [12.5, 6.25, 37.5, 18.75]], atol=1e-4)
    np.testing.assert_allclose(found.scores, [0.9, 0.7], atol=1e-5)
    assert [found.class_names[i] for i in found.class_ids] == ["person", "bicycle"]
    assert (found.stamp, found.frame, found.width, found.height) == (7, "camera", 200, 100)


def test_yolo_letterboxes_by_default(tmp_path: Path) -> None:
    # 200x100 in 64x64: scaled by 0.32, with 16 rows of grey above; grey dims the mean of red to 0.5 + 0.5 * 114/255.
    model = save_model(tmp_path / "m.onnx", yolov8_rows((32, 32, 32, 16, 0.9)) / (0.5 + 0.5 * 114 / 255))
    found = detector(model=model, decoder="yolov8", classes=names(tmp_path, "crate")).process(red())
    np.testing.assert_allclose(found.boxes, [[50, 25, 150, 75]], atol=0.01)


def test_fastestdet_is_given_blue_first(tmp_path: Path) -> None:
    output = np.ones((1, 85, 2, 2))
    model = save_model(tmp_path / "m.onnx", output)
    options = {"model": model, "decoder": "fastestdet"}
    blue = red().replace(data=red().data[..., ::-1])
    assert len(detector(**options).process(blue).scores) > 0
    assert len(detector(**options).process(red()).scores) == 0


def test_only_the_best_are_kept(tmp_path: Path) -> None:
    rows = yolov8_rows(*((8 * i + 4, 32, 6, 6, 0.4 + 0.05 * i) for i in range(8)))
    options = {"decoder": "yolov8", "fit": "stretch", "classes": names(tmp_path, "crate")}
    found = detector(model=save_model(tmp_path / "m.onnx", rows), max_detections=3, **options)
    np.testing.assert_allclose(found.process(red()).scores, [0.75, 0.7, 0.65], atol=1e-5)


def test_class_names_come_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "names.txt").write_text("crate\n\npallet\n")
    model = save_model(tmp_path / "m.onnx", yolov8_rows((32, 32, 16, 32, 0.1, 0.9)))
    options = {"model": model, "decoder": "yolov8", "fit": "stretch"}
    made = detector(**options, classes=str(tmp_path / "names.txt"))
    assert made.process(red()).class_names == ("crate", "pallet")
    assert set(made.files) == {model, str(tmp_path / "names.txt")}  # both content hashes are on record


def test_class_names_may_be_given_as_text(tmp_path: Path) -> None:
    model = save_model(tmp_path / "m.onnx", yolov8_rows((32, 32, 16, 32, 0.1, 0.9)))
    found = detector(model=model, decoder="yolov8", fit="stretch", classes="mug, fire extinguisher").process(red())
    assert found.labels() == ("fire extinguisher",)


@pytest.mark.parametrize("given", [("crate",), ("crate", "pallet", "forklift")])
def test_as_many_class_names_are_needed_as_the_model_has_classes(tmp_path: Path, given: tuple[str, ...]) -> None:
    model = save_model(tmp_path / "m.onnx", yolov8_rows((32, 32, 16, 32, 0.1, 0.9)))
    made = detector(model=model, decoder="yolov8", classes=names(tmp_path, *given))
    with pytest.raises(ModelError, match=rf"m\.onnx separates 2 classes, but there are {len(given)} class names;"):
        made.process(red())


def test_a_network_of_other_classes_than_cocos_is_not_given_their_names(tmp_path: Path) -> None:
    output = np.ones((1, 5 + 3, 2, 2))
    made = detector(model=save_model(tmp_path / "m.onnx", output), decoder="fastestdet")
    with pytest.raises(
        ModelError, match=r"separates 3 classes, .* 80 class names \(those of COCO\); give the model's own in"
    ):
        made.process(red())


def test_an_open_input_takes_the_size_of_the_parameter(tmp_path: Path) -> None:
    model = save_model(tmp_path / "m.onnx", yolov8_rows((16, 16, 8, 8, 0.9)), ("H", "W"))
    options = {"decoder": "yolov8", "fit": "stretch", "classes": names(tmp_path, "crate")}
    found = detector(model=model, input_size=32, **options).process(red())
    np.testing.assert_allclose(found.boxes, [[75, 37.5, 125, 62.5]], atol=1e-4)


def test_grey_images_and_images_without_objects_are_fine(tmp_path: Path) -> None:
    model = save_model(tmp_path / "m.onnx", yolov8_rows((32, 32, 8, 8, 0.9)))
    made = detector(model=model, decoder="yolov8", classes=names(tmp_path, "crate"))
    white = Image(stamp=1, frame="camera", data=np.full((64, 64), 255, np.uint8))
    black = Image(stamp=1, frame="camera", data=np.zeros((64, 64), np.uint8))
    assert made.process(white).boxes.shape == (1, 4)
    assert made.process(black).boxes.shape == (0, 4)


def test_missing_model_error_names_the_searched_path(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=rf"looked for {tmp_path}/none\.onnx"):
        detector(model=str(tmp_path / "none.onnx"), decoder="fastestdet")


def test_a_file_that_is_no_model_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(ModelError, match=r"bad\.onnx cannot be loaded"):
        detector(model=str(tmp_path / "bad.onnx"), decoder="fastestdet")


def test_a_decoder_that_does_not_fit_the_model_is_named(tmp_path: Path) -> None:
    made = detector(model=save_model(tmp_path / "m.onnx", yolov8_rows((1, 1, 1, 1, 0.9))), decoder="fastestdet")
    with pytest.raises(ModelError, match=r"decoder='fastestdet' does not fit .*m\.onnx: .* got \(1, 5, 1\)"):
        made.process(red())


def test_model_name_resolves_to_its_file_and_is_recorded() -> None:
    named, made = detector(model="simulated"), CustomDetector()
    made.setup()
    rng = np.random.default_rng(0)
    image = Image(stamp=1, frame="camera", data=rng.integers(0, 256, (120, 160, 3)).astype(np.uint8))
    assert named.files.keys() == {"simulated", "simulated (row)"}
    assert [named.files["simulated"]] == list(made.files.values())
    assert named.process(image).digest() == made.process(image).digest()
    assert OnnxDetector.trained_in_simulation({"model": "simulated"})
    assert not OnnxDetector.trained_in_simulation({"model": "yolox_nano"})


def test_missing_named_model_error_gives_the_download_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATAFLOW_MODEL_CACHE", str(tmp_path))
    where = rf"looked for {tmp_path}/yolox_nano\.onnx\)"
    with pytest.raises(FileNotFoundError, match=rf"{where}.*dataflow models get yolox_nano"):
        detector(model="yolox_nano")
    (tmp_path / "yolox_nano.onnx").write_bytes(b"another")
    with pytest.raises(ModelError, match="is not the file of yolox_nano: its sha256 is"):
        detector(model="yolox_nano")


def test_a_model_of_another_operator_and_a_file_of_no_row_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ModelError, match=r"OnnxDetector\.decoder must name its family"):
        detector(model=save_model(tmp_path / "m.onnx", yolov8_rows((1, 1, 1, 1, 0.9))))
    monkeypatch.setenv("DATAFLOW_MODEL_CACHE", str(tmp_path))
    save_model(tmp_path / "depth_anything_v2_small.onnx", yolov8_rows((1, 1, 1, 1, 0.9)))
    with pytest.raises(ModelError, match=r"is not the file of depth_anything_v2_small"):
        detector(model="depth_anything_v2_small", decoder="yolov8")


def test_class_names_are_those_of_the_models_metadata(tmp_path: Path) -> None:
    rows = yolov8_rows((32, 32, 16, 32, 0.1, 0.9))
    file = save_model(tmp_path / "m.onnx", rows, names="{0: 'crate', 1: 'pallet'}")
    assert detector(model=file, decoder="yolov8").process(red()).class_names == ("crate", "pallet")


@pytest.mark.data
def test_fastestdet_detects_objects_in_real_photographs(data_dir: Path) -> None:
    """About half of the boxes of this small network overlap a label of their class by more than half."""
    folder = data_dir / "coco128"
    options = {"model": str(data_dir / "models" / "FastestDet.onnx"), "decoder": "fastestdet", "score_threshold": 0.6}
    made, again = detector(**options), detector(**options)
    right = total = 0
    for i, file in enumerate(sorted((folder / "images").iterdir())[:40]):
        image = Image(stamp=i, frame="camera", data=np.asarray(cv2.imread(str(file), cv2.IMREAD_COLOR_RGB), np.uint8))
        found = made.process(image)
        assert found.digest() == again.process(image).digest()
        labels = folder / "labels" / f"{file.stem}.txt"
        truth = np.array(labels.read_text().split() if labels.is_file() else [], np.float64).reshape(-1, 5)
        scale = np.array([image.data.shape[1], image.data.shape[0]] * 2)
        corners = np.hstack([truth[:, 1:3] - truth[:, 3:] / 2, truth[:, 1:3] + truth[:, 3:] / 2]) * scale
        for box, label in zip(found.boxes, found.class_ids, strict=True):
            same = corners[truth[:, 0] == label]
            inner = np.clip(np.minimum(box[2:], same[:, 2:]) - np.maximum(box[:2], same[:, :2]), 0, None).prod(axis=1)
            union = (box[2:] - box[:2]).prod() + (same[:, 2:] - same[:, :2]).prod(axis=1) - inner
            total += 1
            right += bool((inner / union > 0.5).any())
    assert total >= 20
    assert right / total > 0.45


def save_convolution(file: Path, side: int, *, fixed: bool) -> str:
    """A network of one convolution, exported for images of one side: the share of red in each 8x8 pixels is objectness
    and score of its cell. One that is `fixed` reshapes to the cells of that side."""
    cells = side // 8
    weights = np.zeros((6, 3, 8, 8), np.float32)
    weights[[0, 5], 2] = 1 / 64  # BGR in [0, 1]
    values = {"weights": weights, "shape": np.array([1, 6, cells, cells] if fixed else [0, 0, 0, -1])}
    nodes = [node("Conv", "x weights", "grid", kernel_shape=[8, 8], strides=[8, 8]), node("Reshape", "grid shape", "y")]
    shapes = {"x": [1, 3, side, side]}, {"y": [1, 6, cells, cells]}
    return write_model(file, nodes, *shapes, values=values, inner={"grid": shapes[1]["y"]})


def test_a_network_of_convolutions_takes_a_larger_input_than_it_was_exported_for(tmp_path: Path) -> None:
    data = np.zeros((64, 64, 3), np.uint8)
    data[16:24, 40:48, 0] = 255  # a cell of the input at 64, a quarter of one at 32
    image = Image(stamp=1, frame="camera", data=data)
    model = save_convolution(tmp_path / "m.onnx", 32, fixed=False)
    options = {"model": model, "decoder": "fastestdet", "classes": names(tmp_path, "mug"), "score_threshold": 0.2}
    as_exported, larger = detector(**options), detector(**options, input_size=64)
    np.testing.assert_allclose(as_exported.process(image).scores, [0.25], atol=1e-5)
    found = larger.process(image)
    np.testing.assert_allclose(found.scores, [1.0], atol=1e-5)
    np.testing.assert_allclose(found.boxes, [[24, 0, 56, 32]], atol=1e-3)  # around the corner of cell (5, 2)


def test_an_opened_input_holds_one_row_of_cells_of_padding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shapes: list[tuple[int, ...]] = []

    class Session:
        def __init__(self, content: bytes, *told: str) -> None:
            self._session = open_content(content, *told)
            self.get_inputs, self.get_outputs = self._session.get_inputs, self._session.get_outputs
            self.get_modelmeta = self._session.get_modelmeta

        def run(self, wanted: list[str] | None, given: dict[str, np.ndarray]) -> list[np.ndarray]:
            shapes.extend(each.shape for each in given.values())
            return list(self._session.run(wanted, given))

    monkeypatch.setattr("operators.detection.exported.open_content", Session)
    data = np.zeros((32, 128, 3), np.uint8)
    data[16:24, 40:48, 0] = 255
    options = {"decoder": "fastestdet", "classes": names(tmp_path, "mug"), "score_threshold": 0.5}
    model = save_convolution(tmp_path / "m.onnx", 32, fixed=False)
    found = detector(model=model, **options, fit="corner", input_size=128).process(Image(stamp=1, frame="c", data=data))
    assert shapes[-1] == (1, 3, 64, 128)  # and not 128 lines, 64 of them only padding
    np.testing.assert_allclose(found.boxes, [[8, 0, 72, 32]], atol=1e-3)  # half as large as the input, around its cell


def test_an_input_size_that_a_network_cannot_take_is_refused(tmp_path: Path) -> None:
    model = save_convolution(tmp_path / "m.onnx", 32, fixed=True)
    with pytest.raises(ModelError, match=r"exported for images of 32x32 and takes none of 64x64.*input_size"):
        detector(model=model, decoder="fastestdet", classes=names(tmp_path, "mug"), input_size=64)
