"""Corrections of the way along which a map was seen, and what they do to voxels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from operators.scene.map.cells import Cells
from operators.scene.map.trajectory import Correction, Trajectory

STEP = 200_000_000  # ns


def motion(x: float, y: float, yaw: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = x, y
    return T


def test_what_was_seen_between_two_keyframes_moves_by_what_lies_between_their_corrections() -> None:
    correction = Correction([0, 1000], np.stack([np.eye(4), motion(1.0, 0, 0.2)]))
    np.testing.assert_allclose(correction.at(-5), np.eye(4))
    np.testing.assert_allclose(correction.at(500)[:2, 3], [0.5, -0.025], atol=0.001)
    np.testing.assert_allclose(correction.at(2000), motion(1.0, 0, 0.2))


def test_each_voxel_moves_with_the_place_from_which_it_was_seen() -> None:
    points = np.random.default_rng(2).uniform(0, 1, (500, 3))
    early, late = Cells.of(points, 0.05, 0), Cells.of(points + np.array([1.0, 0, 0]), 0.05, 10 * STEP)
    early.add(late)
    hits = early.hits.sum()
    early.correct(Correction([0, 10 * STEP], np.stack([np.eye(4), motion(-1.0, 0, 0)])))
    assert early.hits.sum() == pytest.approx(hits)
    np.testing.assert_allclose(early.extent, Cells.of(points, 0.05).extent, atol=0.06)
    assert (early.hits == 2).mean() > 0.9  # of the same places


def test_memory_of_the_way_is_bounded_however_long_it_is() -> None:
    trajectory = Trajectory()
    for k in range(20_000):
        trajectory.add(k * STEP, motion(0.1 * k, 0, 0))
    assert len(trajectory.poses) <= 4096
    for k in range(100):
        trajectory.add((20_000 + k) * STEP, motion(2000.0, 0, 0))
    assert trajectory.stamps[-1] <= 20_000 * STEP  # who stands adds nothing
