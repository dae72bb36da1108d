"""Projection and its inverse, held against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from operators.geometry.pinhole import project, project_clamped, projection_jacobian, unproject

K = np.array([[520.0, 0, 318.5], [0, 515.0, 241.0], [0, 0, 1]])


@given(st.integers(0, 1000))
def test_project_agrees_with_opencv(seed: int) -> None:
    points = np.random.default_rng(seed).uniform([-2, -2, 0.1], [2, 2, 9], (20, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, None)
    np.testing.assert_allclose(project(points, K), expected[:, 0], atol=1e-6)


@given(st.integers(0, 1000))
def test_unproject_undoes_project(seed: int) -> None:
    points = np.random.default_rng(seed).uniform([-2, -2, 0.1], [2, 2, 9], (20, 3))
    np.testing.assert_allclose(unproject(project(points, K), K) * points[:, 2:], points, atol=1e-9)


def test_points_behind_the_camera_lie_outside_any_image() -> None:
    pixels = project(np.array([[0.5, 0.5, -1.0], [-0.5, 0.2, 0.0], [1e9, 0, 1.0]]), K)
    assert np.isfinite(pixels).all()
    assert (np.abs(pixels).max(axis=1) > 1e5).all()


def test_clamped_projection_and_its_jacobian() -> None:
    points = np.random.default_rng(2).uniform([-2, -2, 0.5], [2, 2, 9], (20, 3))
    np.testing.assert_allclose(project_clamped(points, K, 0.1), project(points, K), atol=1e-9)
    for axis, step in enumerate(1e-6 * np.eye(3)):
        difference = (project(points + step, K) - project(points - step, K)) / 2e-6
        np.testing.assert_allclose(projection_jacobian(points, K, 0.1)[:, :, axis], difference, atol=1e-4)
    behind, nearest = np.array([[0.3, 0.2, -1.0]]), np.array([[0.3, 0.2, 0.1]])
    np.testing.assert_array_equal(project_clamped(behind, K, 0.1), project_clamped(nearest, K, 0.1))
