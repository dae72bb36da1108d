"""Raw pixels of every encoding become images and depth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dataflow.recording import RecordingError
from dataflow.recording.streams.pixels import as_depth, as_image, as_image16, stored_rows

RGB = np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8)


def rows(encoding: str, pixels: np.ndarray, **options: bool) -> np.ndarray:
    height, width = pixels.shape[:2]
    return stored_rows(encoding, width, height, 0, np.frombuffer(pixels.tobytes(), np.uint8), **options)


@pytest.mark.parametrize(
    ("encoding", "stored"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("8UC3", RGB[..., ::-1]),  # OpenCV's order
        ("rgba8", np.dstack([RGB, RGB[..., 0]])),
        ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., 0]])),
    ],
)
def test_colour_encodings_become_rgb(encoding: str, stored: np.ndarray) -> None:
    np.testing.assert_array_equal(as_image(encoding, rows(encoding, stored)), RGB)


def test_greys_stay_greys_and_16_bits_stay_16_bits() -> None:
    grey, deep = RGB[..., 0], RGB.astype("<u2") * 257 + 3

    np.testing.assert_array_equal(as_image("mono8", rows("mono8", grey)), grey)
    np.testing.assert_array_equal(as_image16("mono16", rows("mono16", deep[..., 0])), deep[..., 0])
    np.testing.assert_array_equal(as_image16("rgb16", rows("rgb16", deep)), deep)
    np.testing.assert_array_equal(as_image16("bgr16", rows("bgr16", deep[..., ::-1])), deep)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_mosaic_of_one_colour_gives_that_colour_back(pattern: str) -> None:
    colour = {"r": 200, "g": 90, "b": 30}
    mosaic = np.zeros((6, 8), np.uint8)
    for place, letter in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = colour[letter]

    image = as_image(f"bayer_{pattern}8", rows(f"bayer_{pattern}8", mosaic))

    np.testing.assert_array_equal(image, np.full((6, 8, 3), [200, 90, 30]))


@pytest.mark.parametrize(("encoding", "code"), [("yuv422", cv2.COLOR_YUV2RGB_UYVY), ("yuyv", cv2.COLOR_YUV2RGB_YUY2)])
def test_packed_yuv_of_full_range_lies_close_to_its_grey(encoding: str, code: int) -> None:
    grey = np.full((2, 4, 2), 128, np.uint8)
    grey[..., 1 if encoding == "yuv422" else 0] = 150

    assert (as_image(encoding, rows(encoding, grey)) == 150).all()
    assert cv2.cvtColor(grey, code).shape == (2, 4, 3)  # OpenCV takes the same layout


def test_depth_in_millimetres_becomes_metres() -> None:
    depth = np.array([[0, 1500], [65535, 3]], "<u2")

    np.testing.assert_allclose(as_depth("16UC1", rows("16UC1", depth)), [[0, 1.5], [65.535, 0.003]])


def test_big_endian_and_padded_rows() -> None:
    depth = np.array([[1000, 2000]], ">u2")
    assert as_depth("16UC1", rows("16UC1", depth, big_endian=True)).tolist() == [[1.0, 2.0]]
    padded = np.frombuffer(bytes([1, 2, 99, 3, 4, 99]), np.uint8)

    assert stored_rows("mono8", 2, 2, 3, padded).tolist() == [[1, 2], [3, 4]]


def test_padding_that_the_last_row_lacks_takes_no_memory() -> None:
    row = np.arange(3, dtype=np.uint8)
    assert stored_rows("mono8", 3, 1, 1 << 62, row).tolist() == [[0, 1, 2]]


def test_what_does_not_fit_is_refused_with_its_numbers() -> None:
    with pytest.raises(RecordingError, match="needs rows of 12 bytes, got step 12 and 5 bytes"):
        stored_rows("rgb8", 4, 2, 0, np.zeros(5, np.uint8))
    with pytest.raises(RecordingError, match="'h264' is not known; those known are mono8"):
        stored_rows("h264", 4, 2, 0, np.zeros(5, np.uint8))
    with pytest.raises(RecordingError, match="it is a DepthImage"):
        as_image("32FC1", np.zeros((1, 1), np.float32))
