"""Which of some inputs have an effect alone, and the shortest run of those that have one only together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from dataflow.blame.links import Effect
from dataflow.blame.split import split

ITEMS = tuple(range(10))


def shown_by(decides: Callable[[set[int]], bool]) -> Callable[[Sequence[int]], tuple[Effect, ...]]:
    return lambda items: (Effect("nudged", (), len(items)),) if decides(set(items)) else ()


@pytest.mark.parametrize(
    ("decides", "found"),
    [
        (lambda items: 3 in items, [[3]]),
        (lambda items: bool({2, 7, 8} & items), [[8], [7], [2]]),
        (lambda items: {4, 6} <= items, [[4, 5, 6]]),
        (lambda items: {0, 9} <= items, [[*ITEMS]]),
        (lambda items: {1, 2, 3} <= items or 8 in items, [[8], [1, 2, 3]]),
        (lambda items: False, []),
    ],
    ids=["one", "several", "a run", "both ends", "one and a run", "none"],
)
def test_split_finds_deciding_items_last_first_else_the_shortest_run(
    decides: Callable[[set[int]], bool], found: list[list[int]]
) -> None:
    shows = shown_by(decides)
    answers = list(split(ITEMS, shows))
    assert [list(items) for items, _ in answers] == found
    assert all(effects == shows(items) for items, effects in answers)


def test_items_that_cancel_each_other_are_found_where_they_are_split() -> None:
    odd = shown_by(lambda items: len(items & {1, 2, 4, 5, 6, 7, 8, 9}) % 2 == 1)

    assert [list(items) for items, _ in split(ITEMS, odd, cancels=True)] == [[9], [8], [7], [6], [5], [4], [2], [1]]
    assert list(split(ITEMS, odd)) == []


def test_nothing_is_asked_of_no_items() -> None:
    def asked(items: Sequence[int]) -> tuple[Effect, ...]:
        raise AssertionError(items)

    assert not list(split((), asked))
