"""Decoding of compressed images: what was encoded comes back, and damage is named."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dataflow.messages import CompressedDepth, CompressedImage, DepthImage, Image
from operators.codec import DepthDecoder, ImageDecoder

STAMP = 42


def ramp(height: int = 24, width: int = 32) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    return np.stack([8 * columns, 8 * rows, np.full_like(rows, 40)], axis=-1).astype(np.uint8)


def encoded(pixels: np.ndarray, extension: str) -> np.ndarray:
    bgr = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    return cv2.imencode(extension, bgr)[1].reshape(-1)


def depth_file(levels: np.ndarray) -> np.ndarray:
    return cv2.imencode(".png", levels)[1].reshape(-1)


def test_png_comes_back_bit_by_bit() -> None:
    message = CompressedImage(stamp=STAMP, frame="cam", format="png", data=encoded(ramp(), ".png"))
    assert ImageDecoder().process(message) == Image(stamp=STAMP, frame="cam", data=ramp())


def test_jpeg_keeps_the_order_of_its_channels() -> None:
    message = CompressedImage(stamp=STAMP, frame="cam", format="jpeg", data=encoded(ramp(), ".jpg"))
    image = ImageDecoder().process(message)
    assert np.abs(image.data.astype(int) - ramp()).mean() < 3


def test_a_grey_file_is_a_grey_image() -> None:
    message = CompressedImage(stamp=STAMP, frame="cam", format="png", data=encoded(ramp()[..., 0], ".png"))
    assert ImageDecoder().process(message).data.shape == (24, 32)


def test_linear_depth_is_scaled_and_zero_is_no_return() -> None:
    levels = np.array([[0, 1], [1000, 65535]], np.uint16)
    message = CompressedDepth(stamp=STAMP, frame="cam", scale=0.001, offset=0.5, data=depth_file(levels))
    expected = np.array([[0, 0.501], [1.5, 66.035]], np.float32)
    assert DepthDecoder().process(message) == DepthImage(stamp=STAMP, frame="cam", data=expected)


def test_inverse_depth_follows_its_formula() -> None:
    levels = np.array([[0, 5, 10], [110, 1010, 11]], np.uint16)
    message = CompressedDepth(
        stamp=STAMP, frame="cam", quantizer="inverse", scale=100.0, offset=10.0, data=depth_file(levels)
    )
    np.testing.assert_array_equal(DepthDecoder().process(message).data, np.float32([[0, 0, 0], [1.0, 0.1, 100.0]]))


@pytest.mark.parametrize("kept", [30, 100, -1])
def test_a_depth_file_cut_short_is_named_by_its_stamp(kept: int) -> None:
    levels = np.random.default_rng(0).integers(0, 9000, (9, 9)).astype(np.uint16)
    message = CompressedDepth(stamp=STAMP, frame="cam", scale=1.0, data=depth_file(levels)[:kept])
    with pytest.raises(ValueError, match="CompressedDepth at stamp 42"):
        DepthDecoder().process(message)


@pytest.mark.parametrize(("extension", "name"), [(".png", "png"), (".jpg", "jpeg"), (".webp", "webp")])
def test_an_image_file_cut_short_is_refused(extension: str, name: str) -> None:
    whole = encoded(ramp(), extension)
    assert ImageDecoder().process(CompressedImage(stamp=STAMP, frame="cam", format=name, data=whole)).width == 32
    half = CompressedImage(stamp=STAMP, frame="cam", format=name, data=whole[: 2 * len(whole) // 3])
    with pytest.raises(ValueError, match="damaged or cut short"):
        ImageDecoder().process(half)


def test_an_image_larger_than_allowed_is_refused() -> None:
    message = CompressedImage(stamp=STAMP, frame="cam", format="png", data=encoded(ramp(), ".png"))
    with pytest.raises(ValueError, match="max_pixels=100"):
        ImageDecoder(max_pixels=100).process(message)
