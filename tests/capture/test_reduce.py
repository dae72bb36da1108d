"""Reduced lists show what the whole list shows, and none of their items can be left out."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from dataflow.capture.reduce import needed as found_by_bisection
from dataflow.capture.reduce import shortest_end, smallest


@given(st.integers(0, 60), st.sets(st.integers(0, 59), max_size=6))
def test_exactly_what_is_needed_is_left(length: int, needed: set[int]) -> None:
    needed = {item for item in needed if item < length}
    items = range(length)

    def shows(part: Sequence[int]) -> bool:
        return needed <= set(part)

    end = shortest_end(items, shows)
    assert list(end) == list(items[length - len(end) :])
    assert list(smallest(end, shows)) == sorted(needed)
    assert len(end) <= max(1, 2 * (length - min(needed, default=length)))


@given(st.lists(st.integers(0, 9), max_size=40), st.integers(0, 20))
def test_no_single_item_of_the_result_can_be_left_out(items: list[int], least: int) -> None:
    def shows(part: Sequence[int]) -> bool:
        return sum(part) >= least

    if not shows(items):
        return
    left = list(smallest(items, shows))
    assert shows(left)
    assert not any(shows(left[:k] + left[k + 1 :]) for k in range(len(left)))


@given(st.integers(0, 400), st.sets(st.integers(0, 399), max_size=6))
def test_bisection_finds_what_is_needed_by_few_questions(length: int, needed: set[int]) -> None:
    needed = {item for item in needed if item < length}
    asked = 0

    def shows(part: Sequence[int]) -> bool:
        nonlocal asked
        asked += 1
        return needed <= set(part)

    assert list(found_by_bisection(range(length), shows)) == sorted(needed)
    assert asked <= 1 + 10 * len(needed)


@given(st.lists(st.booleans(), min_size=8, max_size=8))
def test_bisection_gives_a_part_that_shows_it_whatever_is_asked(answers: list[bool]) -> None:
    items = list(range(8))

    def shows(part: Sequence[int]) -> bool:
        return len(part) == len(items) or answers[len(part)]

    assert shows(found_by_bisection(items, shows))


def test_with_no_time_left_everything_stays() -> None:
    assert list(smallest([1, 2, 3, 4], lambda part: False)) == [1, 2, 3, 4]
