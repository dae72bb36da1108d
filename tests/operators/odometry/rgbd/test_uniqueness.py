"""Whether a pose is believed where a pattern repeats: on a plane, along a corridor, and beside something in relief."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from operators.geometry import se3
from operators.monitoring.image_flaws import Watch
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.evidence import gathered
from operators.odometry.rgbd.frame import Frame, observe
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.relocalizer import believed
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import DepthNoise

Array = NDArray[np.float64]

FOCAL, WIDTH, HEIGHT = 260.0, 320, 240
K = np.array([[FOCAL, 0.0, 159.5], [0.0, FOCAL, 119.5], [0.0, 0.0, 1.0]])
CAMERA, CONFIG = RgbdCamera(K, K), RgbdOdometryConfig()
PERIOD = 0.75  # metres
TEXEL = 0.0075  # metres


def spots(width: float) -> NDArray[np.float32]:
    """A pattern of spots of every size, so many metres wide and high, which repeats without a seam."""
    rng, n = np.random.default_rng(3), round(width / TEXEL)
    total = np.zeros((n, n), np.float32)
    for spacing in (0.04, 0.12, 0.3):
        count = max(2, round(width / spacing))
        grid = np.pad(rng.random((count, count), np.float32), 2, mode="wrap")
        wide = cv2.resize(grid, None, fx=n / count, fy=n / count, interpolation=cv2.INTER_CUBIC)
        first = round(2 * n / count)
        total += wide[first : first + n, first : first + n] - 0.5
    return np.clip(128 + 130 * total, 0, 255).astype(np.float32)


def flat(X: Array, Y: Array) -> Array:
    return np.full_like(X, 2.0)


def groove(X: Array, Y: Array) -> Array:
    """Two walls that meet in a line along x, as those of a corridor do with its floor."""
    return 2.2 - 0.7 * np.abs(Y)


def roof(X: Array, Y: Array) -> Array:
    """A wall, and a pyramid on it."""
    return 2.0 - 0.5 * np.maximum(0.6 - np.maximum(np.abs(X - 0.3), np.abs(Y)), 0.0)


def corner(X: Array, Y: Array) -> Array:
    """Two walls that meet in a line along x, and a pyramid on that."""
    return groove(X, Y) - 0.5 * np.maximum(0.6 - np.maximum(np.abs(X - 0.3), np.abs(Y)), 0.0)


Shape = Callable[[Array, Array], Array]


def view(shape: Shape, texture: NDArray[np.float32], x: float) -> Frame:
    """What a camera at (x, 0, 0) sees that looks along z."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    a, b = (u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL
    z = np.full(a.shape, 2.0)
    for _ in range(40):
        z = shape(x + a * z, b * z)
    column, row = (np.asarray(w / TEXEL % len(texture), np.float32) for w in (x + a * z, b * z))
    image = cv2.remap(np.pad(texture, ((0, 1), (0, 1)), mode="wrap"), column, row, cv2.INTER_LINEAR)
    return observe(image.astype(np.uint8), z.astype(np.float32), 1_000_000_000, K, K, CONFIG, Watch())


def at(x: float) -> Array:
    return se3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0]))


def keyframe(shape: Shape, texture: NDArray[np.float32], x: float) -> Keyframe:
    frame, none = view(shape, texture, x), np.zeros((0, 3))
    return Keyframe(1, at(x), np.zeros((6, 6)), frame.gray, frame.surface, none[:, :2], none, np.zeros(0, np.int64))


def taken_for(shape: Shape, width: float, x: float, claimed: float) -> bool:
    """Whether a view from x is believed to be one from another x, in a map of two views."""
    texture = spots(width)
    known = [keyframe(shape, texture, k) for k in (-0.3, 0.4)]
    return believed(view(shape, texture, x), at(claimed), known, CAMERA, DepthNoise()) is not None


@pytest.mark.parametrize("off", [-PERIOD, 0.0, PERIOD])
def test_a_plane_whose_pattern_repeats_is_no_evidence_even_at_the_right_place(off: float) -> None:
    assert not taken_for(flat, PERIOD, 0.1, 0.1 + off)


def test_a_plane_whose_pattern_does_not_repeat_is_evidence() -> None:
    assert taken_for(flat, 6.0, 0.1, 0.1)


def test_relief_makes_sure_of_a_place_where_a_pattern_repeats() -> None:
    assert taken_for(roof, PERIOD, 0.1, 0.1)
    assert not taken_for(roof, PERIOD, 0.1, 0.1 - PERIOD)


@pytest.mark.parametrize("off", [-PERIOD, 0.0])
def test_a_corridor_whose_pattern_repeats_is_no_evidence(off: float) -> None:
    assert not taken_for(groove, PERIOD, 0.1, 0.1 + off)


def test_a_corridor_whose_pattern_does_not_repeat_is_evidence() -> None:
    assert taken_for(groove, 6.0, 0.1, 0.1)


def test_narrow_strip_of_a_plane_is_no_evidence() -> None:
    def strip(X: Array, Y: Array) -> Array:
        return np.where(np.abs(Y) < 0.2, 2.0, 1e3)  # which is no return

    assert not taken_for(strip, 6.0, 0.1, 0.1)


@pytest.mark.parametrize("same", [True, False])
def test_lookalike_wall_is_no_evidence_where_its_surroundings_differ(same: bool) -> None:
    there = spots(6.0)
    here = there.copy()
    if not same:
        half = len(here) // 2  # y < 0 wraps round to there
        here[half:] = np.roll(here[half:], round(1.7 / TEXEL), axis=1)
    known = [keyframe(corner, there, k) for k in (-0.3, 0.4)]
    frame = view(corner, here, 0.1)
    found = gathered(frame, at(0.1), known, CAMERA)
    assert found.agreement > 0.9
    assert found.likeness > 0.45
    assert (believed(frame, at(0.1), known, CAMERA, DepthNoise()) is not None) == same
