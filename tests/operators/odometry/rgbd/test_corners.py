"""A keyframe's corners are looked for once more where few of them agree."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels, project
from operators.odometry.features import LK_LEVELS
from operators.odometry.rgbd import corners
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.corners import OLDEST, Corners, followed
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.movers import Movers
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import DepthNoise, Surface

K = np.array([[250.0, 0.0, 160.0], [0.0, 250.0, 120.0], [0.0, 0.0, 1.0]])
GRAY = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)


def keyframe() -> tuple[Keyframe, Pixels]:
    """A keyframe of 60 corners, and where a camera sees them that has gone 4 cm aside and 5 cm ahead."""
    rng = np.random.default_rng(1)
    pixels = np.column_stack([rng.uniform(20, 300, 60), rng.uniform(20, 220, 60)])
    depth = rng.uniform(1.5, 4.0, 60)
    points = np.column_stack([(pixels - K[:2, 2]) / K[0, 0] * depth[:, None], depth])
    made = Keyframe(
        0, np.eye(4), np.zeros((6, 6)), GRAY, Surface(np.full((60, 80), 0.5, np.float32), K), pixels, points,
        np.ones(60, np.int64),
    )  # fmt: skip
    return made, project(points - [0.04, 0.0, 0.05], K)


@pytest.mark.parametrize(("astray", "looks"), [(20, [LK_LEVELS]), (40, [LK_LEVELS, 0])])
def test_corners_that_were_led_astray_are_looked_for_near_the_guess(
    astray: int, looks: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    known, there = keyframe()
    asked: list[int] = []

    def track(a: object, b: object, pixels: Pixels, guess: Pixels, levels: int) -> tuple[Pixels, NDArray[np.bool_]]:
        asked.append(levels)
        ends = there.copy()
        if levels:
            ends[:astray] += np.random.default_rng(2).uniform(-60, 60, (astray, 2))
        return ends, np.ones(len(ends), bool)

    monkeypatch.setattr(corners, "track_corners", track)
    fitter = Fitter(RgbdCamera(K, K), RgbdOdometryConfig(), Noise())

    found = followed(GRAY, known, there, fitter)

    assert asked == looks
    assert len(found.pixels) >= (60 - astray if len(looks) == 1 else 60)
    assert np.allclose(found.T_world_camera[:3, 3], [0.04, 0.0, 0.05], atol=1e-3)


def test_a_frame_in_which_nothing_is_found_has_no_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    known, there = keyframe()
    nothing = np.zeros(len(there), bool)
    monkeypatch.setattr(corners, "track_corners", lambda *given: (there, nothing))

    assert followed(GRAY, known, there, Fitter(RgbdCamera(K, K), RgbdOdometryConfig(), Noise())) is None


# -- corners from keyframe to keyframe -----------------------------------------------------------------------

PLACES = np.array([[60.0, 60.0], [160.0, 120.0], [250.0, 200.0]])


def wall(depth: float) -> NDArray[np.float32]:
    return np.full((240, 320), depth, np.float32)


def at(depth: float) -> NDArray[np.float64]:
    return np.column_stack([(PLACES - K[:2, 2]) / K[0, 0] * depth, np.full(len(PLACES), depth)])


def test_a_corner_takes_its_depth_from_the_first_layer_that_has_one() -> None:
    holes = wall(2.0)
    holes[:, 100:] = 0.0
    points, known = corners.depths_at(PLACES, [(RgbdCamera(K, K), holes), (RgbdCamera(K, K), wall(3.0))], 0.3, 6.0)
    assert known.all()
    np.testing.assert_allclose(points[0], at(2.0)[0])
    np.testing.assert_allclose(points[1:], at(3.0)[1:])
    assert not corners.depths_at(PLACES, [], 0.3, 6.0)[1].any()


def test_corner_point_averages_keyframe_depths_and_contradicted_ones_are_dropped() -> None:
    """Two keyframes have confirmed the first; the second is new, the third was seen for long."""
    ages, noise = np.array([2, 0, OLDEST]), DepthNoise(0.004, 0.0)
    kept = Corners(PLACES, at(2.0), ages)
    near = corners.renewed(kept, [(RgbdCamera(K, K), wall(2.012))], 0.3, 6.0, noise, 1.0)
    np.testing.assert_allclose(near.points[:, 2], [2.0 + 0.012 / 4, 2.0 + 0.012 / 2, 2.0 + 0.012 / 12], atol=1e-6)
    assert near.ages.tolist() == [3, 1, OLDEST]
    reach = 3 * np.sqrt(2) * 0.004 + 0.01
    for off, stay in ((0.95 * reach, 3), (1.05 * reach, 0)):
        assert len(corners.renewed(kept, [(RgbdCamera(K, K), wall(2.0 + off))], 0.3, 6.0, noise, 1.0).pixels) == stay
    assert len(corners.renewed(kept, [(RgbdCamera(K, K), wall(2.0 + reach))], 0.3, 6.0, noise, 2.0).pixels) == 3
    blind = corners.renewed(kept, [], 0.3, 6.0, noise, 1.0)
    np.testing.assert_array_equal(blind.points, kept.points)


def test_new_corners_have_depth_are_static_and_apart_from_kept_ones() -> None:
    kept, still = Corners(PLACES[:1], at(2.0)[:1], np.array([4])), Movers.none(K, (240, 320))
    depth = wall(2.0)
    depth[:, 200:] = 0.0
    layers = [(RgbdCamera(K, K), depth)]
    found = corners.with_new(GRAY, kept, 80, layers, 0.3, 6.0, still)
    assert 20 < len(found.pixels) <= 80
    assert (found.pixels[0].tolist(), found.ages[0], found.ages[1:].any()) == (PLACES[0].tolist(), 4, False)
    assert found.pixels[:, 0].max() < 200
    apart = np.linalg.norm(found.pixels[:, None] - found.pixels[None], axis=2) + 99 * np.eye(len(found.pixels))
    assert apart.min() > 10
    moving = still.around(found.points[1:2])
    left = corners.with_new(GRAY, kept, 80, layers, 0.3, 6.0, moving)
    assert 1 <= len(left.pixels) < len(found.pixels)
    assert not moving.hold(left.points[1:]).any()
