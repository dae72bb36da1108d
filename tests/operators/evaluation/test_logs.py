"""Poses that a score keeps of a long run: the same values as came, in little memory."""

from __future__ import annotations

import sys

import numpy as np

from operators.evaluation.trajectory import PoseLog


def test_poses_come_back_as_they_were() -> None:
    rng, log = np.random.default_rng(1), PoseLog()
    positions, orientations = rng.normal(size=(20, 3)), rng.normal(size=(20, 4))
    for k in range(20):
        log.append(k * 10**9, positions[k], orientations[k])

    found = log.trajectory()

    assert found.stamps == [k * 10**9 for k in range(20)]
    assert np.array_equal(found.positions, positions)
    assert np.array_equal(found.orientations, orientations)


def test_a_pose_takes_64_bytes() -> None:
    log = PoseLog()
    for k in range(10_000):
        log.append(k, np.zeros(3), np.zeros(4))
    taken = sum(sys.getsizeof(kept) for kept in vars(log).values())
    assert taken < 10_000 * 64 * 1.2
