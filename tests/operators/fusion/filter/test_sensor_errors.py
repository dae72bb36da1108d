"""Errors of sensors that last, and unknown time offsets: states of the filter, with the covariance of their errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from made_motion import GRAVITY, Motion
from made_sensors import Robot, errors, fused

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages import NavSatFix
from dataflow.operator import Context
from operators.fusion import EkfFusion
from operators.fusion.filter.error_state import SIZE, Noise, State
from operators.fusion.filter.error_state_filter import ErrorStateFilter, FilterConfig
from operators.fusion.filter.history import Sample
from operators.fusion.filter.initialisation import Prior, first_node
from operators.fusion.filter.measurements import AngularRate, Measurement, Model, Orientation, Position, Velocity
from operators.fusion.filter.sensor_errors import SensorErrors
from operators.fusion.sensors.interpretation import MeasurementContext, measurements
from operators.fusion.sensors.settings import SensorSettings, errors_of

MOTION = Motion()
NOISE = Noise(1e-4, 1e-3, 1e-6, 1e-5)
RATE = 50
DRIFT, WHITE = 0.1, 0.05


def restored(errors: SensorErrors, filter: ErrorStateFilter) -> ErrorStateFilter:
    """Returns a filter with settings of errors that goes on from another's snapshot."""
    made = ErrorStateFilter(FilterConfig(errors=errors), filter._base)
    made.restore(unpack_state(pack_state(filter.snapshot())))
    return made


