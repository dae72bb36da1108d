"""Combination of sensors by covariance: consistent, on the manifold, triangulated, and contradictions found."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from operators.fusion.redundant.combination import (
    Bearing,
    Place,
    RigidPose,
    Unknown,
    contradicts,
    place_consistency,
    place_misfits,
    placed,
    pose_misfits,
    posed,
)

SEEDS = st.integers(0, 10_000)
Array = np.ndarray


def covariance(rng: np.random.Generator, size: int = 3, scale: float = 0.05) -> Array:
    A = rng.normal(0, scale, (size, size))
    return A @ A.T + np.eye(size) * (0.2 * scale) ** 2


def ray(rng: np.random.Generator, origin: Array, point: Array, sigma: float) -> Bearing:
    way = point - origin
    off = way + rng.normal(0, sigma, 3) * np.linalg.norm(way)
    return Bearing(origin, off / np.linalg.norm(off), sigma)


@given(SEEDS)
def test_positions_are_combined_as_by_weighted_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = [Place(rng.normal(0, 1, 3), covariance(rng)) for _ in range(3)]
    point, C = placed(seen)
    informations = [np.linalg.inv(one.covariance) for one in seen]
    expected = np.linalg.inv(sum(informations))
    assert np.allclose(C, expected, rtol=1e-6)
    pulls = sum(J @ one.position for J, one in zip(informations, seen, strict=True))
    assert np.allclose(point, expected @ pulls, atol=1e-6)


def test_triangulation_errors_are_consistent_with_the_covariance() -> None:
    rng = np.random.default_rng(0)
    normalised = []
    for _ in range(400):
        point = rng.uniform([2, -2, -1], [5, 2, 1])
        origins = np.array([[0.0, 0.5, 0.0], [0.0, -0.5, 0.1], [0.3, 0.0, 0.4]])
        found, C = placed([ray(rng, origin, point, 0.003) for origin in origins])
        normalised.append((found - point) @ np.linalg.solve(C, found - point))
    assert np.mean(normalised) == pytest.approx(3.0, abs=0.4)


def test_range_reduces_the_covariance_along_the_bearings() -> None:
    rng = np.random.default_rng(1)
    point = np.array([6.0, 0.2, 0.3])
    rays = [ray(rng, np.array([0.0, y, 0.0]), point, 0.004) for y in (-0.1, 0.1)]
    _, alone = placed(rays)
    found, both = placed([*rays, Place(point + np.array([0.02, 0.1, -0.1]), np.diag([0.02**2, 0.2**2, 0.2**2]))])
    assert both[0, 0] < 0.1 * alone[0, 0]
    assert np.linalg.norm(found - point) < 0.06


@pytest.mark.parametrize(
    ("rays", "words"),
    [
        ([([0, 0, 0], [1, 0, 0])], "a single bearing"),
        ([([0, 0, 0], [1, 0, 0]), ([0, 1, 0], [1, 0, 0])], "all but parallel"),
        ([([0, 0, 0], [1, 0.1, 0]), ([0, 1, 0], [1, 0.3, 0])], "behind a sensor"),
    ],
    ids=["one", "parallel", "behind"],
)
def test_bearings_that_say_no_place_are_refused(rays: list[tuple[list[float], list[float]]], words: str) -> None:
    seen = [Bearing(np.array(o), np.array(d) / np.linalg.norm(d), 0.01) for o, d in rays]
    with pytest.raises(Unknown, match=words):
        placed(seen, largest=100.0)


@given(SEEDS)
def test_the_mean_of_rotations_does_not_depend_on_the_axes_in_which_they_are_given(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base = Rotation.random(random_state=seed)
    turns = [base * Rotation.from_rotvec(rng.normal(0, 0.3, 3)) for _ in range(3)]
    weights = rng.uniform(1, 10, 3)

    def mean(axes: Rotation) -> Rotation:
        seen = [
            RigidPose(np.zeros(3), (axes * R).as_matrix(), np.eye(6) * w) for R, w in zip(turns, weights, strict=True)
        ]
        return Rotation.from_matrix(posed(seen).rotation)

    other = Rotation.random(random_state=seed + 1)
    assert (mean(other).inv() * other * mean(Rotation.identity())).magnitude() < 1e-6
    assert (mean(Rotation.identity()).inv() * Rotation.concatenate(turns).mean(weights)).magnitude() < 0.15


def test_an_orientation_alone_and_a_position_alone_make_a_pose() -> None:
    R = Rotation.from_euler("z", 3.0).as_matrix()
    where = RigidPose(np.array([1.0, 2.0, 3.0]), np.eye(3), np.diag([100.0, 100, 100, 0, 0, 0]))
    how = RigidPose(np.zeros(3), R, np.diag([0.0, 0, 0, 400, 400, 400]))
    for seen in ([where, how], [how, where]):
        mean = posed(seen)
        assert np.allclose(mean.position, [1, 2, 3])
        assert np.allclose(mean.rotation, R)
    assert np.isnan(pose_misfits([where, how])).all()


def test_a_contradiction_is_found_as_often_as_chance_makes_one() -> None:
    rng = np.random.default_rng(3)
    alarms = 0
    for _ in range(400):
        seen = []
        for _ in range(3):
            C = covariance(rng)
            seen.append(Place(rng.multivariate_normal(np.zeros(3), C), C))
        alarms += contradicts(place_consistency(seen), 0.95)
    assert 8 <= alarms <= 34
    seen[1] = Place(seen[1].position + 2.0, seen[1].covariance)
    assert contradicts(place_consistency(seen), 0.999)


def test_misfit_of_a_place_is_its_distance_from_the_others() -> None:
    at = [np.zeros(3), np.array([0.0, 0.1, 0.0]), np.array([2.0, 0.0, 0.0])]
    misfits = place_misfits([Place(place, np.eye(3) * 0.01) for place in at])
    off = np.array([2.0, -0.05, 0.0])
    assert misfits[2] == pytest.approx(off @ off / 0.015 / 3)
    assert misfits[2] > 3 * misfits[:2].max()
    assert np.isnan(place_misfits([Bearing(at[0], at[2] / 2, 0.01)])).all()
