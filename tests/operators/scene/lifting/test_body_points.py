"""Points of bodies in boxes whose edges are wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from operators.scene.lifting.body_points import beyond, body_of

UP = np.array([0.0, 0.0, 1.0])


def column(x: float, low: float, high: float) -> NDArray[np.float64]:
    """Points of an upright bar."""
    heights = np.arange(low, high, 0.02)
    return np.column_stack([np.full(len(heights), x), np.zeros(len(heights)), heights])


def body(parts: Sequence[NDArray[np.float64]], lowest: float, highest: float) -> tuple[NDArray[np.float64], float]:
    """The points of the body in a box from one height to another, each part being a cluster, and its share."""
    points = np.concatenate(parts)
    groups = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    inner = (points[:, 2] >= lowest) & (points[:, 2] <= highest)
    found = body_of(points, inner, groups, UP)
    return points[found[0]], found[1]


def test_a_head_above_the_box_is_of_the_body() -> None:
    points, share = body([column(0, 0.5, 1.4), column(0, 1.45, 1.7)], 0.5, 1.4)
    assert points[:, 2].max() > 1.65
    assert share == 1.0


def test_legs_below_a_chair_that_hides_the_middle_are_of_the_body() -> None:
    points, _ = body([column(0, 0.9, 1.4), column(0.1, 0.1, 0.55)], 0.0, 1.4)
    assert points[:, 2].min() < 0.2


def test_person_farther_away_in_the_same_box_is_another() -> None:
    points, share = body([column(0, 0.2, 1.6), column(1.5, 0.9, 1.6)], 0.0, 1.7)
    assert points[:, 0].max() == 0
    assert 0.6 < share < 0.7


def test_nothing_in_the_box_is_no_body() -> None:
    points = column(0, 0.5, 1.5)
    assert body_of(points, np.zeros(len(points), bool), np.zeros(len(points), np.intp), UP) is None


def test_the_larger_box_grows_with_its_sides() -> None:
    assert beyond((10, 20, 20, 60)) == (3, 4, 27, 76)
