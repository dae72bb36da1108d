"""Clouds that hold hardly anything, or nothing finite, are survived by operators of clouds, and said."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dataflow.messages import Diagnostics, PointCloud, Pose
from dataflow.testing import play
from operators.cloud import CloudFilter, Clusterer, PlaneSegmenter
from operators.odometry import LidarOdometry
from operators.slam import LidarSlam

OPERATORS: list[Any] = [CloudFilter, Clusterer, LidarOdometry, LidarSlam, PlaneSegmenter]


def room(count: int = 3000) -> np.ndarray:
    """Points on the walls and the floor of a room, seen from within."""
    rng = np.random.default_rng(0)
    p = rng.uniform([-4, -3, -0.6], [4, 3, 1.8], (count, 3))
    side = rng.integers(0, 5, count)
    for k, (axis, at) in enumerate([(0, 4.0), (0, -4.0), (1, 3.0), (1, -3.0), (2, -0.6)]):
        p[side == k, axis] = at
    return p.astype(np.float32)


BAD = {
    "empty": np.zeros((0, 3), np.float32),
    "one point": room()[:1],
    "nothing finite": np.full((500, 3), np.nan, np.float32),
    "one point many times": np.ones((500, 3), np.float32),
    "nothing that a sensor could see": room() * np.float32(1e18),
}


def scan(points: np.ndarray, k: int) -> PointCloud:
    return PointCloud(stamp=(k + 1) * 100_000_000, frame="lidar", points=points)


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
@pytest.mark.parametrize("made", OPERATORS, ids=lambda made: made.__name__)
def test_bad_cloud_among_good_ones_is_survived_and_reported(made: Any, bad: np.ndarray) -> None:
    played = play(made(), {"cloud": [scan(room(), 0), scan(bad, 1), scan(room() + np.float32(0.01), 2)]})
    said = {m.stamp: m for m in played["status"] if isinstance(m, Diagnostics)}
    assert len(said) == 3
    assert said[200_000_000].messages != said[100_000_000].messages


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
@pytest.mark.parametrize("made", [Clusterer, PlaneSegmenter], ids=["Clusterer", "PlaneSegmenter"])
def test_a_pose_that_is_not_finite_among_good_ones_is_survived_and_reported(made: Any, wrong: float) -> None:
    def played(operator: Any, height: float) -> Any:
        poses = [pose(k, [0.0, 0, 0.6 if k != 1 else height]) for k in range(3)]
        return play(operator, {"cloud": [scan(room(), k) for k in range(3)], "pose": poses})

    operator = made()
    found, plain = played(operator, wrong), played(made(), 0.6)
    said = [m.messages[0] for m in found["status"]]
    assert ["the pose is not finite" in text for text in said] == [False, True, False]
    assert operator.summary()["poses not finite"] == 1
    for port in found.outputs:
        if port not in ("status", "features"):
            assert found[port][-1].digest() == plain[port][-1].digest()


def pose(k: int, position: list[float]) -> Pose:
    return Pose(
        stamp=(k + 1) * 100_000_000, frame="map", child_frame="lidar", position=position, orientation=[0, 0, 0, 1]
    )
