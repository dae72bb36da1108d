"""Time offsets of sensors: a known one is a setting, an unknown one a state that the filter estimates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_motion import GRAVITY, Motion
from made_sensors import Robot, errors, fused

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages import Diagnostics
from dataflow.operator import Context
from operators.fusion import EkfFusion
from operators.fusion.filter.error_state import Noise
from operators.fusion.filter.error_state_filter import ErrorStateFilter, FilterConfig
from operators.fusion.filter.history import Sample
from operators.fusion.filter.initialisation import Prior, first_node
from operators.fusion.filter.measurements import AngularRate, Measurement, Model, Orientation, Position, Velocity
from operators.fusion.filter.sensor_errors import SensorErrors

MOTION = Motion()
NOISE = Noise(1e-4, 1e-3, 1e-6, 1e-5)
RATE = 100
Array = np.ndarray


def measured(kind: str, t: float) -> tuple[Model, Array]:
    """What a sensor with the body's axes measures at a time."""
    R = MOTION.rotation(t)
    if kind == "position":
        return Position(MOTION.position(t), np.zeros(3)), np.eye(3) * 0.01**2
    if kind == "orientation":
        return Orientation(R.as_matrix()), np.eye(3) * 0.005**2
    return Velocity(R.inv().apply(MOTION.velocity(t)), np.eye(3), np.zeros(3)), np.eye(3) * 0.02**2


def restored(errors: SensorErrors, filter: ErrorStateFilter) -> ErrorStateFilter:
    """Returns a filter with settings of errors that goes on from another's snapshot."""
    made = ErrorStateFilter(FilterConfig(errors=errors), filter._base)
    made.restore(unpack_state(pack_state(filter.snapshot())))
    return made


def estimated(kind: str, offset: float, seconds: float = 6.0) -> tuple[float, float, ErrorStateFilter]:
    """Offset found of one sensor beside positions with a true clock, its standard deviation, and the filter."""
    t = np.arange(int(seconds * RATE)) / RATE
    gyro, accel = MOTION.readings(t)
    samples = [Sample(round(x * 1e9), w, f, NOISE) for x, w, f in zip(t, gyro, accel, strict=True)]
    prior = Prior(heading=MOTION.phase, heading_sigma=0.02, position=tuple(MOTION.position(0.0).tolist()))
    begin = RATE // 2
    node = first_node(samples[:begin], prior, -GRAVITY[2], at_rest=True)
    filter = ErrorStateFilter(FilterConfig(errors=SensorErrors(clocks=(("wrong", 0.1),))), node)
    rng = np.random.default_rng(1)
    for k in range(begin, len(t)):
        filter.feel(samples[k])
        if k % 5 == 0 and k > begin + 20:
            place = MOTION.position(t[k]) + 0.02 * rng.standard_normal(3)
            filter.measure(Measurement(samples[k].time, "true", Position(place, np.zeros(3)), np.eye(3) * 0.02**2))
            model, noise = measured(kind, t[k] - offset)
            assumed = round(filter.offsets()["wrong"][0] * 1e9)
            filter.measure(Measurement(samples[k].time - assumed, "wrong", model, noise, 0, assumed * 1e-9))
    return *filter.offsets()["wrong"], filter


@pytest.mark.long
@pytest.mark.parametrize("kind", ["position", "orientation", "velocity"])
@pytest.mark.parametrize("offset", [0.08, -0.06])
def test_an_unknown_offset_is_found(kind: str, offset: float) -> None:
    found, sigma, filter = estimated(kind, offset)
    assert found == pytest.approx(offset, abs=0.01)
    assert sigma < 0.01
    assert filter.health["wrong"].refused < 10


@pytest.mark.long
def test_an_offset_that_nothing_tells_of_keeps_its_sigma() -> None:
    samples = [Sample(k * 10_000_000, np.zeros(3), -GRAVITY, NOISE) for k in range(3)]
    node = first_node(samples, Prior(heading=0.0), -GRAVITY[2], at_rest=True)
    filter = ErrorStateFilter(FilterConfig(errors=SensorErrors(clocks=(("still", 0.1),))), node)
    for k in range(3, 100):
        filter.feel(Sample(k * 10_000_000, np.zeros(3), -GRAVITY, NOISE))
        rate = AngularRate(np.zeros(3), np.eye(3))
        filter.measure(Measurement(k * 10_000_000, "still", rate, np.eye(3) * 1e-4, 0))
    assert filter.offsets()["still"][1] == pytest.approx(0.1, rel=0.02)


def test_offsets_come_back_from_a_snapshot_and_older_snapshots_get_them() -> None:
    _, _, filter = estimated("position", 0.05, seconds=3.0)
    again = restored(SensorErrors(clocks=(("wrong", 0.1),)), filter)
    assert again.offsets() == filter.offsets()
    two = SensorErrors(clocks=(("wrong", 0.1), ("z", 0.3)))
    more = restored(two, filter)
    assert more.offsets()["z"][1] == pytest.approx(0.3, rel=0.01)


def test_the_operator_says_what_it_found_and_its_poses_are_right() -> None:
    robot = Robot(8.0)
    late = [p.replace(stamp=p.stamp + 120_000_000) for p in robot.poses()]
    found: dict[str, Any] = {}
    for sigma in (0.0, 0.2):
        sensors = {"robot/pose": {"use": "pose", "offset": 0.05, "offset_sigma": sigma}}
        operator, played = fused({"robot/imu": robot.imu, "robot/pose": late}, heading=None, sensors=sensors)
        found[f"{sigma}"] = errors(robot, played)[0][-100:].mean()
    assert max(found.values()) < 0.05  # without being told it is found as well
    assert operator.summary()["robot/pose, offset (s)"] == pytest.approx(0.12, abs=0.01)
    status = played["status"][-1]
    assert isinstance(status, Diagnostics)
    values = status.pairs(status.names.index("robot/pose"))
    assert float(values["offset, s"]) == pytest.approx(0.12, abs=0.01)


def test_the_inertial_sensor_has_no_offset_to_estimate() -> None:
    operator = EkfFusion(sensors={"robot/imu": {"offset_sigma": 0.1}})
    operator.setup()
    imu = Robot(1.0).imu[0]
    with pytest.raises(ValueError, match="its clock is the one that offsets are related to"):
        operator.process({"ns/robot/imu": imu}, Context(imu.stamp))
