"""Scans that hang or show nothing are held back and named."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow import play
from dataflow.messages import PointCloud
from operators.monitoring import ScanWatch


@pytest.mark.parametrize("kept", [0, 100], ids=["empty", "frozen"])
def test_a_scan_without_news_is_held_back(kept: int) -> None:
    rng = np.random.default_rng(3)
    data = [rng.uniform(1, 3, (100, 3)).astype(np.float32) for _ in range(3)]
    data[1] = data[0][:kept]
    played = play(ScanWatch(), {"cloud": [PointCloud(stamp=k, frame="lidar", points=d) for k, d in enumerate(data)]})
    assert [m.stamp for m in played["checked"]] == [0, 2]


def test_a_scan_of_points_that_are_not_finite_is_held_back() -> None:
    good = np.random.default_rng(3).uniform(1, 3, (100, 3)).astype(np.float32)
    blind = np.full((100, 3), np.nan, np.float32)
    blind[:19] = good[:19]
    data = [good, blind, good + np.float32(0.1)]
    played = play(ScanWatch(), {"cloud": [PointCloud(stamp=k, frame="lidar", points=d) for k, d in enumerate(data)]})
    assert [m.stamp for m in played["checked"]] == [0, 2]


def test_two_plays_are_equal_and_a_restored_watch_knows_the_last_scan() -> None:
    rng = np.random.default_rng(4)
    data = rng.uniform(1, 3, (100, 3)).astype(np.float32)
    given = [PointCloud(stamp=k, frame="lidar", points=data) for k in range(2)]
    one, two = (play(ScanWatch(), {"cloud": given}) for _ in range(2))
    assert [m.digest() for m in one["status"]] == [m.digest() for m in two["status"]]

    first, second = ScanWatch(), ScanWatch()
    first.setup()
    second.setup()
    first.process(given[0])
    second.restore(first.snapshot())
    assert "checked" not in second.process(given[1])
