"""Late stamps and wrong scales are found in a window of inertial samples and measurements."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from operators.fusion.filter.error_state import (
    SIZE,
    Noise,
    State,
    difference,
    exp_rotation,
    log_rotation,
    moved,
    propagated,
)
from operators.fusion.filter.error_state_filter import ErrorStateFilter, FilterConfig
from operators.fusion.filter.history import Hypothesis, Node, Sample
from operators.fusion.filter.measurements import Measurement, Position, Velocity
from operators.fusion.filter.sensor_errors import SensorErrors
from operators.fusion.filter.suspicions import LATE, SCALE, Suspicions, WindowFit, suspected
from operators.fusion.filter.window import Motion, Window

NOISE = Noise(1e-3, 1e-2, 1e-5, 1e-4)
DOWN = np.array([0.0, 0.0, -9.81])
RATE, DELAYS = 50, ("fix", LATE)
ZERO = np.zeros(3)


class Drive:
    """A level slalom at 0.5 to 0.8 m/s, felt at 50 Hz; an estimate that began with a heading wrong by 0.3 rad."""

    def __init__(self, seconds: int = 14, told: bool = False) -> None:
        self.rng = np.random.default_rng(3)
        self.t = t = np.arange(seconds * RATE) / RATE
        speed, yaw = 0.65 + 0.15 * np.sin(0.8 * t), 0.9 * np.sin(0.7 * t)
        self.turning = 0.63 * np.cos(0.7 * t)
        self.forces = np.column_stack([0.12 * np.cos(0.8 * t), speed * self.turning, 0 * t + 9.81])
        self.speed, heading = speed, np.column_stack([np.cos(yaw), np.sin(yaw), 0 * t])
        self.places = np.cumsum(speed[:, None] * heading, axis=0) / RATE
        off = exp_rotation(np.array([0.0, 0.0, 0.3]))
        sigmas = np.repeat([1.0, 1.0, 0.3, 0.02, 0.2], 3)
        self.start = State(self.places[0], off @ heading[0] * 0.65, off, ZERO, ZERO, np.diag(sigmas**2))
        self.told = told

    def window(self, late: float = 0.0, fast: float = 1.0, wheels: bool = False) -> Window:
        window, state = Window(begins=self.told), self.start
        for k, x in enumerate(self.t):
            gyro, time = np.array([0.0, 0.0, self.turning[k]]), round(x * 1e9)
            if k:
                state = propagated(state, gyro, self.forces[k], 1 / RATE, NOISE, DOWN)
                window = window.felt(gyro, self.forces[k], 1 / RATE, NOISE)
            seen = k - round(late * RATE)
            if k % 10 == 0 and seen >= 0:
                place = Position(self.places[seen] + 0.02 * self.rng.standard_normal(3), ZERO)
                entry = Measurement(time, "fix", place, 4e-4 * np.eye(3))
                window = window.measured(entry, state, gyro, self.forces[k])
            if k % 10 == 5 and wheels:
                speed = Velocity(np.array([fast * self.speed[k], 0.0, 0.0]), np.eye(3), ZERO)
                entry = Measurement(time, "wheels", speed, 4e-4 * np.eye(3))
                window = window.measured(entry, state, gyro, self.forces[k])
        return window


def looked(window: Window, errors: SensorErrors | None = None) -> Suspicions:
    made = Suspicions(errors or SensorErrors(), DOWN, (0.02, 0.2))
    made.look(10**12, window)
    return made


def test_late_stamps_are_found_though_the_estimate_took_them_for_a_heading() -> None:
    found = looked(Drive().window(late=0.5)).found
    sensor, kind, size, sigma = found
    assert (sensor, kind) == DELAYS
    assert abs(size - 0.5) < 3 * sigma < 0.15


@pytest.mark.parametrize(("late", "fast", "expected"), [(0.4, 1.0, DELAYS), (0.0, 1.06, ("wheels", SCALE))])
def test_of_several_sensors_the_one_that_errs_is_named(late: float, fast: float, expected: tuple[str, str]) -> None:
    found = looked(Drive().window(late, fast, wheels=True)).found
    assert found[:2] == expected
    assert abs(found[2] - (late or fast - 1)) < 3 * found[3]


@pytest.mark.parametrize("told", [False, True])
def test_nothing_is_found_where_nothing_is_wrong(told: bool) -> None:
    assert looked(Drive(told=told).window(wheels=True)).found is None


def test_an_error_that_is_estimated_is_not_looked_for() -> None:
    window = Drive(seconds=4).window(late=0.5)
    assert looked(window, SensorErrors(clocks=(("fix", 0.5),))).snapshot()["_suspected"] == []


def test_a_window_that_moves_on_is_fitted_from_where_the_last_fit_ended() -> None:
    drive = Drive(seconds=26)
    window = drive.window(late=0.5)
    first = window.first
    assert first > 0
    made = Suspicions(SensorErrors(), DOWN, (0.02, 0.2))
    made.look(10**12, replace(window, steps=window.steps[: first + 40]))
    made.look(2 * 10**12, window)
    found = made.found
    fresh = looked(window).found
    assert np.allclose(found[2:], fresh[2:], atol=2e-3)


def test_a_motion_that_was_felt_moves_any_state_as_its_samples_do_one_by_one() -> None:
    rng = np.random.default_rng(5)
    gyro, accel = rng.normal(0, 0.5, (10, 3)), rng.normal(0, 1, (10, 3)) - DOWN
    bias = rng.normal(0, 0.01, 3), rng.normal(0, 0.05, 3)
    R = exp_rotation(rng.normal(0, 1, 3))
    x = State(rng.normal(0, 5, 3), rng.normal(0, 1, 3), R, *bias, np.zeros((SIZE, SIZE)))
    motion, one = Motion.begun(bias[0] + 1e-4, bias[1] - 1e-4), x
    for w, f in zip(gyro, accel, strict=True):
        motion, one = motion.after(w, f, 0.02, NOISE), propagated(one, w, f, 0.02, NOISE, DOWN)
    there, F, Q = motion.moved(x, DOWN)
    assert np.allclose(difference(there, one), 0, atol=1e-7)
    assert np.allclose(Q, one.covariance, rtol=1e-3, atol=1e-9)
    for k in range(SIZE):
        step = np.eye(SIZE)[k] * 1e-5
        apart = difference(there, motion.moved(moved(x, step), DOWN)[0]) / 1e-5
        assert np.allclose(apart, F[:, k], atol=2e-3)


def test_window_restarts_at_inertial_gaps_and_samples_a_sensor_at_5_hz() -> None:
    drive = Drive(seconds=2)
    window = drive.window(wheels=True)
    assert len(window.steps) == 2 * 10
    again = window.steps[-1].measured[0]
    assert window.measured(replace(again, time=again.time + 10**7), drive.start, ZERO, ZERO) is window
    assert not window.broken().steps
    assert not window.broken().begins


def test_rest_has_no_scale() -> None:
    assert suspected(Velocity(ZERO, np.eye(3), ZERO)) is None
    assert suspected(Velocity(np.array([0.5, 0.0, 0.0]), np.eye(3), ZERO)) == SCALE


def test_overconfident_wrong_heading_restarts_the_filter_on_contradicting_motion() -> None:
    """Headings of the estimate are 0.6 rad off, and taken to be within 0.02."""
    drive = Drive(seconds=16)
    sigmas = np.repeat([0.02, 0.02, 0.02, 0.001, 0.01], 3)
    wrong = exp_rotation(np.array([0.0, 0.0, 0.6]))
    start = State(drive.places[0], wrong @ [0.65, 0, 0], wrong, ZERO, ZERO, np.diag(sigmas**2))
    gyro = np.column_stack([0 * drive.t, 0 * drive.t, drive.turning])
    node = Node(0, (Hypothesis(0.0, start),), gyro[0], drive.forces[0], window=Window(begins=False))
    fused = ErrorStateFilter(FilterConfig(gravity=9.81), node)
    for k, x in enumerate(drive.t[1:], 1):
        fused.feel(Sample(round(x * 1e9), gyro[k], drive.forces[k], NOISE))
        if k % 10 == 0:
            place = Position(drive.places[k] + 0.02 * drive.rng.standard_normal(3), ZERO)
            fused.measure(Measurement(round(x * 1e9), "fix", place, 4e-4 * np.eye(3)))
        before = fused.restarted
        fused.look()
        if fused.restarted != before:  # what is kept of it comes back
            fused.restore(fused.snapshot())
    assert fused.restarted > 0
    state = fused.estimate(fused.time)[0]
    off = log_rotation(exp_rotation(np.array([0.0, 0.0, 0.9 * np.sin(0.7 * drive.t[-1])])).T @ state.rotation)
    assert abs(off[2]) < 3 * state.covariance[8, 8] ** 0.5 < 0.3


@pytest.mark.parametrize(("old", "off", "restarts"), [(False, 1.0, True), (True, 1.0, False), (True, 1.25, True)])
def test_filter_older_than_the_window_restarts_on_stronger_evidence_only(old: bool, off: float, restarts: bool) -> None:
    """An hour has 180 windows: one in a thousand differs by 0.95 rad, 60 in a million by 1.1."""
    ones = State(ZERO, ZERO, np.eye(3), ZERO, ZERO, np.eye(SIZE) * 0.16**2)
    window = replace(Drive(seconds=26).window(), motion=None)
    node = Node(0, (Hypothesis(0.0, ones),), ZERO, -DOWN, window=window if old else Window())
    assert bool(node.window.first) == old
    fused = ErrorStateFilter(FilterConfig(gravity=9.81), node)
    for k in range(1, 5):
        fused.feel(Sample(k * 10**8, ZERO, -DOWN, NOISE))
    end = replace(ones, rotation=exp_rotation(np.array([0.0, 0.0, off])))
    fit = WindowFit(0, ones, np.zeros(0), until=4 * 10**8, end=end)
    fused._suspicions = SimpleNamespace(look=lambda *_: fit, found=None)
    fused.look()
    assert (fused.restarted == 4 * 10**8) == restarts


@pytest.mark.parametrize(("old", "sigmas", "named"), [(False, 4.2, True), (True, 4.2, False), (True, 5.2, True)])
def test_a_window_that_slides_asks_for_five_standard_deviations(old: bool, sigmas: float, named: bool) -> None:
    """A window passes four by chance in the hours in which it slides, and what begins wrong is to be found soon."""
    window, made = Drive(seconds=26 if old else 14).window(), Suspicions(SensorErrors(), DOWN, (0.02, 0.2))
    assert bool(window.first) == old
    ones = State(ZERO, ZERO, np.eye(3), ZERO, ZERO, np.eye(SIZE))

    def fitted(gain: float) -> None:
        size = np.array([0.07 * gain**0.5])
        fits = {
            erring: WindowFit(0, ones, size, 200 - gain * erring, size * 0 + 0.07, 200, promise=gain)
            for erring in (0, 1)
        }
        made._fitted = lambda window, erring: fits[erring]
        made.look(made._looked + 10**10, window)

    fitted(sigmas**2)
    assert (made.found is not None) == named
    fitted(2.1**2)  # what was found is kept until half of four
    assert (made.found is not None) == named
    fitted(1.9**2)
    assert made.found is None
