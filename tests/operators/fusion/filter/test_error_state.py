"""The error-state filter: Jacobians are derivatives, and its covariance is that of its errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_motion import GRAVITY, Motion
from scipy.spatial.transform import Rotation

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.state import plain, typed
from operators.fusion.filter.error_state import (
    POSITION,
    ROTATION,
    SIZE,
    Noise,
    State,
    difference,
    exp_rotation,
    log_rotation,
    moved,
    propagated,
    updated,
)
from operators.fusion.filter.error_state_filter import ErrorStateFilter, FilterConfig
from operators.fusion.filter.history import Sample
from operators.fusion.filter.initialisation import Prior, first_node, rests
from operators.fusion.filter.measurements import (
    AngularRate,
    FullPose,
    MagneticHeading,
    Measurement,
    Model,
    Orientation,
    Position,
    Range,
    RestingForce,
    Velocity,
)

rng = np.random.default_rng(3)
NOISE = Noise(gyro=2e-3, accel=2e-2, gyro_walk=1e-4, accel_walk=1e-3)


def state(seed: int = 0) -> State:
    made = np.random.default_rng(seed)
    A = made.normal(0, 0.1, (SIZE, SIZE))
    return State(
        position=made.normal(0, 3, 3),
        velocity=made.normal(0, 1, 3),
        rotation=Rotation.random(rng=seed).as_matrix(),
        gyro_bias=made.normal(0, 0.05, 3),
        accel_bias=made.normal(0, 0.2, 3),
        covariance=A @ A.T + 1e-3 * np.eye(SIZE),
    )


MODELS: list[Model] = [
    Position(np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.2, 1.0])),
    Position(np.array([1.0, np.nan, 3.0]), np.array([0.3, -0.2, 1.0])),
    Orientation(Rotation.random(rng=8).as_matrix()),
    FullPose(np.array([1.0, 2.0, 3.0]), Rotation.random(rng=9).as_matrix()),
    Velocity(np.array([0.3, 0.0]), Rotation.random(rng=7).as_matrix()[:2], np.array([0.4, 0.1, -0.3])),
    AngularRate(np.array([0.3, 0.1, 0.2]), Rotation.random(rng=6).as_matrix()),
    RestingForce(np.array([0.3, 0.1, 9.0]), GRAVITY),
    MagneticHeading(np.array([20e-6, 5e-6, -40e-6]), 1.2),
    Range(np.array([4.0]), np.array([5.0, 1.0, 2.0]), np.array([0.1, 0.2, 0.3])),
]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
def test_a_jacobian_is_the_derivative_of_its_residual(model: Model) -> None:
    at, rate, h = state(4), np.array([0.2, -0.4, 0.3]), 1e-6
    _, H = model.innovation(at, rate)
    numeric = np.zeros_like(H)
    for k in range(SIZE):
        e = np.zeros(SIZE)
        e[k] = h
        plus, minus = (model.innovation(moved(at, s * e), rate)[0] for s in (1, -1))
        numeric[:, k] = -(plus - minus) / (2 * h)
    np.testing.assert_allclose(H, numeric, atol=2e-7)


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
def test_measurement_is_restored_from_a_snapshot(model: Model) -> None:
    again = typed(Model, unpack_state(pack_state({"model": plain(model)}))["model"])
    assert type(again) is type(model)
    one, other = (m.innovation(state(1), np.ones(3)) for m in (model, again))
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])


def test_the_motion_of_an_error_is_its_derivative() -> None:
    at, gyro, accel, dt, h = state(2), np.array([0.5, -0.3, 0.8]), np.array([1.0, -2.0, 9.0]), 0.01, 1e-5
    quiet = Noise(0.0, 0.0, 0.0, 0.0)
    there = propagated(at, gyro, accel, dt, quiet, GRAVITY)
    F = np.zeros((SIZE, SIZE))
    for k in range(SIZE):
        e = np.zeros(SIZE)
        e[k] = h
        plus, minus = (propagated(moved(at, s * e), gyro, accel, dt, quiet, GRAVITY) for s in (1, -1))
        F[:, k] = (difference(there, plus) - difference(there, minus)) / (2 * h)
    expected = F @ at.covariance @ F.T
    assert np.abs(there.covariance - expected).max() < 2e-5 * np.abs(expected).max()


def test_rotation_vectors_and_matrices_are_inverse() -> None:
    for w in [*rng.normal(0, 1, (20, 3)), np.zeros(3), np.array([1e-9, 0, 0]), np.array([0, np.pi - 1e-7, 0])]:
        np.testing.assert_allclose(exp_rotation(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(exp_rotation(log_rotation(exp_rotation(w))), exp_rotation(w), atol=2e-7)


def test_an_exact_measurement_of_everything_is_believed() -> None:
    at, place = state(5), np.array([1.0, 2.0, 3.0])
    r, H = Position(place, np.zeros(3)).innovation(at, np.zeros(3))
    after = updated(at, r, H, np.eye(3) * 1e-10)
    np.testing.assert_allclose(after.position, place, atol=1e-6)
    assert np.linalg.eigvalsh(after.covariance).min() > -1e-12


def test_dead_reckoning_follows_exact_readings() -> None:
    motion, dt = Motion(), 0.005
    t = np.arange(0, 6, dt)
    gyro, accel = motion.readings(t)
    at = replace(
        state(), position=motion.position(0.0), velocity=np.zeros(3), rotation=motion.rotation(0.0).as_matrix()
    )
    at = replace(at, gyro_bias=np.zeros(3), accel_bias=np.zeros(3))
    for k in range(1, len(t)):
        at = propagated(at, (gyro[k] + gyro[k - 1]) / 2, (accel[k] + accel[k - 1]) / 2, dt, NOISE, GRAVITY)
    assert np.linalg.norm(at.position - motion.position(t[-1])) < 2e-3
    assert (Rotation.from_matrix(at.rotation) * motion.rotation(t[-1]).inv()).magnitude() < 1e-4


RATE = 50
PRIOR = Prior(heading=0.0, heading_sigma=0.1, gyro_bias=0.02, accel_bias=0.1, position_sigma=0.5)


def run(
    seed: int, checks: list[float], outage: tuple[float, float] = (9.0, 9.0)
) -> tuple[list[Array], ErrorStateFilter]:
    """Errors (6,) over their covariance at some times, of one run with everything drawn as the filter is told."""
    made = np.random.default_rng(seed)
    motion = Motion(phase=0.1 * made.standard_normal())
    prior = replace(PRIOR, heading=motion.phase + 0.1 * made.standard_normal())
    start = motion.position(0.0) + 0.5 * made.standard_normal(3)
    prior = replace(prior, position=(float(start[0]), float(start[1]), float(start[2])))
    t = np.arange(int(5.5 * RATE)) / RATE
    gyro, accel = motion.readings(t)
    white = RATE**0.5
    gyro = gyro + 0.02 * made.standard_normal(3) + NOISE.gyro * white * made.standard_normal(gyro.shape)
    accel = accel + 0.1 * made.standard_normal(3) + NOISE.accel * white * made.standard_normal(accel.shape)
    gyro += np.cumsum(NOISE.gyro_walk / white * made.standard_normal(gyro.shape), axis=0)
    accel += np.cumsum(NOISE.accel_walk / white * made.standard_normal(accel.shape), axis=0)
    samples = [Sample(round(x * 1e9), w, f, NOISE) for x, w, f in zip(t, gyro, accel, strict=True)]
    begin = int(0.5 * RATE)
    node = first_node(samples[:begin], prior, 9.80665, at_rest=True)
    filter = ErrorStateFilter(FilterConfig(window=0.3), node)
    nees = []
    for k in range(begin, len(t)):
        filter.feel(samples[k])
        if k % 5 == 0 and not outage[0] <= t[k] < outage[1]:
            place = motion.position(t[k]) + 0.05 * made.standard_normal(3)
            filter.measure(Measurement(samples[k].time, "p", Position(place, np.zeros(3)), np.eye(3) * 0.05**2))
        if any(abs(t[k] - check) < 0.4 / RATE for check in checks):
            at, _ = filter.estimate(samples[k].time)
            truth = replace(at, position=motion.position(t[k]), rotation=motion.rotation(t[k]).as_matrix())
            e = difference(at, truth)
            nees.append([_nees(e, at.covariance, block) for block in (POSITION, ROTATION)])
    return nees, filter


Array = np.ndarray


def _nees(error: Array, covariance: Array, block: slice) -> float:
    return float(error[block] @ np.linalg.solve(covariance[block, block], error[block]))


@pytest.mark.long
def test_errors_are_consistent_with_the_covariance() -> None:
    from scipy.stats import chi2  # takes a second

    checks = [1.5, 3.0, 4.48, 5.4]
    found = np.array([run(seed, checks, outage=(3.5, 4.5))[0] for seed in range(50)])  # runs, times, blocks
    low, high = chi2.ppf([0.025 / 8, 1 - 0.025 / 8], 3 * 50) / 50  # 95 % for all eight figures together
    anees = found.mean(axis=0)
    assert ((anees > low) & (anees < high)).all(), anees


def test_rest_is_distinguished_from_motion() -> None:
    t = np.arange(25) / RATE
    for begin, expected in ((0.0, True), (3.0, False)):
        gyro, accel = Motion().readings(t + begin)
        samples = [Sample(k, w, f, NOISE) for k, (w, f) in enumerate(zip(gyro, accel, strict=True))]
        assert rests(samples, Prior()) is expected


def test_a_covariance_stays_symmetric_as_time_passes() -> None:
    P = propagated(state(), np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.2, 9.7]), 0.1, NOISE, GRAVITY).covariance

    np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-12)
