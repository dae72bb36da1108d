"""Segmentation networks of any make, made here so that their answers are known, against onnxruntime called directly."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
import pytest
from made_onnx import node, write_model

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Image, SegmentationMap
from dataflow.testing import play
from operators.inference import ModelError, open_session
from operators.segmentation import OnnxSegmenter, draw_segmentation

onnx = pytest.importorskip("onnx")

NAMES = ("floor", "wall", "mug")


def save(
    file: Path,
    weights: np.ndarray,
    *,
    size: Sequence[int | str] = (24, 32),
    nhwc: bool = False,
    kind: str = "FLOAT",
    stride: int = 1,
    argmax: bool = False,
    metadata: Mapping[str, str] | None = None,
) -> str:
    """A network whose scores are `weights` (C, 3) times the pixel, seen at every stride-th; inner type is float."""
    nodes = [node("Cast", "x", "wide", to=onnx.TensorProto.FLOAT)]
    if nhwc:
        nodes.append(node("Transpose", "wide", "image", perm=[0, 3, 1, 2]))
    nodes.append(node("Conv", "image w" if nhwc else "wide w", "planes", strides=[stride, stride]))
    last = "planes"
    if argmax:
        last = "best"
        nodes.append(node("ArgMax", "planes", last, axis=1, keepdims=0))
    elif nhwc:
        last = "back"
        nodes.append(node("Transpose", "planes", last, perm=[0, 2, 3, 1]))
    inputs = {"x": (kind, [1, *size, 3] if nhwc else [1, 3, *size])}
    outputs = {last: ("INT64" if argmax else "FLOAT", None)}
    values = {"w": weights.astype(np.float32)[:, :, None, None]}
    return write_model(file, nodes, inputs, outputs, values=values, metadata=metadata)


WEIGHTS = np.random.default_rng(5).normal(0, 2, (3, 3))
NAMED = {"names": json.dumps(NAMES)}


def image(width: int = 64, height: int = 48, seed: int = 0) -> Image:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return Image(stamp=seed, frame="camera", data=cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST))


def segmented(seen: Image | None = None, **params: Any) -> SegmentationMap:
    return play(OnnxSegmenter(**params), {"image": [seen or image()]})["segmentation"][0]


def direct(model: str, tensor: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {"x": tensor})[0])


def softmax(scores: np.ndarray) -> np.ndarray:
    powers = np.exp(scores - scores.max(axis=0))
    return powers / powers.sum(axis=0)


def test_classes_and_confidence_are_those_of_the_network_called_directly(tmp_path: Path) -> None:
    model = save(tmp_path / "m.onnx", WEIGHTS, metadata=NAMED)
    found = segmented(model=model, with_confidence=True)
    small = cv2.resize(image().data, (32, 24), interpolation=cv2.INTER_LINEAR) / 255
    tensor = ((small - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]).transpose(2, 0, 1)[None].astype(np.float32)
    scores = np.stack([cv2.resize(p, (64, 48), interpolation=cv2.INTER_LINEAR) for p in direct(model, tensor)[0]])
    assert found.class_names == NAMES
    assert (found.classes == scores.argmax(axis=0)).mean() > 0.999  # a tie may fall either way
    assert len(np.unique(found.classes)) == 3
    assert found.confidence is not None
    np.testing.assert_allclose(found.confidence, softmax(scores).max(axis=0), atol=1e-4)


def test_low_resolution_scores_are_interpolated_before_argmax(tmp_path: Path) -> None:
    model = save(tmp_path / "m.onnx", WEIGHTS, stride=4, size=(48, 64), metadata=NAMED)
    found = segmented(model=model, mean=(0, 0, 0), std=(1, 1, 1))
    tensor = (image().data / 255).transpose(2, 0, 1)[None].astype(np.float32)
    planes = direct(model, tensor)[0]
    assert planes.shape == (3, 12, 16)
    scores = np.stack([cv2.resize(p, (64, 48), interpolation=cv2.INTER_LINEAR) for p in planes])
    assert (found.classes == scores.argmax(axis=0)).mean() > 0.999
    blocks = np.kron(planes.argmax(axis=0), np.ones((4, 4), int))
    assert (found.classes != blocks).any()  # edges are finer than the network's cells


@pytest.mark.parametrize(
    ("options", "params"),
    [
        ({"nhwc": True}, {}),  # channels last, in and out
        ({"kind": "FLOAT16"}, {}),  # half precision
        ({"size": ("H", "W")}, {"input_size": (32, 24)}),  # an input of open size
        ({"metadata": NAMED | {"mean": "[0, 0, 0]", "std": "[1, 1, 1]"}}, {"mean": None, "std": None}),
    ],
)
def test_layout_type_size_and_normalisation_are_read_from_the_model(
    tmp_path: Path, options: dict[str, Any], params: dict[str, Any]
) -> None:
    plain = {"mean": (0, 0, 0), "std": (1, 1, 1)}
    expected = segmented(model=save(tmp_path / "plain.onnx", WEIGHTS, metadata=NAMED), **plain)
    made = save(tmp_path / "m.onnx", WEIGHTS, **({"metadata": NAMED} | options))
    found = segmented(model=made, **(plain | params))
    assert (found.classes == expected.classes).mean() > 0.99


def test_a_network_that_takes_bytes_is_given_the_pixels(tmp_path: Path) -> None:
    model = save(tmp_path / "m.onnx", WEIGHTS, kind="UINT8", size=(48, 64), metadata=NAMED)
    expected = direct(model, image().data.transpose(2, 0, 1)[None])[0].argmax(axis=0)
    np.testing.assert_array_equal(segmented(model=model).classes, expected)
    with pytest.raises(OperatorFailure, match="takes pixels of uint8 as they are"):
        segmented(model=model, mean=(0.5, 0.5, 0.5))


def test_bgr_networks_get_blue_first(tmp_path: Path) -> None:
    model = save(tmp_path / "m.onnx", WEIGHTS[:, ::-1], metadata=NAMED)
    other = save(tmp_path / "n.onnx", WEIGHTS, metadata=NAMED)
    np.testing.assert_array_equal(segmented(model=model, bgr=True).classes, segmented(model=other).classes)


def test_a_map_of_classes_is_taken_as_it_is_and_has_no_confidence(tmp_path: Path) -> None:
    model = save(tmp_path / "m.onnx", WEIGHTS, argmax=True, size=(48, 64), metadata=NAMED)
    scored = save(tmp_path / "s.onnx", WEIGHTS, size=(48, 64), metadata=NAMED)
    found = segmented(model=model)
    np.testing.assert_array_equal(found.classes, segmented(model=scored).classes)
    assert found.confidence is None
    with pytest.raises(OperatorFailure, match="gives classes without scores"):
        segmented(model=model, confidence_threshold=0.5)


def test_one_channel_is_a_class_and_its_background(tmp_path: Path) -> None:
    model = save(tmp_path / "m.onnx", np.array([[9.0, -9.0, 0.0]]), size=(48, 64), metadata={"names": '["no", "red"]'})
    found = segmented(model=model, mean=(0, 0, 0), std=(1, 1, 1), with_confidence=True)
    pixels = image().data.astype(float)
    red = pixels[..., 0] > pixels[..., 1]
    np.testing.assert_array_equal(found.classes == 1, red)
    assert found.confidence is not None
    margin = 9 * np.abs(pixels[..., 0] - pixels[..., 1]) / 255
    np.testing.assert_allclose(found.confidence, 1 / (1 + np.exp(-margin)), atol=1e-4)


def test_letterboxed_segmentation_is_cropped_to_the_image(tmp_path: Path) -> None:
    # 64x24 in 32x24: 32x12 with 6 rows of grey above and below; scores are proportional to the pixel, so to the image.
    model = save(tmp_path / "m.onnx", WEIGHTS, metadata=NAMED)
    seen, plain = image(64, 24), {"mean": (0, 0, 0), "std": (1, 1, 1)}
    found = segmented(seen, model=model, fit="letterbox", **plain)
    whole = save(tmp_path / "w.onnx", WEIGHTS, size=(12, 32), metadata=NAMED)
    np.testing.assert_array_equal(found.classes, segmented(seen, model=whole, **plain).classes)
    coarse = save(tmp_path / "c.onnx", WEIGHTS, stride=2, metadata=NAMED)
    assert (segmented(seen, model=coarse, fit="letterbox", **plain).classes == found.classes).mean() > 0.75


def test_unsure_pixels_become_void_by_one_threshold_or_by_class(tmp_path: Path) -> None:
    model = save(tmp_path / "m.onnx", WEIGHTS, metadata=NAMED)
    every = segmented(model=model, with_confidence=True)
    assert every.confidence is not None
    half = segmented(model=model, confidence_threshold=0.7)
    np.testing.assert_array_equal(half.classes == 255, every.confidence < np.float32(0.7))
    wall = segmented(model=model, class_thresholds={"wall": 0.9})
    unsure = (every.classes == 1) & (every.confidence < np.float32(0.9))
    assert unsure.any()
    np.testing.assert_array_equal(wall.classes == 255, unsure)
    with pytest.raises(OperatorFailure, match=r"'wal': 0.9; it takes shares from 0 to 1 for floor, wall, mug"):
        segmented(model=model, class_thresholds={"wal": 0.9})


def test_status_reports_share_and_confidence_of_each_class(tmp_path: Path) -> None:
    model = save(tmp_path / "m.onnx", WEIGHTS, metadata=NAMED)
    played = play(OnnxSegmenter(model=model, with_confidence=True), {"image": [image()]})
    (found,), (status,) = played["segmentation"], played["status"]
    assert sum(float(status.pairs(k)["share"]) for k in range(status.count)) == pytest.approx(1, abs=1e-3)
    for k, name in enumerate(status.names):
        own = found.classes == NAMES.index(name)
        assert float(status.pairs(k)["confidence"]) == pytest.approx(float(found.confidence[own].mean()), abs=1e-3)


def test_names_and_colours_come_from_a_file_or_from_the_metadata(tmp_path: Path) -> None:
    (tmp_path / "names.txt").write_text("floor 128 64 128\ntraffic light\t250,170,30\n\nmug\n")
    model = save(tmp_path / "m.onnx", WEIGHTS)
    played = play(OnnxSegmenter(model=model, classes=str(tmp_path / "names.txt"), paint=True), {"image": [image()]})
    (found,), (painted,) = played["segmentation"], played["painted"]
    assert found.class_names == ("floor", "traffic light", "mug")
    lights = found.classes == 1
    expected = image().data[lights] * 0.5 + np.array([250, 170, 30]) * 0.5
    np.testing.assert_allclose(painted.data[lights], expected, atol=0.51)
    told = {"names": "{0: 'floor', 1: 'traffic light', 2: 'mug'}", "palette": "[[128,64,128],[250,170,30],[1,2,3]]"}
    same = play(
        OnnxSegmenter(model=save(tmp_path / "t.onnx", WEIGHTS, metadata=told), paint=True), {"image": [image()]}
    )
    assert same["segmentation"][0].class_names == found.class_names
    np.testing.assert_array_equal(same["painted"][0].data[lights], painted.data[lights])
    assert segmented(model=model).class_names == ("0", "1", "2")


def test_void_pixels_are_not_painted_and_maps_of_other_images_are_refused() -> None:
    classes = np.full((48, 64), 255, np.uint8)
    made = SegmentationMap(stamp=0, frame="camera", class_names=("a",), void=255, classes=classes)
    np.testing.assert_array_equal(draw_segmentation(image(), made).data, image().data)
    with pytest.raises(ValueError, match="a map of 64x48 pixels cannot be painted over an image of 32x24"):
        draw_segmentation(image(32, 24), made)


@pytest.mark.parametrize(
    ("metadata", "params", "words"),
    [
        ({"names": '["a", "b"]'}, {}, r"scores of 3 classes \(\(1, 3, 24, 32\)\), but 2 class names"),
        ({"names": "a b c"}, {}, "'names' is neither JSON nor a Python literal: a b c"),
        ({"names": "{0: 'a', 2: 'c'}"}, {}, "a mapping from 0, 1, 2"),
        (NAMED | {"palette": "[[1, 2, 3]]"}, {}, "a list of 3 colours"),
        (NAMED | {"palette": "[[1, 2, 3], [1, 2, 300], [0, 0, 0]]"}, {}, "colour of 'wall' must be three whole"),
        (NAMED | {"mean": "[1, 2]"}, {}, "'mean' must be three numbers"),
        (NAMED, {"std": (1, 0, 1)}, "std must be above 0"),
        (NAMED, {"output": "logits"}, "has no output 'logits'; it has planes"),
    ],
)
def test_mismatched_input_is_refused_with_the_mismatch(
    tmp_path: Path, metadata: dict[str, str], params: dict[str, Any], words: str
) -> None:
    with pytest.raises(OperatorFailure, match=words):
        segmented(model=save(tmp_path / "m.onnx", WEIGHTS, metadata=metadata), **params)


def test_a_network_that_is_no_segmenter_is_refused(tmp_path: Path) -> None:
    flat = [node("ReduceMean", "x", "y", keepdims=0)]
    mean = write_model(tmp_path / "m.onnx", flat, {"x": [1, 3, 8, 8]}, {"y": None})
    with pytest.raises(OperatorFailure, match=r"output 'y' of .*scores have shape \(1, classes, H, W\).*got \(\)"):
        segmented(model=mean)
    double = write_model(tmp_path / "g.onnx", flat, {"x": ("DOUBLE", [1, 3, 24, 32])}, {"y": ("DOUBLE", None)})
    made = OnnxSegmenter(model=double)
    with pytest.raises(ModelError, match=r"must have one input tensor\(float\) or .*\[1, 3, H, W\] or \[1, H, W, 3\]"):
        made.setup()


def test_a_provider_that_is_not_there_is_named(tmp_path: Path) -> None:
    made = OnnxSegmenter(model=save(tmp_path / "m.onnx", WEIGHTS, metadata=NAMED), provider="tensorrt")
    with pytest.raises(ModelError, match="no provider 'tensorrt'; it has cpu"):
        made.setup()


def test_a_provider_that_finds_no_device_is_not_silently_replaced_by_the_cpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An onnxruntime with CUDA on a machine without a card falls back to the CPU and says so in its log alone."""
    there = onnxruntime.get_available_providers()
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider", *there])
    made = OnnxSegmenter(model=save(tmp_path / "m.onnx", WEIGHTS, metadata=NAMED), provider="cuda")
    with (
        pytest.warns(UserWarning, match="not in available provider names"),
        pytest.raises(ModelError, match="provider 'cuda' could not start: is there such a device"),
    ):
        made.setup()


