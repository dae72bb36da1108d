"""Decoding of compressed images: what was encoded comes back, and damage is named."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dataflow.messages import CompressedDepth, CompressedImage, DepthImage, Image, Level
from dataflow.testing import play
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


def test_png_decodes_bit_for_bit() -> None:
    message = CompressedImage(stamp=STAMP, frame="cam", format="png", data=encoded(ramp(), ".png"))
    assert ImageDecoder().decode(message) == Image(stamp=STAMP, frame="cam", data=ramp())


def test_jpeg_keeps_the_order_of_its_channels() -> None:
    message = CompressedImage(stamp=STAMP, frame="cam", format="jpeg", data=encoded(ramp(), ".jpg"))
    image = ImageDecoder().decode(message)
    assert np.abs(image.data.astype(int) - ramp()).mean() < 3


def test_a_grey_file_is_a_grey_image() -> None:
    message = CompressedImage(stamp=STAMP, frame="cam", format="png", data=encoded(ramp()[..., 0], ".png"))
    assert ImageDecoder().decode(message).data.shape == (24, 32)


def test_linear_depth_is_scaled_and_zero_is_no_return() -> None:
    levels = np.array([[0, 1], [1000, 65535]], np.uint16)
    message = CompressedDepth(stamp=STAMP, frame="cam", scale=0.001, offset=0.5, data=depth_file(levels))
    expected = np.array([[0, 0.501], [1.5, 66.035]], np.float32)
    assert DepthDecoder().decode(message) == DepthImage(stamp=STAMP, frame="cam", data=expected)


def test_inverse_depth_follows_its_formula() -> None:
    levels = np.array([[0, 5, 10], [110, 1010, 11]], np.uint16)
    message = CompressedDepth(
        stamp=STAMP, frame="cam", quantizer="inverse", scale=100.0, offset=10.0, data=depth_file(levels)
    )
    np.testing.assert_array_equal(DepthDecoder().decode(message).data, np.float32([[0, 0, 0], [1.0, 0.1, 100.0]]))


@pytest.mark.parametrize("kept", [30, 100, -1])
def test_a_depth_file_cut_short_is_named_by_its_stamp(kept: int) -> None:
    levels = np.random.default_rng(0).integers(0, 9000, (9, 9)).astype(np.uint16)
    message = CompressedDepth(stamp=STAMP, frame="cam", scale=1.0, data=depth_file(levels)[:kept])
    with pytest.raises(ValueError, match="CompressedDepth at stamp 42"):
        DepthDecoder().decode(message)
    played = play(DepthDecoder(), {"compressed": [message]})
    assert (played["depth"], [status.stamp for status in played["status"]]) == ([], [STAMP])


def test_an_image_larger_than_allowed_is_refused() -> None:
    message = CompressedImage(stamp=STAMP, frame="cam", format="png", data=encoded(ramp(), ".png"))
    with pytest.raises(ValueError, match="max_pixels=100"):
        ImageDecoder(max_pixels=100).decode(message)


@pytest.mark.parametrize(("extension", "name"), [(".png", "png"), (".jpg", "jpeg"), (".webp", "webp")])
def test_a_file_that_cannot_be_decoded_is_passed_over_and_reported(extension: str, name: str) -> None:
    whole = encoded(ramp(), extension)
    data = [whole, whole[: len(whole) // 2], whole, whole]
    messages = [CompressedImage(stamp=k, frame="cam", format=name, data=d) for k, d in enumerate(data, 1)]

    made = play(ImageDecoder(), {"compressed": messages})

    assert [image.stamp for image in made["image"]] == [1, 3, 4]
    (status,) = made["status"]
    assert status.stamp == 2
    assert status.levels.tolist() == [Level.WARN]
    assert "damaged or cut short" in status.messages[0]


def test_bytes_behind_a_file_do_no_harm_and_the_end_of_a_preview_is_not_its_end() -> None:
    whole = encoded(ramp(), ".jpg").tobytes()
    preview = b"\xff\xe1" + (2 + 6).to_bytes(2, "big") + b"\xff\xd8..\xff\xd9"
    cases = [
        (whole + b"\x0d\x0a padding", True),
        (whole[:2] + preview + whole[2:], True),
        (whole[:2] + preview + whole[2 : len(whole) // 2], False),
        (encoded(ramp(), ".png").tobytes() + b"12345", True),
    ]
    for stamp, (data, decodes) in enumerate(cases, 1):
        name = "png" if data.startswith(b"\x89PNG") else "jpeg"
        message = CompressedImage(stamp=stamp, frame="cam", format=name, data=np.frombuffer(data, np.uint8))
        assert list(ImageDecoder().process(message)) == (["image"] if decodes else ["status"]), stamp


def test_a_dead_camera_fills_the_status_and_not_the_log(caplog: pytest.LogCaptureFixture) -> None:
    broken = encoded(ramp(), ".jpg")[:-9]
    files = [CompressedImage(stamp=STAMP + k, frame="cam", format="jpeg", data=broken) for k in range(40)]

    out = play(ImageDecoder(), {"compressed": files})

    assert len(out["status"]) == 40
    assert len(caplog.messages) == 6
    assert caplog.messages[-1].endswith("passed over (32 so far)")
