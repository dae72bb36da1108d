"""Where a camera is expected by its motion so far, and how surely."""

from __future__ import annotations

import numpy as np
import pytest

from operators.geometry import se3
from operators.odometry.motion import UNKNOWN_SPEED, Motion

TENTH = 100_000_000  # ns
DECAY = 0.3  # seconds
TWIST = np.array([0.5, -0.2, 0.1, 0.1, 0.4, -0.2])  # m/s and rad/s
AHEAD = np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0])


def steady(twist: np.ndarray) -> Motion:
    """A motion of which two poses, a tenth of a second apart, are measured."""
    return Motion(0, np.eye(4), np.zeros(6)).measured(TENTH, se3.exp(0.1 * twist))


def blind(motion: Motion, *tenths: int) -> Motion:
    """The motion after frames at tenths of a second that measure nothing."""
    for k in tenths:
        motion = motion.guessed(k * TENTH, motion.predict(k * TENTH, DECAY))
    return motion


def test_a_steady_motion_is_predicted_to_go_on() -> None:
    motion = steady(TWIST)
    np.testing.assert_allclose(motion.velocity, TWIST)
    np.testing.assert_allclose(motion.predict(3 * TENTH, DECAY), se3.exp(0.3 * TWIST), atol=1e-12)


def test_blind_motion_decays_independently_of_the_frame_rate() -> None:
    ways = [blind(steady(AHEAD), *frames).T_world_camera[0, 3] for frames in [(2, 3, 4, 5, 6), (2, 6), (2, 4, 6)]]
    assert ways == pytest.approx([ways[0]] * 3)
    before = blind(steady(AHEAD), 2, 6)
    later = blind(before, 60).T_world_camera[0, 3]
    assert 0.16 + 0.8 * 0.05 < ways[0] < later < 0.16 + 0.8 * DECAY


def test_prediction_spread_grows_with_the_blind_time_squared() -> None:
    motion, sum_ = steady(TWIST), np.zeros(6)
    for k in (2, 3, 5, 8):
        sum_ += np.sqrt(np.diag(motion.spread(k * TENTH, 3.0, 7.0)))
        motion = blind(motion, k)
    np.testing.assert_allclose(sum_, 0.5 * 0.7**2 * np.array([3.0] * 3 + [7.0] * 3))


def test_a_camera_that_was_seen_once_may_already_move() -> None:
    once = Motion(0, np.eye(4), np.zeros(6))
    expected = 0.5 * 3.0 * 0.04 + 0.2 * UNKNOWN_SPEED
    np.testing.assert_allclose(np.sqrt(np.diag(once.spread(2 * TENTH, 3.0, 3.0))), expected)
    short, still = blind(once, 1).measured(2 * TENTH, np.eye(4)), once.measured(TENTH, np.eye(4))
    assert (short.fresh, still.fresh) == (True, False)


def test_a_velocity_outlasts_a_short_blindness_and_no_long_one() -> None:
    """The way across a gap is no measurement of the velocity: it holds a guess."""
    elsewhere = se3.exp(np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    short = blind(steady(TWIST), 2).measured(3 * TENTH, elsewhere)
    np.testing.assert_allclose(short.velocity, TWIST)
    long = blind(steady(TWIST), 2, 3).measured(4 * TENTH, elsewhere)
    np.testing.assert_array_equal(long.velocity, np.zeros(6))
    assert (short.fresh, long.fresh, short.blind_s, long.blind_s) == (False, True, 0.0, 0.0)
