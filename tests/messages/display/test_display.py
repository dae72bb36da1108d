"""Messages in notebooks: HTML, and pictures that other programs read back."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest
from example_messages import example

from dataflow.messages import (
    CompressedImage,
    DepthImage,
    Image,
    Imu,
    Message,
    OccupancyGrid,
    PointCloud,
    SegmentationMap,
    Text,
)
from dataflow.messages.base import is_built_in, message_types
from dataflow.messages.display.pictures import png, turbo

RED, BLUE = (2, 0)
"""Channels as OpenCV decodes them."""


def decoded(message: Message) -> np.ndarray:
    file = message._repr_png_()
    assert file is not None
    return cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (3, 4, 3)])
def test_a_png_holds_the_pixels(shape: tuple[int, ...]) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    read = cv2.imdecode(np.frombuffer(png(pixels), np.uint8), cv2.IMREAD_UNCHANGED)

    np.testing.assert_array_equal(read[..., ::-1] if pixels.ndim == 3 else read, pixels)


def test_other_arrays_are_no_png() -> None:
    with pytest.raises(ValueError, match=r"got float32 \(2, 2\)"):
        png(np.zeros((2, 2), np.float32))


def test_an_image_is_shown_as_it_is() -> None:
    data = np.zeros((4, 6, 3), np.uint8)
    data[1, 2] = (255, 0, 0)

    assert decoded(Image(stamp=1, frame="c", data=data))[1, 2].tolist() == [0, 0, 255]


def test_a_large_image_is_thinned() -> None:
    assert decoded(Image(stamp=1, frame="c", data=np.zeros((1000, 2000), np.uint8))).shape == (334, 667)


def test_near_depth_is_red_far_depth_blue_and_no_return_black() -> None:
    depth = np.tile(np.linspace(1, 5, 9, dtype=np.float32), (3, 1))
    depth[0, 0] = 0
    shown = decoded(DepthImage(stamp=1, frame="c", data=depth))

    assert shown[0, 0].tolist() == [0, 0, 0]
    assert shown[1, 0, RED] > shown[1, 0, BLUE]
    assert shown[1, -1, BLUE] > shown[1, -1, RED]


def test_depth_without_any_return_is_black() -> None:
    assert not decoded(DepthImage(stamp=1, frame="c", data=np.zeros((2, 2), np.float32))).any()


def test_classes_have_distinct_colours() -> None:
    classes = np.arange(12, dtype=np.uint8).reshape(3, 4)
    shown = decoded(SegmentationMap(stamp=1, frame="c", class_names=tuple("abcdefghijkl"), classes=classes))

    assert len({tuple(color) for color in shown.reshape(-1, 3).tolist()}) == 12


def test_a_grid_has_free_occupied_and_unknown_cells_with_y_upwards() -> None:
    cells = np.array([[0, 100], [-1, 0]], np.int8)
    shown = decoded(OccupancyGrid(stamp=1, frame="map", resolution=0.1, cells=cells, position=[0, 0, 0]))

    assert shown.tolist() == [[128, 255], [255, 0]]


def test_a_cloud_is_seen_from_above_with_x_up_and_y_to_the_left() -> None:
    ahead, left, behind, right, none = [3, 0, 0], [0, 3, 1], [-3, 0, 2], [0, -3, 1], [np.nan, 0, 0]
    shown = decoded(PointCloud(stamp=1, frame="base", points=[ahead, left, behind, right, none]))

    rows, columns = np.nonzero(shown.any(axis=2))
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [(3, 179), (179, 3), (179, 355), (355, 179)]


def test_an_empty_cloud_is_black() -> None:
    assert not decoded(PointCloud(stamp=1, frame="base", points=np.zeros((0, 3)))).any()


def test_a_compressed_image_is_shown_as_the_file_that_it_is() -> None:
    _, file = cv2.imencode(".jpg", np.zeros((4, 4, 3), np.uint8))
    message = CompressedImage(stamp=1, frame="c", format="jpeg", data=file.ravel())

    assert message._repr_png_() is None
    (shown,) = re.findall(r"data:image/jpeg;base64,([^\"]+)", message._repr_html_())
    assert base64.b64decode(shown) == file.tobytes()


def test_fields_are_escaped_and_absent_ones_left_out() -> None:
    assert "&lt;script&gt;" in Text(stamp=1, text="<script>")._repr_html_()
    text = Imu(stamp=1, frame="imu", angular_velocity=[0, 0, 1], linear_acceleration=[0, 0, 0])._repr_html_()
    assert "angular_velocity" in text
    assert "orientation" not in text


def test_every_type_is_shown() -> None:
    for cls in (c for c in message_types().values() if is_built_in(c)):
        for message in (example(cls, seed) for seed in range(3)):
            assert cls.SCHEMA in message._repr_html_()
            assert message._repr_png_() is None or decoded(message) is not None, cls


def test_colours_run_from_blue_to_red_and_nan_is_black() -> None:
    low, high, none = turbo(np.array([0.1, 0.9, np.nan]))
    assert low[2] > low[0]
    assert high[0] > high[2]
    assert none.tolist() == [0, 0, 0]
