"""Pairing stamps: symmetric, one to one, and equal to the definition by brute force."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from operators.association import mutually_nearest

STAMPS = st.lists(st.integers(-60, 60), unique=True, max_size=12).map(sorted)


def by_definition(first: list[int], second: list[int], tolerance: int) -> list[tuple[int, int]]:
    """Every pair in which each is the other's nearest, the earlier stamp winning a tie."""

    def nearest(stamps: list[int], stamp: int) -> int:
        return min(range(len(stamps)), key=lambda i: (abs(stamps[i] - stamp), stamps[i]))

    return [
        (i, j)
        for i, a in enumerate(first)
        for j, b in enumerate(second)
        if abs(a - b) <= tolerance and nearest(second, a) == j and nearest(first, b) == i
    ]


@settings(max_examples=200, deadline=None)
@given(STAMPS, STAMPS, st.integers(0, 30))
def test_pairs_are_those_of_the_definition(first: list[int], second: list[int], tolerance: int) -> None:
    assert mutually_nearest(first, second, tolerance) == by_definition(first, second, tolerance)


def test_a_stamp_is_not_taken_from_a_nearer_partner() -> None:
    assert mutually_nearest([0, 10], [9], 10) == [(1, 0)]  # greedy pairing in order would give (0, 0)


def test_stamps_out_of_order_are_refused() -> None:
    with pytest.raises(ValueError, match="3 follows 5"):
        mutually_nearest([5, 3], [1], 10)
