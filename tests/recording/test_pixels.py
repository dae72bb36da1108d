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


RANDOM = np.random.default_rng(1)
CODES = {
    "rggb": cv2.COLOR_BayerBG2RGB,
    "bggr": cv2.COLOR_BayerRG2RGB,
    "gbrg": cv2.COLOR_BayerGR2RGB,
    "grbg": cv2.COLOR_BayerGB2RGB,
}
"""OpenCV names a pattern by the second row's second and third pixel."""


@pytest.mark.parametrize("pattern", CODES)
@pytest.mark.parametrize("shape", [(6, 8), (7, 9), (3, 3)])
def test_bayer_mosaics_are_converted_as_by_opencv(pattern: str, shape: tuple[int, int]) -> None:
    mosaic = RANDOM.integers(0, 256, shape).astype(np.uint8)
    deep = RANDOM.integers(0, 65536, shape).astype("<u2")

    image = as_image(f"bayer_{pattern}8", rows(f"bayer_{pattern}8", mosaic))
    image16 = as_image16(f"bayer_{pattern}16", rows(f"bayer_{pattern}16", deep))

    np.testing.assert_array_equal(image, cv2.cvtColor(mosaic, CODES[pattern]))
    np.testing.assert_array_equal(image16, cv2.cvtColor(deep, CODES[pattern]))


@pytest.mark.parametrize("pattern", CODES)
def test_bayer_mosaic_of_one_colour_gives_that_colour_back(pattern: str) -> None:
    colour = {"r": 200, "g": 90, "b": 30}
    mosaic = np.zeros((6, 8), np.uint8)
    for place, letter in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = colour[letter]

    image = as_image(f"bayer_{pattern}8", rows(f"bayer_{pattern}8", mosaic))

    np.testing.assert_array_equal(image, np.full((6, 8, 3), [200, 90, 30]))


@pytest.mark.parametrize(
    ("encoding", "code"),
    [
        ("yuv422", cv2.COLOR_YUV2RGB_UYVY),
        ("uyvy", cv2.COLOR_YUV2RGB_UYVY),
        ("yuyv", cv2.COLOR_YUV2RGB_YUY2),
        ("yuv422_yuy2", cv2.COLOR_YUV2RGB_YUY2),
    ],
)
def test_packed_yuv_is_converted_as_by_opencv(encoding: str, code: int) -> None:
    stored = RANDOM.integers(0, 256, (64, 64, 2)).astype(np.uint8)

    np.testing.assert_array_equal(as_image(encoding, rows(encoding, stored)), cv2.cvtColor(stored, code))


@pytest.mark.parametrize(("encoding", "code"), [("nv12", cv2.COLOR_YUV2RGB_NV12), ("nv21", cv2.COLOR_YUV2RGB_NV21)])
@pytest.mark.parametrize("padding", [0, 6])
def test_planar_yuv_is_converted_as_by_opencv(encoding: str, code: int, padding: int) -> None:
    stored = RANDOM.integers(0, 256, (48, 64 + padding)).astype(np.uint8)
    width = 64

    found = as_image(encoding, stored_rows(encoding, width, 32, width + padding, stored.reshape(-1)))

    np.testing.assert_array_equal(found, cv2.cvtColor(np.ascontiguousarray(stored[:, :width]), code))


def test_planar_yuv_of_every_pixel_has_a_pair_for_each() -> None:
    grey, pairs = np.full((4, 6), 150, np.uint8), RANDOM.integers(0, 256, (4, 6, 2)).astype(np.uint8)
    data = np.concatenate([grey.reshape(-1), pairs.reshape(-1)])

    found = as_image("nv24", stored_rows("nv24", 6, 4, 0, data))

    planes = [cv2.resize(plane, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST) for plane in (grey, pairs)]
    expected = cv2.cvtColorTwoPlane(planes[0], pairs, cv2.COLOR_YUV2RGB_NV12)[::2, ::2]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("encoding", ["rgba16", "bgra16", "16UC4"])
def test_16_bit_colours_lose_their_alpha_channel_alone(encoding: str) -> None:
    deep = RANDOM.integers(0, 65536, (4, 6, 4)).astype("<u2")
    expected = deep[..., :3] if encoding == "rgba16" else cv2.cvtColor(deep, cv2.COLOR_BGRA2RGB)

    np.testing.assert_array_equal(as_image16(encoding, rows(encoding, deep)), expected)


@pytest.mark.parametrize(("encoding", "kind"), [("16SC1", "signed"), ("32FC3", "3 channels"), ("8UC2", "2 channels")])
def test_opencv_arrays_that_are_no_image_are_refused_with_valid_encodings(encoding: str, kind: str) -> None:
    with pytest.raises(RecordingError, match=f"{kind}.* is no image or depth here: 16UC1"):
        stored_rows(encoding, 4, 2, 0, np.zeros(500, np.uint8))


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


def test_mismatched_pixels_are_refused_with_their_numbers() -> None:
    with pytest.raises(RecordingError, match="needs rows of 12 bytes, got step 12 and 5 bytes"):
        stored_rows("rgb8", 4, 2, 0, np.zeros(5, np.uint8))
    with pytest.raises(RecordingError, match="'h264' is not known; those known are mono8"):
        stored_rows("h264", 4, 2, 0, np.zeros(5, np.uint8))
    with pytest.raises(RecordingError, match="it is a DepthImage"):
        as_image("32FC1", np.zeros((1, 1), np.float32))
