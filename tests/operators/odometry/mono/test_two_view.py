"""Two views of made points: the motion, and what no two views can tell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.odometry.mono.two_view import TwoViewConfig, TwoViewFailure, TwoViews, triangulate, turned, two_views

Array = NDArray[np.float64]
K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
CONFIG = TwoViewConfig()


def seen(points: Array, T_second_first: Array, rng: np.random.Generator, noise: float = 0.4) -> tuple[Array, Array]:
    """Pixels (N, 2) of points (N, 3) in the first camera, in both views."""
    first, second = project(points, K), project(transform_points(T_second_first, points), K)
    return first + rng.normal(0, noise, first.shape), second + rng.normal(0, noise, second.shape)


def scattered(rng: np.random.Generator, count: int = 250) -> Array:
    z = rng.uniform(2.0, 7.0, count)
    return np.column_stack([rng.uniform(-0.5, 0.5, count) * z, rng.uniform(-0.4, 0.4, count) * z, z])


def on_wall(rng: np.random.Generator, count: int = 250) -> Array:
    """Points of a wall that stands askew."""
    u, v = rng.uniform(-1.5, 1.5, count), rng.uniform(-1.0, 1.0, count)
    return np.column_stack([u, v, 3.0 + 0.5 * u + 0.2 * v])


def off(found: TwoViews, T: Array) -> tuple[float, float]:
    """Degrees by which the rotation and the direction of the translation are off."""
    turn = np.linalg.norm(se3.log(found.T_second_first @ np.linalg.inv(T))[3:])
    t = T[:3, 3] / np.linalg.norm(T[:3, 3])
    direction = np.arccos(np.clip(t @ found.T_second_first[:3, 3], -1, 1))
    return float(np.degrees(turn)), float(np.degrees(direction))


@pytest.mark.parametrize(
    "twist",
    [
        [0.8, 0.0, 0.0, 0.0, 0.05, 0.0],  # aside
        [0.02, -0.02, 0.6, 0.02, -0.03, 0.01],  # ahead
        [-0.2, 0.1, -0.2, 0.1, 0.2, -0.1],  # every way
    ],
)
def test_the_motion_is_found_among_wrong_pairs(twist: list[float]) -> None:
    rng = np.random.default_rng(1)
    T = se3.exp(np.array(twist))
    points = scattered(rng)
    first, second = seen(points, T, rng)
    second[:50] = rng.uniform([0, 0], [640, 480], (50, 2))
    found = two_views(first, second, K, CONFIG)
    turn, direction = off(found, T)
    assert turn < 1.0  # before any adjustment
    assert direction < 5.0
    assert np.count_nonzero(found.chosen < 50) <= 5
    depth = found.points[:, 2] * np.linalg.norm(T[:3, 3]) / points[found.chosen, 2]
    assert np.median(depth) == pytest.approx(1.0, abs=0.05)


def test_a_wall_allows_two_motions_and_is_never_taken_wrongly() -> None:
    T = se3.exp(np.array([1.0, 0.05, 0.4, 0.0, -0.3, 0.02]))
    answers = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        answers.append(two_views(*seen(on_wall(rng), T, rng), K, CONFIG))
        if isinstance(answers[-1], TwoViews):
            assert max(off(answers[-1], T)) < 5.0
    assert TwoViewFailure.AMBIGUOUS in answers


@settings(max_examples=25, deadline=None)
@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1),
    angle=st.floats(0.06, 0.4),
    flat=st.booleans(),
)
def test_a_turn_on_the_spot_never_gives_a_motion(axis: tuple[float, float, float], angle: float, flat: bool) -> None:
    rng = np.random.default_rng(3)
    T = se3.exp(np.concatenate([np.zeros(3), angle * np.array(axis) / np.linalg.norm(axis)]))
    found = two_views(*seen((on_wall if flat else scattered)(rng), T, rng), K, CONFIG)
    assert found in (TwoViewFailure.ROTATION, TwoViewFailure.STILL)


def test_a_camera_that_stands_and_a_view_of_little_are_named() -> None:
    rng = np.random.default_rng(4)
    points = scattered(rng)
    assert two_views(*seen(points, np.eye(4), rng), K, CONFIG) is TwoViewFailure.STILL
    aside = se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert two_views(*seen(points[:30], aside, rng), K, CONFIG) is TwoViewFailure.FEW


def test_corners_that_move_at_random_agree_on_nothing() -> None:
    rng = np.random.default_rng(5)
    first = rng.uniform([0, 0], [640, 480], (200, 2))
    found = two_views(first, rng.uniform([0, 0], [640, 480], (200, 2)), K, CONFIG)
    assert isinstance(found, TwoViewFailure)


def test_the_same_views_give_the_same_bytes() -> None:
    rng = np.random.default_rng(6)
    first, second = seen(scattered(rng), se3.exp(np.array([0.8, 0.0, 0.1, 0.0, 0.05, 0.0])), rng)
    runs = [two_views(first, second, K, CONFIG) for _ in range(20)]
    assert all(isinstance(run, TwoViews) for run in runs)
    assert len({run.points.tobytes() for run in runs if isinstance(run, TwoViews)}) == 1


def test_rays_that_cross_meet_at_their_point() -> None:
    rng = np.random.default_rng(7)
    points = scattered(rng, 40)
    T_a, T_b = se3.exp(np.array([0.1, 0, 0, 0, 0.1, 0])), se3.exp(np.array([-0.4, 0.1, 0.2, 0.05, 0, 0]))
    seen_at = [project(transform_points(np.linalg.inv(T), points), K) for T in (T_a, T_b)]
    found, told = triangulate(T_a, T_b, *seen_at, K)
    np.testing.assert_allclose(found, points, atol=1e-6)
    np.testing.assert_allclose(told[:, 0], transform_points(np.linalg.inv(T_a), points)[:, 2], atol=1e-6)
    np.testing.assert_allclose(told[:, 1], transform_points(np.linalg.inv(T_b), points)[:, 2], atol=1e-6)


def test_the_turn_of_most_rays_is_found() -> None:
    rng = np.random.default_rng(8)
    rays = scattered(rng)
    R = se3.exp(np.array([0, 0, 0, 0.1, -0.2, 0.05]))[:3, :3]
    others = rays @ R.T
    others[:60] += rng.normal(0, 1.0, (60, 3))
    np.testing.assert_allclose(turned(rays, others, 1e-3), R, atol=2e-3)
