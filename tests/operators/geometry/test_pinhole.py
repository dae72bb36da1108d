"""Projection and its inverse, held against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from operators.geometry.pinhole import project, unproject

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
