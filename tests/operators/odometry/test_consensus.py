"""The rigid motion that pairs of points agree on, most of which are wrong."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.odometry.consensus import consensus

T_A_B = se3.exp(np.array([0.4, -0.2, 0.3, 0.1, 0.5, -0.2]))

Pairs = tuple[NDArray[np.float64], NDArray[np.float64]]


def pairs(right: int, wrong: int) -> Pairs:
    """Points that a camera sees 1 to 4 m away, and where a map has them to within a centimetre, or anywhere."""
    rng = np.random.default_rng(right + wrong)
    seen = rng.uniform([-1.5, -1.0, 1.0], [1.5, 1.0, 4.0], (right + wrong, 3))
    known = transform_points(T_A_B, seen) + rng.normal(0.0, 0.01, seen.shape)
    known[right:] = rng.uniform(-3.0, 3.0, (wrong, 3))
    return known, seen


@pytest.mark.parametrize(("right", "wrong"), [(10, 0), (12, 100), (20, 250)])
def test_few_right_pairs_among_many_wrong_ones_give_the_motion(right: int, wrong: int) -> None:
    known, seen = pairs(right, wrong)
    found = consensus(known, seen, np.arange(len(seen)))[0]
    assert found.agree[:right].all()
    assert found.count <= right + 2
    off = se3.log(invert(T_A_B) @ found.T_a_b)
    assert np.linalg.norm(off[:3]) < 0.03
    assert np.linalg.norm(off[3:]) < 0.02


def test_pairs_that_are_all_wrong_agree_on_nothing_that_many_hold() -> None:
    known, seen = pairs(0, 200)
    found = consensus(known, seen, np.arange(len(seen)))
    assert all(one.count < 8 for one in found)


def test_a_point_that_several_views_pair_counts_once() -> None:
    known, seen = pairs(10, 0)
    found = consensus(np.tile(known, (3, 1)), np.tile(seen, (3, 1)), np.tile(np.arange(10), 3))[0]
    assert found.agree.all()
    assert found.count == 10


def test_one_point_seen_over_and_over_gives_no_motion() -> None:
    known, seen = pairs(3, 0)
    assert consensus(np.tile(known, (5, 1)), np.tile(seen, (5, 1)), np.tile(np.arange(3), 5)) == []


def test_points_that_a_map_holds_twice_give_both_motions() -> None:
    known, seen = pairs(14, 30)
    again = known[:10] + np.array([4.0, 0.0, 0.0])
    names = np.arange(len(seen))
    one, two = consensus(np.concatenate([known, again]), np.concatenate([seen, seen[:10]]), np.r_[names, names[:10]])[
        :2
    ]
    assert (one.count, two.count) == (14, 10)
    assert np.linalg.norm((two.T_a_b - one.T_a_b)[:3, 3]) == pytest.approx(4.0, abs=0.03)
