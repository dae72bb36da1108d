"""What a device says under several names is one witness, and what it repeats bit for bit is frozen."""

from __future__ import annotations

import numpy as np
import pytest

from operators.fusion.filter.error_state import SIZE, VELOCITY, State
from operators.fusion.filter.gate import GateConfig, Health, RejectedMeasurement, Repeat, leap, repeat_of
from operators.fusion.filter.measurements import AngularRate, FullPose, Measurement, Model, Position

NOISE = np.eye(3) * 1e-4
FELT = RejectedMeasurement(10**9, np.array([0.6, 0.0, 0.0]), NOISE, "Velocity")
LEAPT = {"wheels": Health(last_used=10**9, doubts=(FELT,), streak=3, leap=0.6)}


def leapt(sensor: str, kind: str, seconds: float, health: dict[str, Health], residual: float = 0.6) -> float:
    """By how much a sensor leaps in whose absence the inertial sensor may have failed to feel as much."""
    none = np.zeros(3)
    state = State(none, none, np.eye(3), none, none, np.eye(15) * 1e-6)
    H = np.zeros((3, 15))
    H[:, VELOCITY] = np.eye(3)
    doubt = RejectedMeasurement(round((1.0 + seconds) * 1e9), np.array([residual, 0.0, 0.0]), NOISE, kind)
    return leap(GateConfig(), sensor, doubt, health, state, H, residual**2 / 1e-4, 1.0)


@pytest.mark.parametrize(("name", "kind"), [("wheels standstill", "Velocity"), ("wheels no turn", "AngularRate")])
def test_a_device_that_has_leapt_leaps_under_its_other_names(name: str, kind: str) -> None:
    assert leapt(name, kind, 0.9, {}) == 0.0
    assert leapt(name, kind, 0.9, LEAPT) == pytest.approx(0.6)


def test_fitting_other_or_later_measurements_do_not_leap() -> None:
    assert leapt("wheels standstill", "Velocity", 0.9, LEAPT, residual=0.01) == 0.0
    assert leapt("camera", "Velocity", 0.9, LEAPT) == 0.0
    assert leapt("wheels no turn", "AngularRate", 1.5, LEAPT) == 0.0


@pytest.mark.parametrize(
    ("kind", "seconds", "place", "size"),
    [
        ("FullPose", 0.5, 0.62, 0.0),
        ("Position", 0.5, 0.62, 0.6),  # of the same kind: no witness
        ("FullPose", 3.0, 0.62, 0.6),  # too long ago
        ("FullPose", 0.5, 4.0, 0.6),  # elsewhere
    ],
)
def test_leap_to_a_place_that_another_kind_of_sensor_gives_as_well_is_none(
    kind: str, seconds: float, place: float, size: float
) -> None:
    there = RejectedMeasurement(10**9, np.array([place, 0.0, 0.0]), NOISE, kind)
    others = {"camera": Health(last_used=10**8, doubts=(there,), streak=3)}
    own = RejectedMeasurement(10**9, np.array([0.6, 0.0, 0.0]), NOISE, "Position")
    health = {"gps": Health(last_used=10**9, doubts=(own,), streak=1, leap=0.6), **others}
    assert leapt("gps", "Position", seconds, health) == pytest.approx(size)


ZERO = np.zeros(3)
PLACE = np.array([1.0, 2.0, np.nan])


def state_of(speed: float, sigma: float = 0.05) -> State:
    return State(ZERO, np.array([speed, 0, 0]), np.eye(3), ZERO, ZERO, np.eye(SIZE) * sigma**2)


def measured(seconds: float, model: Model) -> Measurement:
    return Measurement(round(seconds * 1e9), "fix", model, np.eye(2) * 0.05**2)


def frozen(state: State, seconds: float, place: np.ndarray = PLACE) -> bool:
    found = repeat_of(Repeat(PLACE, 0), measured(seconds, Position(place, ZERO)), state, fits=True)
    return found.frozen


@pytest.mark.parametrize(
    ("speed", "sigma", "seconds", "expected"),
    [
        (0.8, 0.05, 0.4, True),
        (0.8, 0.05, 0.2, False),  # no further than the noise: not believed yet, but no fault
        (0.0, 0.05, 60.0, False),  # at rest
        (0.8, 0.5, 0.4, False),  # it may be at rest
    ],
)
def test_a_place_that_repeats_is_frozen_where_the_body_has_left_it(
    speed: float, sigma: float, seconds: float, expected: bool
) -> None:
    assert frozen(state_of(speed, sigma), seconds) == expected


def test_repeated_place_that_never_fitted_is_no_evidence() -> None:
    first = repeat_of(None, measured(0.0, Position(PLACE, ZERO)), state_of(0.8), fits=False)
    again = repeat_of(first, measured(0.4, Position(PLACE, ZERO)), state_of(0.8), fits=False)
    assert (again.speed, again.frozen) == (0.0, False)


def test_the_least_change_of_a_place_is_no_repeat() -> None:
    assert not frozen(state_of(0.8), 0.4, np.nextafter(PLACE, 9.0))


def test_frozen_position_stays_frozen_at_rest_until_it_changes() -> None:
    before = Repeat(PLACE, 0, frozen=True)
    again = repeat_of(before, measured(9.0, FullPose(PLACE, np.eye(3))), state_of(0.0), fits=True)
    assert again.frozen
    moved = repeat_of(again, measured(9.2, FullPose(PLACE + 1e-9, np.eye(3))), state_of(0.0), fits=True)
    assert moved.speed == 0
    assert (moved.frozen, moved.since) == (False, round(9.2e9))


@pytest.mark.parametrize(("sigma", "idle"), [(0.01, False), (0.2, True)])
def test_repeated_place_after_braking_may_be_standstill(sigma: float, idle: bool) -> None:
    first = repeat_of(Repeat(PLACE, 0), measured(0.2, Position(PLACE, ZERO)), state_of(0.8), fits=True)
    second = repeat_of(first, measured(0.4, Position(PLACE, ZERO)), state_of(0.01, sigma), fits=True)
    assert ((second.speed > 0), second.frozen) == (idle, False)


def test_rates_may_repeat() -> None:
    assert repeat_of(None, measured(1.0, AngularRate(ZERO, np.eye(3))), state_of(0.8), fits=True) is None
