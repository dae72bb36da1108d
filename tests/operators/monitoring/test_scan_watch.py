"""Scans that hang or show nothing are held back, by a restored watch too."""

from __future__ import annotations

import numpy as np
import pytest
from repeated import assert_repeats

from dataflow.messages import PointCloud
from operators.monitoring import ScanWatch

BLIND = np.where(np.arange(100)[:, None] < 19, np.float32(1), np.float32(np.nan)) * np.ones((1, 3), np.float32)


@pytest.mark.parametrize("bad", [np.zeros((0, 3), np.float32), None, BLIND], ids=["empty", "frozen", "not finite"])
def test_a_scan_without_news_is_held_back(bad: np.ndarray | None) -> None:
    rng = np.random.default_rng(3)
    data = [rng.uniform(1, 3, (100, 3)).astype(np.float32) for _ in range(3)]
    data[1] = data[0] if bad is None else bad
    given = [PointCloud(stamp=k, frame="lidar", points=d) for k, d in enumerate(data)]
    assert ["checked" in each for each in assert_repeats(ScanWatch, [(each,) for each in given], 1)] == [
        True,
        False,
        True,
    ]
