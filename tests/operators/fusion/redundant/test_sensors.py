"""What is kept of several sensors of one thing, and when their status comes."""

from __future__ import annotations

import numpy as np

from dataflow.messages import Point
from operators.fusion.redundant.sensors import RedundantSensors

SECOND = 10**9


def at(stamp: int) -> Point:
    return Point(stamp=stamp, frame="map", position=np.zeros(3))


def test_latest_measurement_of_each_sensor_counts_for_the_window() -> None:
    sensors = RedundantSensors[Point](SECOND, 0.999)
    sensors.take({"place/b": at(SECOND), "place/a": at(2 * SECOND)})
    sensors.take({"place/a": at(2 * SECOND)})
    assert [name for name, _ in sensors.simultaneous(2 * SECOND)] == ["a", "b"]
    assert [name for name, _ in sensors.simultaneous(2 * SECOND + 1)] == ["a"]
    assert not list(sensors.simultaneous(SECOND - 1))
    assert sensors.ignored == {"a: stamp not later than the last": 1}


def test_status_comes_once_a_second() -> None:
    sensors = RedundantSensors[Point](SECOND, 0.999)
    stamps = range(0, 3 * SECOND, SECOND // 4)
    assert [stamp for stamp in stamps if sensors.status(stamp) is not None] == [0, SECOND, 2 * SECOND]
