"""Corrections of the way along which a map was seen, and what they do to voxels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dataflow.messages import Path
from operators.scene.map.trajectory import Correction, Trajectory
from operators.scene.map.voxels import VoxelSet

STEP = 200_000_000  # ns


def motion(x: float, y: float, yaw: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = x, y
    return T


def test_correction_is_interpolated_between_keyframes() -> None:
    correction = Correction([0, 1000], np.stack([np.eye(4), motion(1.0, 0, 0.2)]))
    np.testing.assert_allclose(correction.at(-5), np.eye(4))
    np.testing.assert_allclose(correction.at(500)[:2, 3], [0.5, -0.025], atol=0.001)
    np.testing.assert_allclose(correction.at(2000), motion(1.0, 0, 0.2))


def test_each_voxel_moves_with_the_place_from_which_it_was_seen() -> None:
    points = np.random.default_rng(2).uniform(0, 1, (500, 3))
    early, late = VoxelSet.of(points, 0.05, 0), VoxelSet.of(points + np.array([1.0, 0, 0]), 0.05, 10 * STEP)
    early.add(late)
    hits = early.hits.sum()
    early.correct(Correction([0, 10 * STEP], np.stack([np.eye(4), motion(-1.0, 0, 0)])))
    assert early.hits.sum() == pytest.approx(hits)
    np.testing.assert_allclose(early.extent, VoxelSet.of(points, 0.05).extent, atol=0.06)
    assert (early.hits == 2).mean() > 0.9  # of the same places


def test_memory_of_the_way_is_bounded_however_long_it_is() -> None:
    trajectory = Trajectory()
    for k in range(20_000):
        trajectory.add(k * STEP, motion(0.1 * k, 0, 0))
    assert len(trajectory.poses) <= 4096
    for k in range(100):
        trajectory.add((20_000 + k) * STEP, motion(2000.0, 0, 0))
    assert trajectory.stamps[-1] <= 20_000 * STEP  # who stands adds nothing


def keyframes(times: list[int], poses: list[np.ndarray[Any, np.dtype[np.float64]]], **more: Any) -> Path:
    """Keyframes at these poses, which turn about z alone."""
    yaws = [np.arctan2(T[1, 0], T[0, 0]) for T in poses]
    return Path(
        stamp=times[-1],
        **{
            "frame": "world",
            "stamps": times,
            "positions": np.array([T[:3, 3] for T in poses]),
            "orientations": np.array([[0, 0, np.sin(yaw / 2), np.cos(yaw / 2)] for yaw in yaws]),
        }
        | more,
    )


def drifted() -> Trajectory:
    """A straight way of ten poses, one metre each."""
    trajectory = Trajectory()
    for k in range(10):
        trajectory.add(k * STEP, motion(float(k), 0, 0))
    return trajectory


def test_keyframes_move_the_poses_at_their_times_and_those_behind_them_as_the_last() -> None:
    trajectory = drifted()
    turned = motion(4.0, 1.0, 0.3)

    correction = trajectory.corrected(
        keyframes([2 * STEP, 5 * STEP // 2, 4 * STEP], [motion(2, 0, 0), motion(2.5, 0, 0), turned])
    )

    assert correction.stamps == [2 * STEP, 5 * STEP // 2, 4 * STEP]
    np.testing.assert_allclose(correction.motions[:2], np.stack([np.eye(4)] * 2), atol=1e-9)
    by = turned @ np.linalg.inv(motion(4, 0, 0))
    np.testing.assert_allclose(correction.motions[2], by, atol=1e-9)
    assert trajectory.stamps == [2 * STEP, 5 * STEP // 2, *(k * STEP for k in range(4, 10))]
    np.testing.assert_allclose(trajectory.poses[2], turned, atol=1e-9)
    for k in range(5, 10):
        np.testing.assert_allclose(trajectory.poses[k - 2], by @ motion(float(k), 0, 0), atol=1e-9)


def test_agreeing_keyframes_correct_nothing_and_unmatched_ones_are_ignored() -> None:
    trajectory = drifted()
    known = keyframes([-STEP, 0, 9 * STEP, 20 * STEP], [motion(x, 0, 0) for x in (-7.0, 0.0, 9.0, 50.0)])

    correction = trajectory.corrected(known)

    assert correction.stamps == [0, 9 * STEP]
    np.testing.assert_allclose(correction.motions, np.stack([np.eye(4)] * 2), atol=1e-9)
    assert Trajectory().corrected(known) is None
    assert drifted().corrected(keyframes([20 * STEP], [motion(0, 0, 0)])) is None


@pytest.mark.parametrize("lacks", ["stamps", "orientations"])
def test_keyframes_without_times_or_directions_are_refused(lacks: str) -> None:
    with pytest.raises(ValueError, match=f"the keyframes have no {lacks}"):
        drifted().corrected(keyframes([0], [motion(0, 0, 0)], **{lacks: None}))