@pytest.mark.parametrize(
    ("provider", "expected"),
    [
        ("cuda:1", [("CUDAExecutionProvider", {"device_id": 1})]),
        ("cuda", ["CUDAExecutionProvider"]),
        ("tensorrt:2", [("TensorrtExecutionProvider", {"device_id": 2}), ("CUDAExecutionProvider", {"device_id": 2})]),
        ("openvino", ["OpenVINOExecutionProvider"]),
        ("cpu", []),
    ],
)
def test_a_card_is_chosen_by_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, provider: str, expected: list[Any]
) -> None:
    class Session:
        def __init__(self, model: str, options: Any, providers: list[Any]) -> None:
            self.providers = providers

        def get_providers(self) -> list[str]:
            return [each if isinstance(each, str) else each[0] for each in self.providers]

    names = ["Tensorrt", "CUDA", "OpenVINO", "CPU"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [f"{n}ExecutionProvider" for n in names])
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    session: Any = open_session(Path(save(tmp_path / "m.onnx", WEIGHTS, metadata=NAMED)), provider)
    assert session.providers == [*expected, "CPUExecutionProvider"]


@pytest.mark.parametrize("provider", ["cuda:", "cuda:x", "cpu:1", "gpu", "openvino:1"])
def test_another_provider_is_refused(provider: str) -> None:
    with pytest.raises(ValueError, match="provider"):
        OnnxSegmenter(model="m.onnx", provider=provider)


