"""An error that a filter does not know of is found beside it as a filter finds it that has it as a state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from operators.fusion.filter.error_state import SIZE, Noise, State, Wander, propagated, updated
from operators.fusion.filter.measurements import Position, Velocity
from operators.fusion.filter.suspicions import LATE, SCALE, Suspicions, suspected

NOISE = Noise(1e-3, 1e-2, 1e-5, 1e-4)
DOWN = np.array([0.0, 0.0, -9.81])


def state(errors: int, effects: int) -> State:
    covariance = np.diag([1.0] * 6 + [0.01] * 3 + [1e-4] * 3 + [1e-2] * 3 + [1e8] * errors)
    zeros = np.zeros(3)
    return State(
        zeros,
        np.array([1.0, 0.0, 0.0]),
        np.eye(3),
        zeros,
        zeros,
        covariance,
        np.zeros(errors),
        np.zeros((SIZE, effects)),
    )


def test_an_error_found_beside_a_filter_is_that_of_a_filter_that_estimates_it() -> None:
    rng = np.random.default_rng(1)
    beside, within = state(0, 1), state(1, 0)
    found = Suspicions().of("fix", LATE)
    for k in range(40):
        gyro, accel = rng.normal(0, 1e-9, 3), np.array([0.0, 0.0, 9.81])
        beside = propagated(beside, gyro, accel, 0.1, NOISE, DOWN)
        within = propagated(within, gyro, accel, 0.1, NOISE, DOWN, Wander(np.zeros(1), np.zeros(1)))
        signature = np.array([[1.0], [np.sin(0.5 * k)], [0.3 * k]])
        place = Position(
            np.array([0.1 * (k + 1), 0.0, 0.0]) + 1e-6 * (3 * signature[:, 0] + rng.normal(0, 1, 3)), np.zeros(3)
        )
        residual, H = place.innovation(beside, gyro)
        found = found.after(10**9, beside, residual, H, 0.01 * np.eye(3), signature)
        beside = updated(beside, residual, H, 0.01 * np.eye(3), signature)
        residual, H = place.innovation(within, gyro)
        residual = residual - signature[:, 0] * within.errors[0]
        within = updated(within, residual, np.hstack([H, signature]), 0.01 * np.eye(3))
    assert np.isclose(found.score[0] / found.information[0], within.errors[0], rtol=1e-4)
    assert np.isclose(found.information[0] ** -0.5, within.covariance[SIZE, SIZE] ** 0.5, rtol=1e-4)


def test_the_most_certain_error_is_found_and_none_by_chance() -> None:
    evidence = Suspicions(
        ("fix", "wheels"), (LATE, SCALE), np.array([20.0, -400.0]), np.array([100.0, 1e4]), np.array([25.0, 2500.0])
    )
    sensor, kind, size, sigma = evidence.found or ("", "", 0.0, 0.0)
    assert (sensor, kind) == ("wheels", SCALE)
    assert np.allclose([size, sigma], [-0.04, 0.005])
    assert replace(evidence, score=evidence.score / 4).found is None
    assert Suspicions().found is None


def test_evidence_fades() -> None:
    one = Suspicions(("fix",), (LATE,), np.array([10.0]), np.array([1.0]), np.array([1.0]), 10**9)
    still = state(0, 1)
    later = one.after(31 * 10**9, still, np.zeros(3), np.zeros((3, SIZE)), np.eye(3), np.zeros((3, 1)))
    assert np.allclose([later.score[0], later.variance[0]], [10 / np.e, np.exp(-2)])


def test_rest_has_no_scale() -> None:
    assert suspected(Velocity(np.zeros(3), np.eye(3), np.zeros(3))) is None
    assert suspected(Velocity(np.array([0.5, 0.0, 0.0]), np.eye(3), np.zeros(3))) == SCALE
