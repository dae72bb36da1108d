"""Motions that lay points onto others, held to what scipy finds."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from dataflow.messages.geometry import transform_points
from operators.geometry import se3
from operators.geometry.rigid import distances, fitted_motions

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_weighted_motions_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, 3, 7, 3))
    weights = rng.uniform(0.1, 1.0, (3, 7))
    weights /= weights.sum(axis=1, keepdims=True)
    for T, a, b, w in zip(fitted_motions(source, target, weights), source, target, weights, strict=True):
        turn, _ = Rotation.align_vectors(b - w @ b, a - w @ a, w)
        assert np.allclose(T[:3, :3], turn.as_matrix(), atol=1e-6)
        assert np.allclose(T[:3, 3], w @ b - turn.apply(w @ a), atol=1e-6)


@given(seeds)
def test_a_motion_is_found_again(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, points = se3.exp(rng.normal(size=6)), rng.normal(size=(9, 3))
    found = fitted_motions(points[None], transform_points(T, points)[None], np.full((1, 9), 1 / 9))[0]
    assert np.allclose(found, T, atol=1e-9)


def test_a_mirrored_set_of_points_is_turned_not_mirrored() -> None:
    points = np.random.default_rng(3).normal(size=(10, 3))
    T = fitted_motions(points[None], (points * [1.0, 1.0, -1.0])[None], np.full((1, 10), 0.1))[0]
    assert np.isclose(np.linalg.det(T[:3, :3]), 1.0)


@given(seeds)
def test_distances_are_those_of_scipy(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-5.0, 5.0, (12, 3))
    assert np.allclose(distances(points), cdist(points, points), atol=1e-6)
