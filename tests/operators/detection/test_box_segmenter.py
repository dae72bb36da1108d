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
def test_each_box_is_masked_by_its_bright_pixels(tmp_path: Path, many: bool, half: bool) -> None:
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
    assert made.process(image(), none).masks.shape == (0, HEIGHT, WIDTH // 8)

    class Plain(torch.nn.Module):
        def forward(self, x):
            return x * 2

    torch.onnx.export(Plain(), (torch.rand(1, 3, 8, 8),), str(tmp_path / "p.onnx"), dynamo=False)
    with pytest.raises(ModelError, match=r"must take points \[1, Q, P, 2\] and labels"):
        BoxSegmenter(model=str(tmp_path / "p.onnx")).setup()


def encoder(side: int, pixels: bool) -> torch.nn.Module:
    class Encoder(torch.nn.Module):
        """Embeds an image as how bright it is, at a quarter of its size; `pixels` are normalised and padded here."""

        def forward(self, image):
            if pixels:
                image = ((image - 120.0) / 60.0).permute(2, 0, 1)
                image = torch.nn.functional.pad(image, (0, side - image.shape[2], 0, side - image.shape[1]))[None]
            return torch.nn.functional.avg_pool2d(image.mean(1, keepdim=True), 4)

    return Encoder()


def decoder(side: int, multiple: bool) -> torch.nn.Module:
    class Decoder(torch.nn.Module):
        """Answers with what is bright between the two points, or besides with everything, before it and after it.

        Everything, the answer to a single point, fits best. Masks become those of the image as SAM's export does it.
        """

        def forward(self, image_embeddings, point_coords, point_labels, mask_input, has_mask_input, orig_im_size):
            at = torch.arange(side // 4) * 4 + 2.0
            (left, upper), (right, lower) = point_coords[0, 0], point_coords[0, 1]
            within = ((at >= left) & (at <= right))[None] & ((at >= upper) & (at <= lower))[:, None]
            bright = torch.where(within & (image_embeddings > 0.5), 1.0, -1.0) * (2 - has_mask_input)
            every = torch.ones_like(bright) + 0 * mask_input.sum()
            box = (point_labels[:, :1] - 1) * (point_labels[:, 1:] - 2)  # 1 for the labels 2 and 3
            low = torch.cat([every, bright, every, every], dim=1) if multiple else bright + 0 * every
            fits = torch.cat([box + 1, box, box * 0, box * 0.5], dim=1) if multiple else box
            large = torch.nn.functional.interpolate(low, size=(side, side), mode="bilinear", align_corners=False)
            inner = torch.floor(orig_im_size * side / torch.max(orig_im_size) + 0.5).to(torch.int64)
            cut = large[..., : inner[0], : inner[1]]
            height, width = orig_im_size.to(torch.int64)
            masks = torch.nn.functional.interpolate(cut, size=[height, width], mode="bilinear", align_corners=False)
            return masks, fits, low

    return Decoder()


def exported_pair(folder: Path, side: int, *, pixels: bool, multiple: bool) -> dict[str, str]:
    """Writes an encoder and a decoder with the names of MobileSAM's exports."""
    files = {name: str(folder / f"{name}.onnx") for name in ("encoder", "model")}
    options = {"opset_version": 17, "dynamo": False}
    shown = torch.rand((768, 1024, 3) if pixels else (1, 3, side, side))
    axes = {"input_image": {0: "image_height", 1: "image_width"}} if pixels else None
    torch.onnx.export(
        encoder(side, pixels), (shown,), files["encoder"], input_names=["input_image"], dynamic_axes=axes, **options
    )
    shapes = {
        "image_embeddings": (1, 1, side // 4, side // 4),
        "point_coords": (1, 2, 2),
        "point_labels": (1, 2),
        "mask_input": (1, 1, side // 4, side // 4),
        "has_mask_input": (1,),
    }
    given = (*(torch.rand(shape) for shape in shapes.values()), torch.tensor([60.0, 80.0]))
    torch.onnx.export(
        decoder(side, multiple),
        given,
        files["model"],
        input_names=[*shapes, "orig_im_size"],
        output_names=["masks", "iou_predictions", "low_res_masks"],
        dynamic_axes={"point_coords": {1: "num_points"}, "point_labels": {1: "num_points"}},
        **options,
    )
    return files


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("multiple", [False, True], ids=["one mask", "all masks"])
@pytest.mark.parametrize(("side", "pixels"), [(64, False), (1024, True)], ids=["padded", "pixels"])
def test_encoder_and_decoder_in_two_files_mask_the_bright_pixels_of_each_box(
    tmp_path: Path, side: int, pixels: bool, multiple: bool
) -> None:
    made = BoxSegmenter(**exported_pair(tmp_path, side, pixels=pixels, multiple=multiple))
    made.setup()
    found = made.process(image(), detections())
    first, dark, surest = (found.mask(k) for k in range(3))
    assert first[12:28, 43:58].all()
    assert not first[:, :38].any()
    assert not dark.any()
    assert surest[43:58, 53:78].all()


@pytest.mark.filterwarnings("ignore")
def test_a_decoder_of_other_inputs_is_refused(tmp_path: Path) -> None:
    files = exported_pair(tmp_path, 64, pixels=False, multiple=False)
    with pytest.raises(ModelError, match=r"must take has_mask_input, .*; it takes input_image"):
        BoxSegmenter(model=files["encoder"], encoder=files["encoder"]).setup()
