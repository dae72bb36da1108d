"""Combinations of settings."""

from __future__ import annotations

import pytest

from dataflow.sweep.plan import SweepError, grid


def test_every_combination_comes_once_with_the_last_name_changing_fastest() -> None:
    assert grid(["a=1,2", "b.c=x, y"]) == [
        (("a", "1"), ("b.c", "x")),
        (("a", "1"), ("b.c", "y")),
        (("a", "2"), ("b.c", "x")),
        (("a", "2"), ("b.c", "y")),
    ]
    assert grid([]) == [()]


def test_a_comma_inside_brackets_or_quotes_belongs_to_the_value() -> None:
    assert grid(['classes=[cup, "a,b"],[chair],"x,y"']) == [
        (("classes", '[cup, "a,b"]'),),
        (("classes", "[chair]"),),
        (("classes", '"x,y"'),),
    ]


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["a"], "expected NAME=VALUE"),
        (["a="], "expected NAME=VALUE"),
        (["a=1,,2"], "expected NAME=VALUE"),
        (["=1"], "expected NAME=VALUE"),
        (["a=1", "a=2"], "a has values already"),
        (["a=1,2,1"], "a value stands there twice"),
    ],
)
def test_what_is_no_choice_is_refused(words: list[str], what: str) -> None:
    with pytest.raises(SweepError, match=what):
        grid(words)