@pytest.mark.long
def test_exported_torchvision_network_equals_the_torchvision_operator(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    models = pytest.importorskip("torchvision.models")
    from operators.segmentation import TorchvisionSegmenter

    torch.manual_seed(5)
    network = models.get_model("lraspp_mobilenet_v3_large", weights=None, weights_backbone=None, num_classes=3).eval()
    torch.save({"model": network.state_dict(), "classes": list(NAMES)}, tmp_path / "m.pt")

    class Scores(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, x: Any) -> Any:
            return self.network(x)["out"]

    file = tmp_path / "m.onnx"
    torch.onnx.export(Scores(), (torch.zeros(1, 3, 96, 128),), str(file), opset_version=17, dynamo=False)
    (tmp_path / "names.txt").write_text("\n".join(NAMES))
    seen = image(128, 96)
    ours = segmented(seen, model=str(file), classes=str(tmp_path / "names.txt"), with_confidence=True)
    operator = TorchvisionSegmenter(
        model="lraspp_mobilenet_v3_large", checkpoint=str(tmp_path / "m.pt"), side=0, with_confidence=True
    )
    (theirs,) = play(operator, {"image": [seen]})["segmentation"]
    assert (ours.classes == theirs.classes).mean() > 0.999
    np.testing.assert_allclose(ours.confidence, theirs.confidence, atol=1e-4)