def driven(seed: int, errors: SensorErrors, seconds: float = 10.0) -> ErrorStateFilter:
    """A filter whose only positions have an error that stays nearly the same, and white noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE)) / RATE
    gyro, accel = MOTION.readings(t)
    gyro = gyro + 1e-4 * math.sqrt(RATE) * rng.standard_normal(gyro.shape)
    accel = accel + 1e-3 * math.sqrt(RATE) * rng.standard_normal(accel.shape)
    samples = [Sample(round(x * 1e9), w, f, NOISE) for x, w, f in zip(t, gyro, accel, strict=True)]
    prior = Prior(heading=MOTION.phase, heading_sigma=0.02)
    filter = ErrorStateFilter(FilterConfig(errors=errors), first_node(samples[:25], prior, -GRAVITY[2], at_rest=True))
    drift = DRIFT * rng.standard_normal(3)
    total = WHITE**2 if errors.drifts else WHITE**2 + DRIFT**2
    for k in range(25, len(t)):
        filter.feel(samples[k])
        if k % 5 == 0:
            place = MOTION.position(t[k]) + drift + WHITE * rng.standard_normal(3)
            filter.measure(Measurement(samples[k].time, "fix", Position(place, np.zeros(3)), np.eye(3) * total))
    return filter


def nees(filter: ErrorStateFilter, seconds: float = 10.0) -> float:
    state, _ = filter.estimate(filter.time)
    off = state.position - MOTION.position(seconds - 1 / RATE)
    return float(off @ np.linalg.solve(state.covariance[:3, :3], off))


@pytest.mark.long
def test_drift_state_keeps_the_covariance_consistent() -> None:
    drifting = SensorErrors(drifts=(("fix", (DRIFT,) * 3, 1000.0),))
    white = np.mean([nees(driven(seed, SensorErrors())) for seed in range(6)])
    held = np.mean([nees(driven(seed, drifting)) for seed in range(6)])
    assert white > 12.0  # three would be right
    assert 1.0 < held < 6.0  # its 95 % band is 1.4-5.3 over six


def test_position_covariance_is_bounded_by_the_drift_and_restored() -> None:
    config = FilterConfig(errors=SensorErrors(drifts=(("fix", (DRIFT, DRIFT, 2 * DRIFT), 1000.0),)))
    filter = driven(1, config.errors)
    sigmas = np.sqrt(np.diag(filter.estimate(filter.time)[0].covariance)[:3])
    np.testing.assert_allclose(sigmas, [DRIFT, DRIFT, 2 * DRIFT], rtol=0.15)
    again = restored(config.errors, filter)
    assert again.estimate(filter.time)[0].covariance.tobytes() == filter.estimate(filter.time)[0].covariance.tobytes()


def test_an_unobservable_drift_keeps_its_spread() -> None:
    samples = [Sample(k * 10_000_000, np.zeros(3), -GRAVITY, NOISE) for k in range(3)]
    errors = SensorErrors(drifts=(("fix", (0.1, 0.2, 0.3), 0.5),))
    node = first_node(samples, Prior(heading=0.0), -GRAVITY[2], at_rest=True)
    filter = ErrorStateFilter(FilterConfig(errors=errors), node)
    for k in range(3, 150):
        filter.feel(Sample(k * 10_000_000, np.zeros(3), -GRAVITY, NOISE))
    state, _ = filter.estimate(filter.time)
    np.testing.assert_allclose(np.sqrt(np.diag(state.covariance)[SIZE:]), [0.1, 0.2, 0.3], rtol=0.02)


@pytest.mark.parametrize("kind", ["drift", "scale"])
def test_jacobians_of_sensor_errors_match_differences(kind: str) -> None:
    errors = SensorErrors((("a", 0.1),), (("fix", (1.0, 1.0, 1.0), 9.0),), (("wheels", 0.01),))
    rng = np.random.default_rng(0)
    model = (
        Position(rng.normal(size=3), np.zeros(3))
        if kind == "drift"
        else Velocity(np.array([0.7]), np.eye(3)[:1], np.zeros(3))
    )
    sensor = "fix" if kind == "drift" else "wheels"
    base = State(
        *(rng.normal(size=3) for _ in range(2)), np.eye(3), np.zeros(3), np.zeros(3), np.eye(SIZE + 5), np.zeros(5)
    )
    size = len(model.value)

    def residual(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        J = np.zeros((size, SIZE + 5))
        state = State(base.position, base.velocity, base.rotation, base.gyro_bias, base.accel_bias, base.covariance, at)
        first = model.innovation(state, np.zeros(3))[0]
        return errors.taken_off(sensor, model, state, first, J), J

    here, J = residual(base.errors)
    for k in range(5):
        there, _ = residual(base.errors + 1e-4 * np.eye(5)[k])
        np.testing.assert_allclose((here - there) / 1e-4, J[:, SIZE + k], atol=1e-9)


def test_settings_enable_error_states_and_reduce_the_noise() -> None:
    settings = {
        "robot/fix": SensorSettings(drift=(0.3, 0.3, 0.6), drift_time=20.0),
        "robot/wheels": SensorSettings(use="wheels", scale_sigma=0.02),
        "camera": SensorSettings(offset_sigma=0.05),
    }
    errors = errors_of(settings)
    assert errors.sigmas == [0.05, 0.3, 0.3, 0.6, 0.02]
    np.testing.assert_allclose(errors.wander.decay, [0.0, 0.05, 0.05, 0.05, 0.0])
    around = MeasurementContext(lambda frame: np.eye(4), "world", (48.0, 11.0, 500.0))
    C = np.diag([0.25, 0.25, 1.0])
    fix = NavSatFix(
        stamp=5, frame="gnss", latitude=48.0, longitude=11.0, altitude=500.0, satellites=9,
        covariance_type="diagonal_known", covariance=C,
    )  # fmt: skip
    ((_, _, _, noise),) = measurements("robot/fix", fix, None, settings["robot/fix"], around)
    np.testing.assert_allclose(np.diag(noise), [0.16, 0.16, 0.64])
    tight = SensorSettings(drift=(0.6, 0.3, 0.6))
    ((_, _, _, noise),) = measurements("robot/fix", fix, None, tight, around)
    assert noise[0, 0] == pytest.approx(0.025)


def test_settings_without_errors_add_no_error_states() -> None:
    assert errors_of({"robot/fix": SensorSettings()}).sigmas == []


FAST = 100
Array = np.ndarray


def measured(kind: str, t: float) -> tuple[Model, Array]:
    """What a sensor with the body's axes measures at a time."""
    R = MOTION.rotation(t)
    if kind == "position":
        return Position(MOTION.position(t), np.zeros(3)), np.eye(3) * 0.01**2
    if kind == "orientation":
        return Orientation(R.as_matrix()), np.eye(3) * 0.005**2
    return Velocity(R.inv().apply(MOTION.velocity(t)), np.eye(3), np.zeros(3)), np.eye(3) * 0.02**2


def estimated(kind: str, offset: float, seconds: float = 6.0) -> tuple[float, float, ErrorStateFilter]:
    """Offset found of one sensor beside positions with a true clock, its standard deviation, and the filter."""
    t = np.arange(int(seconds * FAST)) / FAST
    gyro, accel = MOTION.readings(t)
    samples = [Sample(round(x * 1e9), w, f, NOISE) for x, w, f in zip(t, gyro, accel, strict=True)]
    prior = Prior(heading=MOTION.phase, heading_sigma=0.02, position=tuple(MOTION.position(0.0).tolist()))
    begin = FAST // 2
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
def test_an_unobservable_time_offset_keeps_its_sigma() -> None:
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


def test_operator_reports_the_estimated_offset_and_its_poses_are_right() -> None:
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
    values = status.pairs(status.names.index("robot/pose"))
    assert float(values["offset, s"]) == pytest.approx(0.12, abs=0.01)


def test_the_inertial_sensor_has_no_offset_to_estimate() -> None:
    operator = EkfFusion(sensors={"robot/imu": {"offset_sigma": 0.1}})
    operator.setup()
    imu = Robot(1.0).imu[0]
    with pytest.raises(ValueError, match="its clock is the one that offsets are related to"):
        operator.process({"ns/robot/imu": imu}, Context(imu.stamp))
