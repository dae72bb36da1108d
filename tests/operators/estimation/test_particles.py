"""Particles: drawn in proportion, counted as Fox does, and summed up on the circle."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from operators.estimation.particles import (
    bins_of,
    effective_size,
    mode,
    moments,
    normalised,
    particles_needed,
    systematic,
    wrapped,
)

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    from filterpy.monte_carlo import systematic_resample

WEIGHTS = arrays(np.float64, st.integers(1, 40), elements=st.floats(0.001, 1.0)).map(lambda w: w / w.sum())


@given(WEIGHTS, st.integers(1, 500), st.floats(0, 0.999))
def test_systematic_resampling_draws_particles_in_proportion_to_weight(
    weights: np.ndarray, count: int, offset: float
) -> None:
    drawn = np.bincount(systematic(weights, count, offset), minlength=len(weights))
    assert drawn.sum() == count
    assert (np.abs(drawn - weights * count) < 1 + 1e-6).all()


@given(WEIGHTS, st.floats(0, 0.999))
def test_systematic_resampling_equals_filterpy(weights: np.ndarray, offset: float) -> None:
    with patch("filterpy.monte_carlo.resampling.random", lambda: offset):
        theirs = systematic_resample(weights)
    np.testing.assert_array_equal(systematic(weights, len(weights), offset), theirs)


@given(WEIGHTS)
def test_effective_size_lies_between_one_and_all(weights: np.ndarray) -> None:
    assert 1 - 1e-9 <= effective_size(weights) <= len(weights) + 1e-9


def test_number_of_particles_is_that_of_the_chi_square_bound() -> None:
    from scipy.stats import chi2  # takes a second

    for bins in (5, 50, 500):
        assert particles_needed(bins, 0.05) == pytest.approx(chi2.ppf(0.99, bins - 1) / 0.1, rel=0.01)


@given(st.floats(-3.2, 3.2), st.floats(0.01, 0.5))
def test_the_mean_of_headings_is_that_of_the_circle(heading: float, spread: float) -> None:
    yaw = wrapped(heading + spread * np.array([-1.0, 0.0, 1.0]))
    mean, covariance = moments(np.column_stack([np.zeros((3, 2)), yaw]), np.full(3, 1 / 3))
    assert abs(float(wrapped(np.array(mean[2] - heading)))) < 1e-9
    assert covariance[2, 2] == pytest.approx(2 / 3 * spread**2)


def test_the_mode_is_the_heavier_of_two_places_with_its_share() -> None:
    rng = np.random.default_rng(0)
    poses = np.vstack([rng.normal([0, 0, math.pi], 0.02, (70, 3)), rng.normal([3, 1, 0], 0.02, (30, 3))])
    mean, covariance, share = mode(poses, np.full(100, 0.01), 0.25, 0.175)
    assert np.abs(mean[:2]).max() < 0.02
    assert abs(abs(mean[2]) - math.pi) < 0.02
    assert share == pytest.approx(0.7)
    assert covariance[0, 0] < 0.03**2


def test_bins_on_both_sides_of_half_a_turn_are_neighbours_of_one_ring() -> None:
    poses = np.array([[0.0, 0.0, math.pi - 0.01], [0.0, 0.0, math.pi - 0.01 - 2 * math.pi]])
    keys = bins_of(poses, 0.25, 2 * math.pi / 36)
    assert keys[0] == keys[1]


def test_weights_of_impossible_particles_are_alike() -> None:
    assert normalised(np.full(4, -np.inf)).tolist() == [0.25] * 4
