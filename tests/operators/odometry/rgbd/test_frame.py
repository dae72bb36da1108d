"""Images as the odometry works on them, and what it makes of those that show nothing new."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from operators.monitoring.image_flaws import Watch
from operators.odometry.mono.tracks import observe as observe_one
from operators.odometry.rgbd.frame import Frame, observe
from operators.odometry.rgbd.noise import DEPTH_BOUNDS, MEDIAN_OF_ONE, MEDIAN_OF_TWO, PIXEL_BOUNDS, RATE, Noise
from operators.odometry.rgbd.settings import RgbdOdometryConfig

K = np.array([[500.0, 0.0, 322.0], [0.0, 500.0, 239.0], [0.0, 0.0, 1.0]])
RNG = np.random.default_rng(0)
GRAY = cv2.resize(RNG.integers(0, 255, (60, 80)).astype(np.uint8), (655, 487), interpolation=cv2.INTER_CUBIC)
DEPTH = np.asarray(2.0 + np.arange(480)[:, None] * 1e-3 + np.zeros((1, 640)), np.float32)


def seen(image: NDArray[np.uint8], depth: NDArray[np.float32], last: Watch | None = None) -> Frame:
    return observe(image, depth, 5, K, K, RgbdOdometryConfig(image_width=300, surface_width=160), last or Watch())


def test_images_and_calibration_are_reduced_by_whole_factors() -> None:
    """655 columns by two, the odd last ones left out; 640 of depth by four."""
    frame = seen(GRAY, DEPTH)
    assert frame.gray.shape == (243, 327)
    expected = GRAY[:486, :654].reshape(243, 2, 327, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(frame.gray, expected, atol=1.0)
    np.testing.assert_allclose(frame.K_color, [[250, 0, 160.75], [0, 250, 119.25], [0, 0, 1]])
    assert frame.surface.inverse_depth.shape == (120, 160)
    np.testing.assert_allclose(frame.surface.K, [[125, 0, 80.125], [0, 125, 59.375], [0, 0, 1]])
    assert (frame.stamp, frame.flaws) == (5, "")
    assert frame.depth is DEPTH
    one = observe_one(GRAY, 5, K, 200, Watch(), None)
    assert one.gray.shape == (162, 218)
    np.testing.assert_allclose(one.K, [[500 / 3, 0, 107], [0, 500 / 3, 79 + 1 / 3], [0, 0, 1]])
    small = observe_one(GRAY, 5, K, 700, Watch(), None)
    np.testing.assert_array_equal(small.gray, GRAY)
    np.testing.assert_array_equal(small.K, K)


def test_a_colour_image_is_taken_as_grey() -> None:
    grey = seen(np.repeat(GRAY[:, :, None], 3, axis=2), DEPTH)
    np.testing.assert_allclose(grey.gray, seen(GRAY, DEPTH).gray, atol=1)
    red = np.zeros((*GRAY.shape, 3), np.uint8)
    red[:, :, 0] = GRAY
    np.testing.assert_allclose(seen(red, DEPTH).gray.mean(), 0.299 * GRAY.mean(), rtol=0.02)


def test_black_empty_or_repeated_images_are_named_as_flaws() -> None:
    first = seen(GRAY, DEPTH)
    later = GRAY.copy()
    later[0, 0] ^= 1
    cases = {
        "image is black": (np.zeros_like(GRAY), DEPTH + np.float32(0.01)),
        "image repeats the last one": (GRAY, DEPTH + np.float32(0.01)),
        "depth repeats the last one": (later, DEPTH),
        "depth has no return": (later, np.zeros_like(DEPTH)),
        "image repeats the last one; depth repeats the last one": (GRAY, DEPTH),
        "": (later, DEPTH + np.float32(0.01)),
    }
    for flaws, (image, depth) in cases.items():
        frame = seen(image, depth, first.watch)
        assert frame.flaws == flaws
        assert frame.gray.any() == ("image" not in flaws)
        assert frame.surface.inverse_depth.any() == ("depth" not in flaws)


# -- the noise of what is measured ---------------------------------------------------------------------------


def test_noise_is_learnt_from_the_residuals_of_frames_within_bounds() -> None:
    """Tracks err by twice, depths by half of what was believed: medians of squares, in units of that."""
    noise = Noise(0.5, 1.2).after(4.0 * MEDIAN_OF_TWO, 0.25 * MEDIAN_OF_ONE)
    assert noise.pixel == pytest.approx(0.5 + RATE * 0.5)
    assert noise.depth == pytest.approx(1.2 - RATE * 0.6)
    for _ in range(100):
        noise = noise.after(4.0 * MEDIAN_OF_TWO, 0.25 * MEDIAN_OF_ONE)
    assert (noise.pixel, noise.depth) == (PIXEL_BOUNDS[1], DEPTH_BOUNDS[0])
    assert Noise(0.5, 1.2).after(None, None) == Noise(0.5, 1.2)
    assert Noise(0.5).missed(9.0 * MEDIAN_OF_TWO) == pytest.approx(1.5)
    assert Noise(0.5).missed(None) == 0.5


def test_the_medians_are_those_of_normal_errors() -> None:
    drawn = RNG.normal(size=(200_000, 2)) ** 2
    assert np.median(drawn[:, 0]) == pytest.approx(MEDIAN_OF_ONE, rel=0.01)
    assert np.median(drawn.sum(axis=1)) == pytest.approx(MEDIAN_OF_TWO, rel=0.01)
