"""Features of two views matched where a pose between them expects them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.surface import Surface
from operators.slam.visual.guided import guided_pairs
from operators.slam.visual.view import View

K = np.array([[158.0, 0.0, 95.5], [0.0, 158.0, 71.5], [0.0, 0.0, 1.0]])
CAMERA = RgbdCamera(K, K)
SURFACE = Surface(np.zeros((1, 1), np.float32), K)


def views(T: Matrix, seed: int, count: int = 40) -> tuple[View, View]:
    """The same features seen from the origin and from a pose, in another order, their descriptors a little off."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(1.5, 3.0, count)])
    descriptors = (rng.integers(0, 200, (count, 128)) * (rng.random((count, 128)) < 0.2)).astype(np.uint8)
    order = rng.permutation(count)
    there = transform_points(invert(T), points)
    known = view(project(points, K), descriptors, points)
    noisy = descriptors + rng.integers(0, 3, descriptors.shape).astype(np.uint8)
    return known, view(project(there, K)[order], noisy[order], there[order])


def view(pixels: NDArray[np.float64], descriptors: NDArray[np.uint8], points: NDArray[np.float64]) -> View:
    return View(
        pixels.astype(np.float32), descriptors, points.astype(np.float32), SURFACE, np.zeros(0, np.uint8)
    )  # fmt: skip


def pairs_of(known: View, seen: View, T: Matrix, window: float) -> NDArray[np.int64]:
    return guided_pairs(known.points, known.rooted, seen.pixels, seen.rooted, T, CAMERA, window)


@given(st.integers(0, 1000))
def test_features_are_matched_with_themselves_and_each_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.exp(np.concatenate([rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.1, 0.1, 3)]))
    known, seen = views(T, seed)
    pairs = pairs_of(known, seen, T, 3.0)
    assert len(pairs) == len(known.pixels)
    assert len(set(pairs[:, 0].tolist())) == len(set(pairs[:, 1].tolist())) == len(pairs)
    assert np.abs(transform_points(T, seen.points[pairs[:, 1]].astype(float)) - known.points[pairs[:, 0]]).max() < 1e-4


def test_a_feature_outside_the_window_is_no_match() -> None:
    T = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.1, 0.0]))
    known, seen = views(T, 0)
    assert not len(pairs_of(known, seen, np.eye(4), 3.0))


def test_smaller_window_resolves_two_equal_descriptors() -> None:
    known, seen = views(np.eye(4), 1, count=1)
    pixels = np.concatenate([seen.pixels, seen.pixels + np.float32(10)])
    twice = replace(seen, pixels=pixels, descriptors=np.repeat(seen.descriptors, 2, axis=0))
    assert not len(pairs_of(known, twice, np.eye(4), 20.0))
    assert pairs_of(known, twice, np.eye(4), 3.0).tolist() == [[0, 0]]


@pytest.mark.parametrize("lost", ["depth", "behind", "features"])
def test_views_with_nothing_to_look_for_match_nothing(lost: str) -> None:
    known, seen = views(np.eye(4), 2)
    T = np.eye(4)
    if lost == "depth":
        known = replace(known, points=np.full_like(known.points, np.nan))
    elif lost == "behind":
        T[2, 3] = 5.0
    else:
        seen = replace(seen, pixels=seen.pixels[:0], descriptors=seen.descriptors[:0])
    assert pairs_of(known, seen, T, 5.0).shape == (0, 2)
