"""Detections drawn into images."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.messages import Detections2D, Image, pack_masks
from operators.detection import draw_detections
from operators.detection.drawing import color_of

NAMES = ("mug", "book")


def detections(boxes: list[list[float]], width: int = 120, ids: list[int] | None = None) -> Detections2D:
    return Detections2D(
        stamp=7,
        frame="camera",
        width=width,
        height=90,
        class_names=NAMES,
        boxes=np.array(boxes, np.float32).reshape(-1, 4),
        scores=np.linspace(0.5, 0.9, len(boxes), dtype=np.float32),
        class_ids=np.arange(len(boxes), dtype=np.int32) % 2,
        ids=None if ids is None else np.array(ids, np.int64),
    )


def grey(shape: tuple[int, ...] = (90, 120, 3)) -> Image:
    return Image(stamp=7, frame="camera", data=np.full(shape, 90, np.uint8))


def test_edges_have_the_colour_of_their_class_and_all_else_stays() -> None:
    image = grey()
    drawn = draw_detections(image, detections([[20, 40, 60, 80], [70, 30, 110, 70]], ids=[4, 5]))
    assert drawn.data[80, 40].tolist() == list(color_of("mug"))
    assert drawn.data[70, 90].tolist() == list(color_of("book"))
    assert (drawn.data[50:75, 25:55] == 90).all()
    assert (image.data == 90).all()
    assert (drawn.stamp, drawn.frame) == (7, "camera")


def test_a_mask_tints_its_pixels_alone() -> None:
    pixels = np.zeros((1, 90, 120), bool)
    pixels[0, 50:60, 30:40] = True
    drawn = draw_detections(grey(), detections([[20, 40, 60, 80]]).replace(masks=pack_masks(pixels))).data
    tinted = ((np.array(color_of("mug"), np.float32) + 90) / 2).astype(np.uint8)
    assert (drawn[50:60, 30:40] == tinted).all()
    assert (drawn[60:75, 30:40] == 90).all()


def test_grey_image_without_detections_is_converted_to_colour_unmarked() -> None:
    drawn = draw_detections(grey((90, 120)), detections([]))
    assert drawn.data.shape == (90, 120, 3)
    assert (drawn.data == 90).all()


def test_boxes_that_reach_beyond_the_image_are_drawn_as_far_as_it_goes() -> None:
    drawn = draw_detections(grey(), detections([[-30, -20, 400, 300], [110, 0, 125, 5]]))
    assert drawn.data.shape == (90, 120, 3)


def test_boxes_of_another_image_are_refused() -> None:
    with pytest.raises(ValueError, match="160x90 pixels cannot be drawn into one of 120x90"):
        draw_detections(grey(), detections([[1, 2, 3, 4]], width=160))
