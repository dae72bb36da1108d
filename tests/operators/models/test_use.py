"""Models in operators: what a row of the registry gives them, what is given to them goes before it, and the record."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_onnx import node, write_model
from served_models import model_of, write_row

from dataflow.messages import Image, RelativeDepth, SegmentationMap
from dataflow.operator import Operator
from dataflow.testing import play
from operators.depth import MonoDepth
from operators.detection import BoxSegmenter, OnnxDetector
from operators.detection.coco import COCO_CLASSES
from operators.inference import ModelError
from operators.models import registry
from operators.segmentation import OnnxSegmenter
from operators.weights import shipped

pytest.importorskip("onnx")

IMAGE = Image(stamp=1, frame="camera", data=np.random.default_rng(2).integers(0, 256, (20, 30, 3)).astype(np.uint8))
Registered = Callable[..., str]


def network(file: Path, planes: int, size: tuple[int | str, int | str] = ("h", "w")) -> Path:
    """A network that answers with the mean of the three channels, in so many planes."""
    weights = np.full((planes, 3, 1, 1), 1 / 3, np.float32)
    ports = {"x": [1, 3, *size]}, {"y": None}
    return Path(write_model(file, [node("Conv", "x w", "y")], *ports, values={"w": weights}))


@pytest.fixture
def registered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Registered:
    """Writes a registry with the row `net` for an operator and its file, which is returned."""

    def write(operator: type[Operator], planes: int = 1, **fields: Any) -> str:
        file = network(tmp_path / "mine.onnx", planes)
        row = model_of(file.read_bytes(), url="http://127.0.0.1:9/net.onnx")
        own = tmp_path / f"own{len(list(tmp_path.iterdir()))}.yaml"  # a file is read once
        fields["operator"] = f"{operator.__module__}:{operator.__name__}"
        monkeypatch.setenv(registry.REGISTRIES, write_row(own, row, **fields))
        return str(file)

    return write


def nearness(model: str, **params: Any) -> np.ndarray:
    (found,) = play(MonoDepth(model=model, **params), {"image": [IMAGE]})["relative"]
    assert isinstance(found, RelativeDepth)
    return found.data


def test_the_record_holds_the_row_so_that_another_one_is_noticed(registered: Registered) -> None:
    recorded = []
    for params in ({"score_threshold": 0.3}, {"score_threshold": 0.3}, {"score_threshold": 0.4}):
        file = registered(OnnxDetector, params={"decoder": "yolov8", **params}, classes=["mug"])
        made = OnnxDetector(model=file)
        made.setup()
        assert made.files.keys() == {file, f"{file} (row)"}
        recorded.append(made.files)
    registered(OnnxDetector, params={"decoder": "yolov8", "score_threshold": 0.3}, classes=["cup"])
    made = OnnxDetector(model=file)
    made.setup()
    assert recorded[0] == recorded[1]
    assert len({files[f"{file} (row)"] for files in (*recorded, made.files)}) == 3
    assert len({files[file] for files in (*recorded, made.files)}) == 1


def test_a_given_value_goes_before_the_rows_even_where_it_is_the_default(registered: Registered) -> None:
    file = registered(MonoDepth, params={"normalization": "unit", "input_size": [30, 20]})
    grey = IMAGE.data.astype(np.float32).mean(axis=2)
    np.testing.assert_allclose(nearness(file), grey / 255, atol=1e-4)
    np.testing.assert_allclose(nearness(file, normalization="none"), grey, atol=1e-2)
    assert np.abs(nearness(file, normalization="none", input_size=(518, 518)) - grey).max() > 1


def test_a_detector_takes_fit_and_size_of_the_row(registered: Registered) -> None:
    file = registered(OnnxDetector, params={"decoder": "yolov8", "input_size": 64, "fit": "corner"})
    for given, size in (({}, 64), ({"input_size": 640}, 640)):
        made = OnnxDetector(model=file, **given)
        made.setup()
        with pytest.raises(ModelError, match=rf"got \(1, 1, {size}, {size}\)"):
            made.process(IMAGE)


@pytest.mark.parametrize(("classes", "planes"), [("coco", 80), (["mug", "cup"], 2)])
def test_a_segmenter_takes_the_classes_of_the_row(registered: Registered, classes: Any, planes: int) -> None:
    file = registered(OnnxSegmenter, planes, classes=classes)
    (found,) = play(OnnxSegmenter(model=file), {"image": [IMAGE]})["segmentation"]
    assert isinstance(found, SegmentationMap)
    assert found.class_names == (COCO_CLASSES if classes == "coco" else ("mug", "cup"))


@pytest.mark.parametrize("kind", [OnnxDetector, MonoDepth, OnnxSegmenter, BoxSegmenter])
def test_a_model_of_another_operator_is_refused(registered: Registered, kind: type[Operator]) -> None:
    other = MonoDepth if kind is OnnxDetector else OnnxDetector
    file = registered(other)
    with pytest.raises(ModelError, match=rf"net is run by operators.*:{other.__name__}, not by {kind.__name__}"):
        kind(model=file).setup()


def test_a_row_with_a_parameter_that_is_not_taken_from_it_is_refused(registered: Registered) -> None:
    file = registered(MonoDepth, params={"max_range": 3.0, "normalisation": "unit"})
    with pytest.raises(
        ModelError, match=r"row net sets max_range, normalisation, but MonoDepth takes only .*normalization.* from it"
    ):
        MonoDepth(model=file).setup()


@pytest.mark.parametrize(
    ("params", "named"),
    [
        ({"classes": "mug"}, "classes"),
        ({"fit": "corner", "input_size": 320}, "fit, input_size"),
        ({"provider": "cuda"}, "provider"),
    ],
)
@pytest.mark.parametrize("model", ["simulated", str(shipped("detector.onnx"))])
def test_trained_network_refuses_parameters_its_file_holds(params: dict[str, Any], named: str, model: str) -> None:
    with pytest.raises(ModelError, match=rf"leave {named} of OnnxDetector out"):
        OnnxDetector(model=model, **params).setup()


def test_an_operator_in_place_of_a_model_is_named() -> None:
    with pytest.raises(ModelError, match=r"operators\.detection:CustomDetector is an operator, .*`detector_operator`"):
        OnnxDetector(model="operators.detection:CustomDetector").setup()


def test_depth_takes_a_provider_as_other_networks_do(registered: Registered) -> None:
    with pytest.raises(ModelError, match="no provider 'cuda'"):
        MonoDepth(model=registered(MonoDepth), provider="cuda").setup()
