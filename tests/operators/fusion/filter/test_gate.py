"""What a device says under several names is one witness."""

from __future__ import annotations

import numpy as np
import pytest

from operators.fusion.filter.error_state import VELOCITY, State
from operators.fusion.filter.gate import Doubt, GateConfig, Health, leap

NOISE = np.eye(3) * 1e-4
FELT = Doubt(10**9, np.array([0.6, 0.0, 0.0]), NOISE, "Velocity")
LEAPT = {"wheels": Health(last_used=10**9, doubts=(FELT,), streak=3, leap=0.6)}


def leapt(sensor: str, kind: str, seconds: float, health: dict[str, Health], residual: float = 0.6) -> float:
    """By how much a sensor leaps in whose absence the inertial sensor may have failed to feel as much."""
    none = np.zeros(3)
    state = State(none, none, np.eye(3), none, none, np.eye(15) * 1e-6)
    H = np.zeros((3, 15))
    H[:, VELOCITY] = np.eye(3)
    doubt = Doubt(round((1.0 + seconds) * 1e9), np.array([residual, 0.0, 0.0]), NOISE, kind)
    return leap(GateConfig(), sensor, doubt, health, state, H, residual**2 / 1e-4, 1.0)


@pytest.mark.parametrize(("name", "kind"), [("wheels standstill", "Velocity"), ("wheels no turn", "AngularRate")])
def test_a_device_that_has_leapt_leaps_under_its_other_names(name: str, kind: str) -> None:
    assert leapt(name, kind, 0.9, {}) == 0.0
    assert leapt(name, kind, 0.9, LEAPT) == pytest.approx(0.6)


def test_what_fits_does_not_leap_nor_what_another_device_says_nor_what_comes_later() -> None:
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
    there = Doubt(10**9, np.array([place, 0.0, 0.0]), NOISE, kind)
    others = {"camera": Health(last_used=10**8, doubts=(there,), streak=3)}
    own = Doubt(10**9, np.array([0.6, 0.0, 0.0]), NOISE, "Position")
    health = {"gps": Health(last_used=10**9, doubts=(own,), streak=1, leap=0.6), **others}
    assert leapt("gps", "Position", seconds, health) == pytest.approx(size)
