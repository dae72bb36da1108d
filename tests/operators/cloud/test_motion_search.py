"""The search for motions among matches of which most are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.messages.geometry import transform_points
from operators.cloud.motion_search import MOST_MATCHES, matches, motions
from operators.geometry import se3

TRUE = se3.exp(np.array([1.0, -0.5, 0.2, 0.1, -0.2, 2.0]))


def made(right: int, wrong: int, seed: int = 0) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Points and normals of matches in 10 x 10 x 2 m: `right` ones are moved by TRUE with 2 cm of noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-5, -5, -1], [5, 5, 1], (right + wrong, 3))
    normals = rng.normal(size=(right + wrong, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moved = transform_points(TRUE, points) + rng.normal(0, 0.02, points.shape)
    turned = normals @ TRUE[:3, :3].T
    lost = right + rng.permutation(wrong)
    moved[right:], turned[right:] = moved[lost], turned[lost]
    return (points, normals), (moved, turned)


@pytest.mark.parametrize("right", [8, 12, 40])
def test_a_few_right_matches_of_hundreds_are_found(right: int) -> None:
    """Eight of 600: a triple drawn at random is right once in 400,000."""
    best = motions(*made(right, 600 - right), 0.1, 2000, np.random.default_rng(0))[0]
    off = se3.log(np.linalg.inv(TRUE) @ best)
    assert np.linalg.norm(off[:3]) < 0.1
    assert np.linalg.norm(off[3:]) < 0.05


def test_matches_that_agree_with_nothing_give_no_motion() -> None:
    rng = np.random.default_rng(1)
    source, _ = made(0, 20)
    far = rng.uniform(-100, 100, (20, 3)), source[1]
    assert motions(source, far, 0.1, 2000, rng) == []


def test_motions_that_are_returned_are_apart() -> None:
    source, target = made(200, 100)
    found = motions(source, target, 0.1, 2000, np.random.default_rng(0))
    for k, T in enumerate(found):
        for other in found[:k]:
            cosine = (np.trace(T[:3, :3].T @ other[:3, :3]) - 1) / 2
            assert np.linalg.norm(T[:3, 3] - other[:3, 3]) > 0.5 or cosine < 0.98


@pytest.mark.long
def test_more_matches_than_it_can_compare_are_thinned() -> None:
    source, target = made(MOST_MATCHES, 600)
    best = motions(source, target, 0.1, 100, np.random.default_rng(0))[0]
    assert np.linalg.norm(se3.log(np.linalg.inv(TRUE) @ best)) < 0.1


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_matches_give_no_motion(count: int) -> None:
    assert motions(*made(count, 0), 0.1, 2000, np.random.default_rng(0)) == []


def test_matches_are_mutual() -> None:
    source = np.array([[0.0], [1.0], [5.0]])
    target = np.array([[0.9], [5.1], [5.2]])
    assert matches(source, target).tolist() == [[1, 0], [2, 1]]
