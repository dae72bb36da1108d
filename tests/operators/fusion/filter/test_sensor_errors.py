"""Errors of sensors that last: states of the filter, and covariances that are then as large as the errors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_motion import GRAVITY, Motion

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages import NavSatFix
from operators.fusion.filter.error_state import SIZE, Noise, State
from operators.fusion.filter.error_state_filter import ErrorStateFilter, FilterConfig
from operators.fusion.filter.history import Sample
from operators.fusion.filter.initialisation import Prior, first_node
from operators.fusion.filter.measurements import Measurement, Position, Velocity
from operators.fusion.filter.sensor_errors import SensorErrors
from operators.fusion.sensors.interpretation import Surroundings, measurements
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
def test_a_drift_taken_for_noise_makes_the_covariance_too_small_and_a_state_does_not() -> None:
    drifting = SensorErrors(drifts=(("fix", (DRIFT,) * 3, 1000.0),))
    white = np.mean([nees(driven(seed, SensorErrors())) for seed in range(6)])
    held = np.mean([nees(driven(seed, drifting)) for seed in range(6)])
    assert white > 12.0  # three would be right
    assert 1.0 < held < 6.0  # its 95 % band is 1.4-5.3 over six


def test_a_position_is_no_surer_than_its_drift_and_comes_back_from_a_snapshot() -> None:
    config = FilterConfig(errors=SensorErrors(drifts=(("fix", (DRIFT, DRIFT, 2 * DRIFT), 1000.0),)))
    filter = driven(1, config.errors)
    sigmas = np.sqrt(np.diag(filter.estimate(filter.time)[0].covariance)[:3])
    np.testing.assert_allclose(sigmas, [DRIFT, DRIFT, 2 * DRIFT], rtol=0.15)
    again = restored(config.errors, filter)
    assert again.estimate(filter.time)[0].covariance.tobytes() == filter.estimate(filter.time)[0].covariance.tobytes()


def test_a_drift_that_nobody_measures_keeps_its_spread() -> None:
    samples = [Sample(k * 10_000_000, np.zeros(3), -GRAVITY, NOISE) for k in range(3)]
    errors = SensorErrors(drifts=(("fix", (0.1, 0.2, 0.3), 0.5),))
    node = first_node(samples, Prior(heading=0.0), -GRAVITY[2], at_rest=True)
    filter = ErrorStateFilter(FilterConfig(errors=errors), node)
    for k in range(3, 150):
        filter.feel(Sample(k * 10_000_000, np.zeros(3), -GRAVITY, NOISE))
    state, _ = filter.estimate(filter.time)
    np.testing.assert_allclose(np.sqrt(np.diag(state.covariance)[SIZE:]), [0.1, 0.2, 0.3], rtol=0.02)


@pytest.mark.parametrize("kind", ["drift", "scale"])
def test_what_an_error_does_to_a_residual_is_its_jacobian(kind: str) -> None:
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


def test_settings_ask_for_errors_and_the_noise_is_what_is_left() -> None:
    settings = {
        "robot/fix": SensorSettings(drift=(0.3, 0.3, 0.6), drift_time=20.0),
        "robot/wheels": SensorSettings(use="wheels", scale_sigma=0.02),
        "camera": SensorSettings(offset_sigma=0.05),
    }
    errors = errors_of(settings)
    assert errors.sigmas == [0.05, 0.3, 0.3, 0.6, 0.02]
    np.testing.assert_allclose(errors.wander.decay, [0.0, 0.05, 0.05, 0.05, 0.0])
    around = Surroundings(lambda frame: np.eye(4), "world", (48.0, 11.0, 500.0))
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


def test_settings_without_errors_leave_the_state_as_it_was() -> None:
    assert errors_of({"robot/fix": SensorSettings()}).sigmas == []
