"""Decoders against what the networks' authors do with the same outputs, written here in torch as they publish it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from made_onnx import node, write_model

from dataflow.messages import Detections2D, Image
from operators.detection import OnnxDetector

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch")
    torchvision = pytest.importorskip("torchvision")

onnx = pytest.importorskip("onnx")

SIDE = 64
WIDTH, HEIGHT = 150, 90  # of the image
IMAGE = Image(
    stamp=3, frame="camera", data=np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
)
KINDS = {"float32": "FLOAT", "float16": "FLOAT16", "int64": "INT64", "int32": "INT32", "uint8": "UINT8"}


def model_that_answers(
    file: Path,
    outputs: dict[str, np.ndarray],
    *,
    sized: str | None = None,
    sized_as: str = "int64",
    sized_first: bool = False,
    kind: str = "float32",
    size: tuple[int, int] = (SIDE, SIDE),
) -> str:
    """A model that gives these values whatever it sees; that named `sized` times its second input, (w, h)."""
    inputs: dict[str, Any] = {"images": (KINDS[kind], [1, 3, *size[::-1]])}
    if sized:
        inputs["orig_target_sizes"] = (KINDS[sized_as], [1, 2])
    if sized_first:
        inputs = dict(reversed(inputs.items()))
    nodes = [node("Identity", f"{name}_values", name) for name in outputs if name != sized]
    if sized:
        to = getattr(onnx.TensorProto, KINDS[outputs[sized].dtype.name])
        nodes += [
            node("Concat", "orig_target_sizes orig_target_sizes", "whole", axis=1),
            node("Cast", "whole", "scale", to=to),
            node("Mul", f"{sized}_values scale", sized),
        ]
    made = {name: (KINDS[value.dtype.name], value.shape) for name, value in outputs.items()}
    return write_model(file, nodes, inputs, made, values={f"{n}_values": value for n, value in outputs.items()})


def found_by(model: str, decoder: str, names: Sequence[str], folder: Path, **params: Any) -> Detections2D:
    (folder / "names.txt").write_text("\n".join(names))
    made = OnnxDetector(model=model, decoder=decoder, classes=str(folder / "names.txt"), **params)
    made.setup()
    return made.process(IMAGE)


def assert_same(found: Detections2D, boxes: Any, scores: Any, labels: Any) -> None:
    """Both by falling score; scores of the made outputs are all different."""
    order = np.argsort(-np.asarray(scores), kind="stable")
    limit = np.array([WIDTH, HEIGHT, WIDTH, HEIGHT])
    np.testing.assert_allclose(found.boxes, np.clip(np.asarray(boxes)[order], 0, limit), atol=2e-3)
    np.testing.assert_allclose(found.scores, np.asarray(scores)[order], atol=1e-5)
    assert found.class_ids.tolist() == np.asarray(labels)[order].tolist()
    assert found.count >= 3


@pytest.mark.long
def test_yolox_as_its_postprocess_in_torch(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    cells = sum((SIDE // stride) ** 2 for stride in (8, 16, 32))
    output = np.hstack([rng.normal(0.5, 0.5, (cells, 4)), rng.random((cells, 4))]).astype(np.float32)[None]
    model = model_that_answers(tmp_path / "m.onnx", {"output": output})
    found = found_by(model, "yolox", "abc", tmp_path, score_threshold=0.25)

    rows, ratio = torch.from_numpy(output[0]), min(SIDE / WIDTH, SIDE / HEIGHT)
    grids, strides = [], []
    for stride in (8, 16, 32):  # `YOLOXHead.decode_outputs`
        side = SIDE // stride
        y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
        grids.append(torch.stack((x, y), 2).view(-1, 2))
        strides.append(torch.full((side * side, 1), stride))
    grid, step = torch.cat(grids), torch.cat(strides)
    center, size = (rows[:, :2] + grid) * step, torch.exp(rows[:, 2:4]) * step
    corners = torch.cat([center - size / 2, center + size / 2], 1)
    best, labels = rows[:, 5:].max(1)  # `postprocess`
    scores = rows[:, 4] * best
    strong = scores >= 0.25
    corners, scores, labels = corners[strong], scores[strong], labels[strong]
    kept = torchvision.ops.batched_nms(corners, scores, labels, 0.45)
    assert_same(found, corners[kept] / ratio, scores[kept], labels[kept])


def test_nanodet_as_its_head_in_torch(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    cells = sum((SIDE // stride) ** 2 for stride in (8, 16, 32, 64))
    output = np.hstack([rng.random((cells, 3)) ** 2, rng.normal(0, 2, (cells, 32))]).astype(np.float32)[None]
    model = model_that_answers(tmp_path / "m.onnx", {"output": output})
    found = found_by(model, "nanodet", "abc", tmp_path, score_threshold=0.5)

    rows = torch.from_numpy(output[0])
    priors = []
    for stride in (8, 16, 32, 64):  # `get_single_level_center_priors`
        side = SIDE // stride
        y, x = torch.meshgrid(torch.arange(side) * stride, torch.arange(side) * stride, indexing="ij")
        flat = torch.full((side * side,), stride)
        priors.append(torch.stack([x.flatten(), y.flatten(), flat, flat], dim=-1))
    prior = torch.cat(priors)
    shares = rows[:, 3:].reshape(-1, 4, 8).softmax(-1)  # `Integral`
    distance = (shares @ torch.linspace(0, 7, 8)) * prior[:, 2:3]
    low, high = prior[:, :2] - distance[:, :2], prior[:, :2] + distance[:, 2:]  # `distance2bbox`
    corners = torch.cat([low, high], 1).clamp(0, SIDE)
    index, labels = torch.nonzero(rows[:, :3] >= 0.5, as_tuple=True)
    scores = rows[index, labels]
    kept = torchvision.ops.batched_nms(corners[index], scores, labels, 0.6)[:100]
    scale = torch.tensor([WIDTH / SIDE, HEIGHT / SIDE] * 2)
    assert_same(found, corners[index][kept] * scale, scores[kept], labels[kept])


@pytest.mark.parametrize("kind", ["float32", "float16"])
def test_rtdetr_boxes_match_its_reference_postprocessor(tmp_path: Path, kind: str) -> None:
    """`bbox_pred *= orig_target_sizes.repeat(1, 2)`: pixels of the size that it is given, width first."""
    rng = np.random.default_rng(3)
    low, extent = rng.uniform(0, 0.6, (1, 9, 2)), rng.uniform(0.1, 0.3, (1, 9, 2))
    boxes = np.concatenate([low, low + extent], axis=2).astype(kind)
    scores = rng.permutation(np.linspace(0.3, 0.9, 9))[None].astype(kind)
    labels = rng.integers(0, 3, (1, 9))
    outputs = {"labels": labels, "boxes": boxes, "scores": scores}
    model = model_that_answers(tmp_path / "m.onnx", outputs, sized="boxes", kind=kind, size=(96, SIDE))
    found = found_by(model, "rtdetr", "abc", tmp_path, score_threshold=0.45)
    strong = scores[0] >= np.float32(0.45)
    given = (boxes[0, strong] * np.array([96, SIDE] * 2, kind)).astype(np.float32)
    scale = np.array([WIDTH / 96, HEIGHT / SIDE] * 2, np.float32)
    assert_same(found, given * scale, scores[0, strong].astype(np.float32), labels[0, strong])


@pytest.mark.parametrize("kind", ["int64", "int32", "float32", "float16"])
@pytest.mark.parametrize("order", [("labels", "boxes", "scores"), ("scores", "boxes", "labels")])
def test_inputs_and_outputs_of_rtdetr_may_come_in_any_order(tmp_path: Path, kind: str, order: Sequence[str]) -> None:
    outputs = {
        "labels": np.array([[0, 1, 2]]),
        "boxes": np.array([[[0, 0, 0.5, 0.5], [0.1, 0.2, 0.6, 0.7], [0.5, 0.5, 1, 1]]], np.float32),
        "scores": np.array([[0.9, 0.8, 0.7]], np.float32),
    }
    model = model_that_answers(
        tmp_path / "m.onnx",
        {name: outputs[name] for name in order},
        sized="boxes",
        sized_as=kind,
        sized_first=order[0] == "scores",
    )
    found = found_by(model, "rtdetr", "abc", tmp_path)
    assert_same(found, outputs["boxes"][0] * [WIDTH, HEIGHT, WIDTH, HEIGHT], [0.9, 0.8, 0.7], [0, 1, 2])


def test_a_detr_and_its_masks_as_the_postprocess_of_rf_detr(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    logits = rng.normal(-1, 1.5, (1, 12, 3)).astype(np.float32)
    boxes = np.concatenate([rng.uniform(0.3, 0.7, (1, 12, 2)), rng.uniform(0.1, 0.4, (1, 12, 2))], 2).astype(np.float32)
    planes = rng.normal(0, 1, (1, 12, 16, 16)).astype(np.float32)
    model = model_that_answers(tmp_path / "m.onnx", {"dets": boxes, "labels": logits, "masks": planes})
    found = found_by(model, "rfdetr", "abc", tmp_path, score_threshold=0.4)

    chances = torch.from_numpy(logits).sigmoid()
    values, index = torch.topk(chances.view(1, -1), 12, dim=1)
    query, labels = index[0] // 3, index[0] % 3
    x, y, w, h = torch.from_numpy(boxes[0]).unbind(-1)
    corners = torch.stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2], -1)[query]
    corners = corners * torch.tensor([WIDTH, HEIGHT, WIDTH, HEIGHT])
    strong = values[0] >= 0.4
    assert_same(found, corners[strong], values[0][strong], labels[strong])
    grown = torch.nn.functional.interpolate(
        torch.from_numpy(planes[0])[query][strong][:, None], (HEIGHT, WIDTH), mode="bilinear", align_corners=False
    )
    for k in range(found.count):
        assert np.mean(found.mask(k) != (grown[k, 0] > 0).numpy()) < 0.002


@pytest.mark.parametrize("names", [("dets", "labels"), ("logits", "pred_boxes")], ids=["RF-DETR", "Hugging Face"])
def test_a_detr_of_four_classes_has_its_boxes_where_its_authors_put_them(tmp_path: Path, names: Sequence[str]) -> None:
    boxes = np.array([[[0.5, 0.5, 0.2, 0.4], [0.3, 0.3, 0.2, 0.2], [0.6, 0.4, 0.1, 0.3]]], np.float32)
    logits = np.array([[[-4, 2, -4, -4], [-4, -4, -4, 1.5], [1, -4, -4, -4]]], np.float32)
    family = "rfdetr" if names[0] == "dets" else "detr"
    outputs = dict(zip(names, (boxes, logits) if family == "rfdetr" else (logits, boxes), strict=True))
    found = found_by(model_that_answers(tmp_path / "m.onnx", outputs), family, "abcd", tmp_path, score_threshold=0.5)
    corners = np.hstack([boxes[0, :, :2] - boxes[0, :, 2:] / 2, boxes[0, :, :2] + boxes[0, :, 2:] / 2])
    expected = 1 / (1 + np.exp(-np.array([2, 1.5, 1])))
    assert_same(found, corners * np.array([WIDTH, HEIGHT] * 2), expected, [1, 3, 0])


@pytest.mark.parametrize("decoder", ["yolov8", "yolov5"])
def test_masks_of_prototypes_as_ultralytics_draws_them(tmp_path: Path, decoder: str) -> None:
    rng = np.random.default_rng(5)
    rows = np.vstack([rng.uniform(15, 49, (2, 8)), rng.uniform(10, 30, (2, 8)), np.linspace(0.4, 0.9, 8)[None]])
    coefficients, prototypes = rng.normal(0, 1, (4, 8)), rng.normal(0, 1, (1, 4, 16, 16)).astype(np.float32)
    output = np.vstack([rows, coefficients]).astype(np.float32)[None]
    if decoder == "yolov5":  # rows, with an objectness
        output = np.insert(output, 4, 1, axis=1).transpose(0, 2, 1).copy()
    model = model_that_answers(tmp_path / "m.onnx", {"output0": output, "output1": prototypes})
    found = found_by(model, decoder, ["crate"], tmp_path, nms_iou=0.99, fit="letterbox")

    ratio = SIDE / WIDTH
    top = (SIDE - round(HEIGHT * ratio)) // 2
    order = np.argsort(-rows[4])
    x, y, w, h = rows[:4, order]
    boxes = np.stack([x - w / 2, y - h / 2 - top, x + w / 2, y + h / 2 - top], 1) / ratio
    boxes = np.clip(boxes, 0, [WIDTH, HEIGHT, WIDTH, HEIGHT])
    np.testing.assert_allclose(found.boxes, boxes, atol=1.0)  # Ultralytics rounds the scale, this project the size
    logits = torch.from_numpy(coefficients.T[order].astype(np.float32)) @ torch.from_numpy(prototypes[0].reshape(4, -1))
    border = round(top / SIDE * 16)
    cut = logits.view(1, 8, 16, 16)[:, :, border : 16 - border]  # `scale_masks`
    grown = torch.nn.functional.interpolate(cut, (HEIGHT, WIDTH), mode="bilinear", align_corners=False)[0]
    rows_, columns = torch.arange(HEIGHT)[None, :, None], torch.arange(WIDTH)[None, None]
    x1, y1, x2, y2 = torch.from_numpy(found.boxes).T[:, :, None, None]
    inside = (columns >= x1) & (columns < x2) & (rows_ >= y1) & (rows_ < y2)  # `crop_mask`
    for k, expected in enumerate(((grown > 0) & inside).numpy()):
        assert np.mean(found.mask(k) != expected) < 0.002
    assert not found_by(model, decoder, ["crate"], tmp_path, masks=False).masks


@pytest.mark.parametrize("whole", [True, False], ids=["of the input", "of each box"])
def test_masks_of_mask_rcnn_as_torchvision_pastes_them(tmp_path: Path, whole: bool) -> None:
    from torchvision.models.detection.roi_heads import paste_masks_in_image

    rng = np.random.default_rng(6)
    boxes = np.array([[4, 6, 40, 50], [20, 10, 60, 30], [1, 1, 30, 20]], np.float32)
    scores, labels = np.array([0.9, 0.8, 0.7], np.float32), np.array([1, 2, 1])
    small = cv2.GaussianBlur(rng.random((3, 28, 28)).astype(np.float32).transpose(1, 2, 0), (9, 9), 3)
    small = np.ascontiguousarray((small - small.mean()) * 8 + 0.5).transpose(2, 0, 1)[:, None].clip(0, 1)
    scale = np.array([WIDTH / SIDE, HEIGHT / SIDE] * 2, np.float32)
    if whole:
        masks = paste_masks_in_image(torch.from_numpy(small), torch.from_numpy(boxes), (SIDE, SIDE)).numpy()
        expected = torch.nn.functional.interpolate(torch.from_numpy(masks), (HEIGHT, WIDTH), mode="bilinear")
    else:
        masks = small
        expected = paste_masks_in_image(torch.from_numpy(small), torch.from_numpy(boxes * scale), (HEIGHT, WIDTH))
    outputs = {"boxes": boxes, "labels": labels, "scores": scores, "masks": masks.astype(np.float32)}
    found = found_by(model_that_answers(tmp_path / "m.onnx", outputs), "torchvision", "ab", tmp_path)
    assert_same(found, boxes * scale, scores, labels - 1)
    for k in range(3):
        assert np.mean(found.mask(k) != (expected[k, 0] > 0.5).numpy()) < 0.003
        assert found.mask(k).any()


def end_to_end(form: str, boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray) -> dict[str, np.ndarray]:
    rows, count = len(boxes), len(boxes)
    match form:
        case "ultralytics":
            return {"output0": np.hstack([boxes, scores[:, None], labels[:, None]])[None].astype(np.float32)}
        case "yolov7":
            first = np.zeros((rows, 1))
            return {"output": np.hstack([first, boxes, labels[:, None], scores[:, None]]).astype(np.float32)}
        case "mmdeploy":
            return {"dets": np.hstack([boxes, scores[:, None]])[None].astype(np.float32), "labels": labels[None]}
    padded = [np.concatenate([a, np.zeros((3, *a.shape[1:]), a.dtype)])[None] for a in (boxes, scores, labels)]
    return {"num": np.array([[count]]), "boxes": padded[0], "scores": padded[1], "classes": padded[2]}


@pytest.mark.parametrize("form", ["ultralytics", "yolov7", "mmdeploy", "efficient_nms"])
def test_boxes_after_suppression_pass_in_every_form(tmp_path: Path, form: str) -> None:
    """Overlapping boxes of a class stay: what the export has kept is not suppressed once more."""
    boxes = np.array([[4, 6, 40, 50], [4, 6, 40, 49], [1, 1, 30, 20], [2, 2, 9, 9]], np.float32)
    scores, labels = np.array([0.9, 0.8, 0.7, 0.1], np.float32), np.array([1, 1, 0, 0])
    model = model_that_answers(tmp_path / "m.onnx", end_to_end(form, boxes, scores, labels))
    found = found_by(model, "end2end", "ab", tmp_path, fit="stretch")
    scale = np.array([WIDTH / SIDE, HEIGHT / SIDE] * 2, np.float32)
    assert_same(found, boxes[:3] * scale, scores[:3], labels[:3])


@pytest.mark.parametrize("names", ["boxes classes scores", "detection_scores:0 detection_classes:0 detection_boxes:0"])
def test_tensorflows_boxes_have_their_rows_first_and_cocos_numbers(tmp_path: Path, names: str) -> None:
    boxes = np.array([[[0.1, 0.2, 0.5, 0.6], [0, 0, 0.4, 0.3], [0.2, 0.2, 0.9, 0.8]]], np.float32)
    outputs = {
        "boxes": boxes,
        "classes": np.array([[1.0, 2, 1]], np.float32),
        "scores": np.array([[0.9, 0.8, 0.7]], np.float32),
    }
    given = {name: next(v for k, v in outputs.items() if k in name) for name in names.split()}
    found = found_by(model_that_answers(tmp_path / "m.onnx", given), "tensorflow", ["none", "a", "b"], tmp_path)
    size = np.array([WIDTH, HEIGHT, WIDTH, HEIGHT])
    assert_same(found, boxes[0][:, [1, 0, 3, 2]] * size, [0.9, 0.8, 0.7], [1, 2, 1])


@pytest.mark.parametrize("scores_first", [True, False])
@pytest.mark.parametrize("classes", ["ab", "abc", "abcd"])
def test_an_ssd_of_any_number_of_classes(tmp_path: Path, classes: str, scores_first: bool) -> None:
    if len(classes) == 3 and not scores_first:
        pytest.skip("of three classes the scores come first")
    scores = np.full((1, 4, 1 + len(classes)), 0.01, np.float32)
    scores[0, [0, 1, 2], [1, 2, 1]] = [0.9, 0.8, 0.7]
    boxes = np.array([[[0, 0, 0.5, 0.5], [0.1, 0.2, 0.6, 0.7], [0.5, 0.5, 1, 1], [0, 0, 1, 1]]], np.float32)
    outputs = {"scores": scores, "boxes": boxes}
    given = outputs if scores_first else dict(reversed(outputs.items()))
    found = found_by(model_that_answers(tmp_path / "m.onnx", given), "ssd", classes, tmp_path)
    assert_same(found, boxes[0, :3] * [WIDTH, HEIGHT, WIDTH, HEIGHT], [0.9, 0.8, 0.7], [0, 1, 0])


def test_rows_that_fill_up_an_export_are_no_objects(tmp_path: Path) -> None:
    boxes = np.tile(np.array([1, 2, 30, 40], np.float32), (5, 1))
    model = model_that_answers(
        tmp_path / "m.onnx", end_to_end("mmdeploy", boxes, np.array([0.9, 0.8, 0.7, 0, 0]), np.array([0, 1, 2, -1, -1]))
    )
    assert found_by(model, "end2end", "abc", tmp_path, score_threshold=0.0).labels() == ("a", "b", "c")


@pytest.mark.parametrize(
    ("decoder", "outputs", "reason"),
    [
        ("yolox", {"o": np.zeros((1, 84, 7), np.float32)}, "separates 2 classes, but there are 3 class names"),
        ("yolox", {"o": np.zeros((1, 80, 8), np.float32)}, r"for an input of 64x64 has shape \(1, 84, 5 \+ classes\)"),
        ("nanodet", {"o": np.zeros((1, 84, 35), np.float32)}, r"has shape \(1, 85, classes \+ 32\)"),
        ("rtdetr", {"a": np.zeros((1, 3, 4), np.float32)}, r"RT-DETR's outputs have shapes"),
        ("rfdetr", {"a": np.zeros((1, 3, 7), np.float32)}, r"a DETR's outputs have shapes"),
        ("end2end", {"a": np.zeros((1, 3, 9), np.float32)}, r"end-to-end outputs are"),
        ("tensorflow", {"a": np.zeros((1, 3, 9), np.float32)}, r"outputs of TensorFlow's detectors"),
    ],
)
def test_outputs_of_another_model_family_are_refused_with_a_hint(
    tmp_path: Path, decoder: str, outputs: dict[str, np.ndarray], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        found_by(model_that_answers(tmp_path / "m.onnx", outputs), decoder, "abc", tmp_path)


@pytest.mark.data
def test_yolox_nano_is_known_by_its_digest_and_equal_to_the_model_outside(data_dir: Path) -> None:
    """All of `demo/ONNXRuntime/onnx_inference.py` of YOLOX, its class-wise suppression in torchvision."""
    import onnxruntime

    file = data_dir / "models" / "yolox_nano.onnx"
    detector = OnnxDetector(model=str(file), score_threshold=0.25, input_size=416)  # as its demo
    detector.setup()
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    total = 0
    for photograph in sorted((data_dir / "coco128" / "images").iterdir())[:8]:
        bgr = cv2.imread(str(photograph))
        found = detector.process(Image(stamp=1, frame="camera", data=np.ascontiguousarray(bgr[..., ::-1])))
        ratio = min(416 / bgr.shape[0], 416 / bgr.shape[1])
        padded = np.full((416, 416, 3), 114, np.uint8)
        resized = cv2.resize(bgr, (int(bgr.shape[1] * ratio), int(bgr.shape[0] * ratio)))
        padded[: resized.shape[0], : resized.shape[1]] = resized
        rows = session.run(None, {"images": padded.transpose(2, 0, 1)[None].astype(np.float32)})[0][0]
        grids = [np.stack(np.meshgrid(np.arange(416 // s), np.arange(416 // s)), 2).reshape(-1, 2) for s in (8, 16, 32)]
        steps = np.concatenate([np.full((len(g), 1), s) for g, s in zip(grids, (8, 16, 32), strict=True)])
        center, size = (rows[:, :2] + np.concatenate(grids)) * steps, np.exp(rows[:, 2:4]) * steps
        corners = torch.from_numpy((np.hstack([center - size / 2, center + size / 2]) / ratio).astype(np.float32))
        scores, labels = torch.from_numpy(rows[:, 4:5] * rows[:, 5:]).max(1)
        strong = scores >= 0.25
        kept = torchvision.ops.batched_nms(corners[strong], scores[strong], labels[strong], 0.45)
        limit = torch.tensor([bgr.shape[1], bgr.shape[0]] * 2)
        np.testing.assert_allclose(found.boxes, corners[strong][kept].clamp(min=0).minimum(limit), atol=0.02)
        np.testing.assert_allclose(found.scores, scores[strong][kept], atol=1e-5)
        assert found.class_ids.tolist() == labels[strong][kept].tolist()
        total += found.count
    assert total > 20
