"""Rotations and rigid transforms against SciPy and by their algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dataflow.messages import geometry

SEEDS = st.integers(0, 2**32 - 1)


def random_quaternions(seed: int, count: int = 20) -> np.ndarray:
    return Rotation.random(count, random_state=seed).as_quat()


def random_transforms(seed: int, count: int = 5) -> np.ndarray:
    return geometry.transform_matrix(
        np.random.default_rng(seed).normal(size=(count, 3)), random_quaternions(seed, count)
    )


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_matrices_and_products_agree_with_scipy(seed: int) -> None:
    a, b = random_quaternions(seed), random_quaternions(seed + 1 & 0xFFFF)
    assert np.allclose(geometry.quaternion_to_matrix(a), Rotation.from_quat(a).as_matrix(), atol=1e-14)
    product = geometry.quaternion_to_matrix(geometry.quaternion_multiply(a, b))
    assert np.allclose(product, (Rotation.from_quat(a) * Rotation.from_quat(b)).as_matrix(), atol=1e-14)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_a_quaternion_survives_its_matrix(seed: int) -> None:
    q = random_quaternions(seed)
    again = geometry.matrix_to_quaternion(geometry.quaternion_to_matrix(q))
    assert np.allclose(again, np.where(q[:, 3:] < 0, -q, q), atol=1e-12)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_one_rotation_has_the_quaternion_that_it_has_among_others(seed: int) -> None:
    matrices = geometry.quaternion_to_matrix(random_quaternions(seed))
    assert (geometry.matrix_to_quaternion(matrices) == [geometry.matrix_to_quaternion(m) for m in matrices]).all()


@pytest.mark.parametrize("angle", [0.0, 1e-12, np.pi - 1e-9, np.pi, np.pi + 1e-9, 2 * np.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (1, -2, 1e-9)])
def test_no_rotation_is_ill_conditioned(axis: tuple[float, ...], angle: float) -> None:
    matrix = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle).as_matrix()
    quaternion = geometry.matrix_to_quaternion(matrix)
    assert quaternion[3] >= 0
    assert np.allclose(geometry.quaternion_to_matrix(quaternion), matrix, atol=1e-14)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_inverse_and_composition(seed: int) -> None:
    T_a_b, T_b_c = random_transforms(seed), random_transforms(seed + 1 & 0xFFFF)
    assert np.allclose(T_a_b @ geometry.invert(T_a_b), np.eye(4), atol=1e-12)
    assert np.allclose(geometry.invert(T_a_b @ T_b_c), geometry.invert(T_b_c) @ geometry.invert(T_a_b), atol=1e-12)
    points = np.random.default_rng(seed).normal(size=(7, 3))
    there = geometry.transform_points(T_a_b[0], geometry.transform_points(T_b_c[0], points))
    assert np.allclose(there, geometry.transform_points(T_a_b[0] @ T_b_c[0], points), atol=1e-12)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_a_transform_survives_being_split(seed: int) -> None:
    matrix = random_transforms(seed)
    assert np.allclose(geometry.transform_matrix(*geometry.split_matrix(matrix)), matrix, atol=1e-12)


@given(st.floats(-3.14, 3.14))
@settings(max_examples=50, deadline=None)
def test_yaw_survives_its_quaternion(yaw: float) -> None:
    quaternion = geometry.quaternion_from_yaw(yaw)
    assert np.allclose(geometry.quaternion_to_matrix(quaternion), Rotation.from_euler("z", yaw).as_matrix(), atol=1e-14)
    assert abs(float(geometry.yaw_of(quaternion)) - yaw) < 1e-12


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_roll_pitch_and_yaw_are_those_about_the_fixed_axes(seed: int) -> None:
    for rotation in Rotation.random(5, random_state=seed):
        assert np.allclose(geometry.roll_pitch_yaw(rotation.as_matrix()), rotation.as_euler("xyz"), atol=1e-9)


def test_any_leading_dimensions_are_taken() -> None:
    q = random_quaternions(1, 6).reshape(2, 3, 4)
    assert geometry.quaternion_to_matrix(q).shape == (2, 3, 3, 3)
    assert geometry.matrix_to_quaternion(geometry.quaternion_to_matrix(q)).shape == (2, 3, 4)
    assert geometry.quaternion_to_matrix(q[:0]).shape == (0, 3, 3, 3)
    assert geometry.matrix_to_quaternion(np.zeros((0, 4, 4))).shape == (0, 4)
    assert geometry.invert(np.zeros((0, 4, 4))).shape == (0, 4, 4)
