"""Masks of boxes by a small model of EfficientSAM's signature."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dataflow.messages import Detections2D, Image
from operators.detection import BoxSegmenter
from operators.inference import ModelError

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch")

WIDTH, HEIGHT = 80, 60


def prompted() -> torch.nn.Module:
    class Prompted(torch.nn.Module):
        """Answers with three masks a prompt: where the image is bright, nowhere, everywhere. The first fits best where
        the corners' labels are those of a box."""

        def forward(self, image, points, labels):
            bright = (image.mean(1) - 0.5)[:, None, None] + 0 * points.sum() + torch.zeros(1, points.shape[1], 1, 1, 1)
            masks = torch.cat([bright, bright * 0 - 1, bright * 0 + 1], dim=2)
            box = (labels[..., :1] - 1) * (labels[..., 1:] - 2)  # 1 for the labels 2 and 3
            return masks, torch.cat([box, box * 0, box * 0 + 0.5], dim=2)

    return Prompted()


def exported(file: Path, *, many: bool, half: bool = False) -> str:
    queries = 2 if many else 1
    shapes = ((1, 3, 48, 64), (1, queries, 2, 2), (1, queries, 2))
    given = tuple(torch.rand(shape, dtype=torch.float16 if half else torch.float32) for shape in shapes)
    names = ["batched_images", "batched_point_coords", "batched_point_labels"]
    torch.onnx.export(
        prompted().half() if half else prompted(),
        given,
        str(file),
        input_names=names,
        output_names=["output_masks", "iou_predictions"],
        dynamic_axes={name: {1: "queries"} for name in names[1:]} if many else None,
        opset_version=17,
        dynamo=False,
    )
    return str(file)


def image() -> Image:
    data = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    data[:, 40:] = 255
    return Image(stamp=1, frame="camera", data=data)


def detections(width: int = WIDTH) -> Detections2D:
    return Detections2D(
        stamp=1,
        frame="camera",
        width=width,
        height=HEIGHT,
        boxes=[[20, 10, 60, 30], [0, 0, 30, 20], [50, 40, 80, 60]],
        scores=[0.5, 0.3, 0.9],
        class_ids=[0, 0, 0],
    )


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
@pytest.mark.parametrize("half", [False, True], ids=["float32", "float16"])
@pytest.mark.parametrize("many", [True, False], ids=["all boxes at once", "one by one"])
def test_each_box_gets_what_is_bright_in_it(tmp_path: Path, many: bool, half: bool) -> None:
    made = BoxSegmenter(model=exported(tmp_path / "m.onnx", many=many, half=half), most=2)
    made.setup()
    given = detections()
    found = made.process(image(), given)
    assert found.replace(masks=None).digest() == given.digest()
    first, least, surest = (found.mask(k) for k in range(3))
    assert first[10:30, 41:60].all()
    assert first.sum() == pytest.approx(20 * 20, abs=20)
    assert surest[40:60, 50:80].all()
    assert surest.sum() == 20 * 30
    assert not least.any()  # beyond `most`


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
def test_images_of_other_sizes_and_other_models_are_refused(tmp_path: Path) -> None:
    made = BoxSegmenter(model=exported(tmp_path / "m.onnx", many=True))
    made.setup()
    with pytest.raises(ValueError, match="detections in an image of 70x60 pixels cannot be segmented in one of 80x60"):
        made.process(image(), detections(70))
    none = detections().replace(boxes=np.zeros((0, 4)), scores=[], class_ids=[])
    assert made.process(image(), none).masks.shape == (0, HEIGHT, WIDTH // 8)  # type: ignore[union-attr]

    class Plain(torch.nn.Module):
        def forward(self, x):
            return x * 2

    torch.onnx.export(Plain(), (torch.rand(1, 3, 8, 8),), str(tmp_path / "p.onnx"), dynamo=False)
    with pytest.raises(ModelError, match=r"must take points \[1, Q, P, 2\] and labels"):
        BoxSegmenter(model=str(tmp_path / "p.onnx")).setup()
