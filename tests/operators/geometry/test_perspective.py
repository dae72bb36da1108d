"""Poses of a camera from points, some of which are elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.perspective import agreed_pose
from operators.geometry.pinhole import project

K = np.array([[262.0, 0.0, 159.5], [0.0, 262.0, 119.5], [0.0, 0.0, 1.0]])
SIZE = np.array([320, 240])

Scene = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]


def seen(seed: int, thickness: float, count: int = 120) -> Scene:
    """Points of a slanted wall 2.5 m away, metres thick, their pixels, T_camera_world, and which are seen elsewhere."""
    rng = np.random.default_rng(seed)
    T_camera_world = se3.exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 0.2, 0.2, 0.2])
    rays = (rng.uniform(size=(count, 2)) * SIZE - K[:2, 2]) / 262.0
    z = np.clip(2.5 / (rays @ rng.uniform(-0.8, 0.8, 2) + 1.0), 0.5, 6.0) + thickness * rng.normal(size=count)
    points = np.column_stack([rays * z[:, None], z])
    pixels = project(points, K) + 0.3 * rng.normal(size=(count, 2))
    elsewhere = rng.random(count) < 0.1
    pixels[elsewhere] = rng.uniform(size=(np.count_nonzero(elsewhere), 2)) * SIZE
    return transform_points(invert(T_camera_world), points), pixels, T_camera_world, elsewhere


@given(seed=st.integers(0, 10**6), thickness=st.sampled_from([0.0, 0.005, 0.3]))
def test_pose_is_that_of_the_points_which_agree(seed: int, thickness: float) -> None:
    points, pixels, T_camera_world, elsewhere = seen(seed, thickness)
    found = agreed_pose(points, pixels, K, 1.0, 300)

    T, agree = found
    error = se3.log(invert(T_camera_world) @ T)
    assert np.linalg.norm(error[:3]) < 0.04
    assert np.linalg.norm(error[3:]) < 0.02
    assert np.count_nonzero(~elsewhere[agree]) > 0.75 * np.count_nonzero(~elsewhere)


@pytest.mark.parametrize("count", [0, 4])
def test_too_few_points_have_no_pose(count: int) -> None:
    points, pixels, _, _ = seen(1, 0.3)
    assert agreed_pose(points[:count], pixels[:count], K, 1.0, 300) is None


def test_same_points_give_the_same_bytes_after_other_draws() -> None:
    points, pixels, _, _ = seen(2, 0.3)
    first = agreed_pose(points, pixels, K, 1.0, 300)
    agreed_pose(*seen(3, 0.3)[:2], K, 1.0, 300)
    again = agreed_pose(points, pixels, K, 1.0, 300)
    assert first[0].tobytes() == again[0].tobytes()
    assert first[1].tobytes() == again[1].tobytes()
