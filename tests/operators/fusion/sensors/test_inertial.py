"""The first estimate: at rest, unless what is measured beside shows that the body drives straight on."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.messages import Imu
from operators.fusion.filter.initialisation import Prior
from operators.fusion.filter.measurements import FullPose, Model, Position, Velocity
from operators.fusion.sensors.inertial import InertialConfig, InertialSensor

MS = 1_000_000
VARIANCE = 0.02**2
UNKNOWN = np.array([1.0, 2.0, np.nan])


def begun_at_rest(seen: list[tuple[int, Model]]) -> bool:
    """Returns whether the first estimate is one at rest: half a second of gravity alone, and what is measured then."""
    sensor = InertialSensor(InertialConfig(0.001, 0.01, 1e-5, 1e-4, rest=0.5, patience=0.5))
    for k in range(52):
        imu = Imu(
            stamp=k * 10 * MS, frame="imu", angular_velocity=np.zeros(3), linear_acceleration=np.array([0, 0, 9.81])
        )
        sample = sensor.sample("imu", imu, imu.stamp)
        if (found := sensor.begun(sample, Prior(), 9.81, np.eye(4))) is not None:
            return found[1]
        for time, model in seen:
            if time == imu.stamp:
                size = 6 if isinstance(model, FullPose) else int(np.isfinite(model.value).sum())
                sensor.saw(time, "other", model, np.eye(size) * VARIANCE)
    raise AssertionError("not begun")


def at(x: float) -> Position:
    return Position(np.array([x, 0.0, 0.0]), np.zeros(3))


def speed(x: float) -> Velocity:
    return Velocity(np.array([x, 0.0, 0.0]), np.eye(3), np.zeros(3))


def beam(x: float) -> Velocity:
    return Velocity(np.array([x]), np.array([[1.0, 0.0, 0.0]]), np.zeros(3))


@pytest.mark.parametrize(
    ("seen", "rests"),
    [
        ([], True),
        ([(0, at(0.0)), (200 * MS, at(0.03))], True),  # noise
        ([(0, at(0.0)), (200 * MS, at(0.1)), (400 * MS, at(0.2))], False),  # 0.5 m/s
        ([(0, FullPose(np.zeros(3), np.eye(3))), (400 * MS, FullPose(np.array([0, 0.2, 0]), np.eye(3)))], False),
        ([(0, at(0.0)), (200 * MS, Position(UNKNOWN, np.zeros(3)))], True),  # not to be compared
        ([(0, Position(UNKNOWN, np.zeros(3))), (400 * MS, Position(UNKNOWN + 0.2, np.zeros(3)))], False),
        ([(100 * MS, speed(0.03))], True),
        ([(100 * MS, speed(0.5))], False),
        ([(100 * MS, beam(0.5))], True),  # something else may move there
    ],
)
def test_a_body_rests_that_nothing_shows_to_move(seen: list[tuple[int, Model]], rests: bool) -> None:
    assert begun_at_rest(seen) == rests
