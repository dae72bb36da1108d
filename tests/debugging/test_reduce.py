"""Reduced lists show what the whole list shows, and none of their items can be left out."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.debugging.reduce import needed as found_by_bisection
from dataflow.debugging.reduce import none_to_spare, shortest_end, smallest, thinned

Reduced = Callable[[Sequence[int], Callable[[Sequence[int]], bool]], Sequence[int]]


@given(st.integers(0, 60), st.sets(st.integers(0, 59), max_size=6))
def test_reduction_leaves_exactly_the_needed_items(length: int, needed: set[int]) -> None:
    needed = {item for item in needed if item < length}
    items = range(length)

    def shows(part: Sequence[int]) -> bool:
        return needed <= set(part)

    end = shortest_end(items, shows)
    assert list(end) == list(items[length - len(end) :])
    assert list(smallest(end, shows)) == sorted(needed)
    assert len(end) <= max(1, 2 * (length - min(needed, default=length)))


@pytest.mark.parametrize("reduced", [smallest, none_to_spare])
@given(items=st.lists(st.integers(0, 9), max_size=40), least=st.integers(0, 20))
def test_no_single_item_of_the_result_can_be_left_out(reduced: Reduced, items: list[int], least: int) -> None:
    def shows(part: Sequence[int]) -> bool:
        return sum(part) >= least

    if not shows(items):
        return
    left = list(reduced(items, shows))
    assert shows(left)
    assert not any(shows(left[:k] + left[k + 1 :]) for k in range(len(left)))


@given(st.integers(0, 400), st.sets(st.integers(0, 399), max_size=6))
def test_bisection_finds_the_needed_items_in_few_queries(length: int, needed: set[int]) -> None:
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
    assert list(none_to_spare([1, 2, 3, 4], lambda part: False)) == [1, 2, 3, 4]
    assert list(thinned([1, 2, 3, 4], lambda part: False)) == [1, 2, 3, 4]


@given(length=st.integers(1, 200), gap=st.integers(1, 50))
def test_a_stop_is_thinned_by_few_questions_to_messages_that_are_near_enough(length: int, gap: int) -> None:
    asked = 0

    def bridged(part: Sequence[int]) -> bool:
        nonlocal asked
        asked += 1
        steps = [-1, *part, length]
        return all(b - a <= gap for a, b in itertools.pairwise(steps))

    left = none_to_spare(thinned(range(length), bridged), bridged)
    assert bridged(left)
    assert not any(bridged([*left[:k], *left[k + 1 :]]) for k in range(len(left)))
    assert asked <= 20 + 8 * (length // gap + 1)
