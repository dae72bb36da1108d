"""Rigid motions, held against scipy and against the definition of each function."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from dataflow.messages.geometry import invert
from operators.geometry import se3

number = st.floats(-10, 10)
vector = st.tuples(number, number, number).map(np.array)
axis = vector.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v))
angle = st.one_of(st.floats(0, 3.1), st.floats(0, 1e-5), st.floats(3.1, np.pi - 1e-9), st.just(np.pi))
rotation_vector = st.tuples(axis, angle).map(lambda both: both[0] * both[1])
twist = st.tuples(vector, rotation_vector).map(np.concatenate)


def hat(x: np.ndarray) -> np.ndarray:
    """The (4, 4) matrix of a twist."""
    X = np.zeros((4, 4))
    X[:3, :3], X[:3, 3] = se3.skew(x[3:]), x[:3]
    return X


@given(vector, vector)
def test_skew_is_the_cross_product(v: np.ndarray, w: np.ndarray) -> None:
    np.testing.assert_allclose(se3.skew(v) @ w, np.cross(v, w), atol=1e-12)


@given(twist)
def test_exp_is_the_matrix_exponential(x: np.ndarray) -> None:
    np.testing.assert_allclose(se3.exp(x), expm(hat(x)), atol=1e-9)


@given(rotation_vector)
def test_exp_turns_as_scipys_rotation_vectors_do(w: np.ndarray) -> None:
    T = se3.exp(np.concatenate([np.zeros(3), w]))
    np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec(w).as_matrix(), atol=1e-12)


@given(twist)
def test_log_undoes_exp(x: np.ndarray) -> None:
    again = se3.log(se3.exp(x))
    np.testing.assert_allclose(se3.exp(again), se3.exp(x), atol=1e-6)
    if np.linalg.norm(x[3:]) < 3.14:
        np.testing.assert_allclose(again, x, atol=1e-5)


@given(vector, axis, st.floats(1e-3, 3.0))
def test_log_is_the_matrix_logarithm(v: np.ndarray, w: np.ndarray, angle: float) -> None:
    T = se3.exp(np.concatenate([v, w * angle]))
    np.testing.assert_allclose(hat(se3.log(T)), np.real(logm(T)), atol=1e-6)


@given(axis)
def test_log_of_half_a_turn_has_its_axis(w: np.ndarray) -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(w * np.pi).as_matrix()
    found = se3.log(T)[3:]
    assert np.linalg.norm(found) == pytest.approx(np.pi, abs=1e-6)
    np.testing.assert_allclose(np.abs(found @ w), np.pi, atol=1e-6)


@given(twist, twist)
def test_adjoint_moves_a_perturbation_to_the_other_side(x: np.ndarray, small: np.ndarray) -> None:
    T = se3.exp(x)
    left = T @ se3.exp(small) @ invert(T)
    np.testing.assert_allclose(left, se3.exp(se3.adjoint(T) @ small), atol=1e-6)


@given(twist, st.integers(0, 100))
def test_orthonormalised_is_a_rotation_near_by(x: np.ndarray, seed: int) -> None:
    T = se3.exp(x)
    bent = T.copy()
    bent[:3, :3] += np.random.default_rng(seed).normal(0, 1e-3, (3, 3))
    R = se3.orthonormalised(bent)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-2)


@pytest.mark.long
def test_the_nearest_rotation_is_never_a_reflection() -> None:
    rng = np.random.default_rng(1)
    for M in (*rng.normal(size=(20, 3, 3)), np.diag([1.0, 1.0, -0.01])):
        R = se3.nearest_rotation(M)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0


@pytest.mark.long
def test_covariance_about_fixed_axes_is_that_of_perturbed_poses() -> None:
    rng = np.random.default_rng(3)
    A = rng.normal(0, 0.003, (6, 6))
    covariance = A @ A.T
    T = se3.exp(np.array([1.0, -2.0, 0.5, 0.4, -1.2, 0.9]))
    perturbed = [T @ se3.exp(x) for x in rng.multivariate_normal(np.zeros(6), covariance, 20_000)]
    moved = np.array([P[:3, 3] - T[:3, 3] for P in perturbed])
    turned = np.array([Rotation.from_matrix(P[:3, :3] @ T[:3, :3].T).as_rotvec() for P in perturbed])
    sampled = np.cov(np.hstack([moved, turned]).T)
    np.testing.assert_allclose(sampled, se3.about_fixed_axes(covariance, T), atol=0.05 * np.abs(covariance).max())
