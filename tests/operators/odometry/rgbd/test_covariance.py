"""How far a pose of RGB-D odometry can be trusted, by what supports it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from operators.geometry import se3
from operators.geometry.se3 import Vector
from operators.odometry.rgbd.fitting import Fit, Sighting
from operators.odometry.rgbd.keyframe import SINKING, TURNING, Keyframe, carried
from operators.odometry.rgbd.movers import Movers
from operators.odometry.rgbd.noise import AGREED, Noise
from operators.odometry.rgbd.surface import Surface
from operators.odometry.tracking import moved_covariance

K = np.array([[260.0, 0.0, 39.5], [0.0, 260.0, 29.5], [0.0, 0.0, 1.0]])


def supported(tracks: float, depth: float, noise: Noise, missed: float = 0.3, recognised: bool = False) -> Fit:
    """A fit to a hundred features and a thousand depths, of which shares agree."""
    agree = round(100 * tracks)
    sighting = Sighting(
        np.eye(4), np.zeros((agree, 3)), np.zeros((agree, 2)), np.zeros(agree, np.int64), 100, recognised
    )
    still = Movers.none(K, (60, 80))
    agreeing = round(1000 * depth)
    return Fit(np.eye(4), np.eye(6), np.eye(6), agree, 1000, 1000, agreeing, noise, missed, still, sighting)


def sigma2(tracks: float, depth: float, noise: float = 0.3, missed: float = 0.3, recognised: bool = False) -> float:
    return float(np.trace(supported(tracks, depth, Noise(noise, 1.0), missed, recognised).covariance))


def test_a_pose_that_tracks_and_depth_contradict_is_less_certain() -> None:
    certain = sigma2(1.0, 1.0)
    assert sigma2(0.5, 1.0) == sigma2(1.0, 0.8) == certain
    assert 1.2 * certain < sigma2(0.8, 0.98) < sigma2(0.5, 0.9) < sigma2(0.3, 0.8)
    assert sigma2(0.5, 0.9) > 5 * certain


def test_disputed_pixels_inflate_the_covariance_with_the_gate() -> None:
    assert sigma2(0.5, 0.9, noise=1.0) > 4 * sigma2(0.5, 0.9, noise=0.3)
    assert sigma2(1.0, 1.0, noise=1.0) == sigma2(1.0, 1.0, noise=0.3)


def test_descriptors_that_pair_wrongly_contradict_nothing() -> None:
    assert sigma2(0.3, 0.98, recognised=True) == sigma2(0.9, 0.98, recognised=True) < sigma2(0.3, 0.98)


def test_missed_tracks_in_the_same_frame_inflate_the_covariance() -> None:
    """Not where those of earlier frames did, or where none were seen yet."""
    assert sigma2(1.0, 1.0, noise=0.3, missed=0.8) > 10 * sigma2(1.0, 1.0, noise=0.8, missed=0.3)


def test_a_pose_is_less_certain_where_tracks_and_depth_have_disagreed() -> None:
    """By more than they believe to err by: what draws them apart errs alike at every keyframe."""
    agreed, torn = (supported(1.0, 1.0, Noise(0.3, 1.0, by, by)).covariance for by in (AGREED, 4 * AGREED))
    np.testing.assert_allclose(torn, 16 * agreed)
    little = supported(1.0, 1.0, Noise(0.3, 1.0, 0.1 * AGREED, 0.1 * AGREED)).covariance
    np.testing.assert_array_equal(little, agreed)


def test_a_pose_by_tracks_alone_is_less_certain_by_what_they_differ_from_depth_once() -> None:
    """They believe less than both together, so the same disagreement is less of what they believe."""
    both, tracks = (supported(1.0, 1.0, Noise(0.3, 1.0, 2.0, 2.0)) for _ in range(2))
    tracks = replace(tracks, compared=0, agreeing=0)
    agreed = supported(1.0, 1.0, Noise(0.3, 1.0)).covariance
    np.testing.assert_allclose(tracks.covariance, 2.0 * agreed)
    np.testing.assert_allclose(both.covariance, (2.0 / AGREED) ** 2 * agreed)


def long(size: float) -> Vector:
    """What draws tracks and depth apart along each axis, so that they disagree by `size`."""
    return np.full(6, np.sqrt(size))


def test_disagreement_is_learnt_from_frames_and_one_frame_counts_for_little() -> None:
    noise = Noise()
    assert noise.lasting == AGREED
    assert noise.disagreed(long(1e6), None).lasting < 2 * AGREED
    for _ in range(60):
        noise = noise.disagreed(long(2.0), long(2.0))
    assert noise.disagreement == pytest.approx(2.0, rel=0.01)
    assert noise.lasting == noise.disagreement


def test_a_disagreement_that_goes_to_and_fro_does_not_last() -> None:
    """As of colour and depth of different times in a fast motion; one that half recurs counts in full."""
    lasting, noise = [], Noise()
    for share in (-1.0, 0.0, 0.1, 0.5):
        noise = Noise()
        for _ in range(100):
            noise = noise.disagreed(long(2.0), share * long(2.0))
        lasting.append(noise.lasting)
    assert lasting[0] == 0.0
    assert lasting[1] == pytest.approx(0.0, abs=0.01)
    assert 0.2 < lasting[2] < 1.0
    assert lasting[3] == noise.disagreement


def test_where_no_disagreement_is_left_nothing_is_divided_by_it() -> None:
    assert Noise(disagreement=0.0, recurring=0.0).lasting == 0.0


def first_keyframe() -> Keyframe:
    """At the origin, 2 m before something."""
    return Keyframe(
        0, np.eye(4), 1e-6 * np.eye(6), np.zeros((4, 4), np.uint8), Surface(np.full((2, 2), 0.5, np.float32), K),
        np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, np.int64),
    )  # fmt: skip


def test_a_turn_adds_doubt_about_itself() -> None:
    known, T = first_keyframe(), se3.exp(np.array([0, 0, 0, 0, 0.2, 0.0]))
    covariance, _ = carried(known, T)
    added = covariance - moved_covariance(known.covariance, np.eye(4), T)
    np.testing.assert_allclose(added[3:, 3:], np.diag([0, 0.2 * TURNING, 0]), atol=1e-15)


def test_standing_still_adds_nothing() -> None:
    known = first_keyframe()
    np.testing.assert_allclose(carried(known, np.eye(4))[0], known.covariance, atol=1e-18)


def test_vertical_drift_accumulates_linearly() -> None:
    """Over two steps twice as far, so four times the variance, not two times."""
    known = replace(first_keyframe(), covariance=np.zeros((6, 6)))
    step = se3.exp(np.array([0, 0, 0.2, 0, 0, 0]))
    covariance, sunk = carried(known, step)
    assert sunk[1] == pytest.approx(SINKING * 4.0 * 0.1)
    then = replace(known, T_world_camera=step, covariance=covariance, sunk=sunk)
    covariance, sunk = carried(then, step @ step)
    assert covariance[1, 1] == pytest.approx((2 * SINKING * 0.4) ** 2)
    assert sunk[1] == pytest.approx(2 * SINKING * 0.4)
