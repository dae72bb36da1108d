"""Durations are exact, and errors help."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.sync import FOREVER, NEVER, format_duration, format_stamp, parse_duration, trail


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("100ms", 100_000_000),
        ("1s", 10**9),
        ("50us", 50_000),
        ("10ns", 10),
        ("2min", 120 * 10**9),
        ("1h", 3600 * 10**9),
        ("0.1s", 100_000_000),  # not a binary fraction
        ("1.000000001s", 1_000_000_001),
        (" 5 ms ", 5_000_000),
        (7, 7),  # an int is nanoseconds
    ],
)
def test_durations_are_parsed_exactly(text: str | int, nanoseconds: int) -> None:
    assert parse_duration(text) == nanoseconds


@pytest.mark.parametrize(
    ("value", "hint"),
    [
        ("10", "needs a unit"),
        ("1.5ns", "whole number of nanoseconds"),
        ("3 sec", "the units are ns, us, ms, s, min, h"),
        ("", "such as '100ms'"),
        ("-1s", "from 0"),
        (1.5, "such as '100ms'"),
        (True, "such as '100ms'"),
        ("10000000h", "from 0 to"),
    ],
)
def test_bad_duration_is_refused_with_a_hint(value: object, hint: str) -> None:
    with pytest.raises(ValueError, match=hint):
        parse_duration(value)


@given(st.integers(0, FOREVER - 1))
def test_formatted_durations_parse_back(duration: int) -> None:
    assert parse_duration(format_duration(duration)) == duration


def test_stamps_are_shown_with_all_nine_decimals() -> None:
    assert format_stamp(1_700_000_000_123_456_789) == "2023-11-14T22:13:20.123456789Z"
    assert format_stamp(1_500_000_000) == "1.500000000s"
    assert format_stamp(86_400 * 10**9) == "86400.000000000s"  # a clock that began with the machine
    assert format_stamp(-1) == "-0.000000001s"
    assert (format_stamp(NEVER), format_stamp(FOREVER)) == ("never", "forever")


def test_a_trailing_frontier_leaves_the_ends_of_time_alone() -> None:
    assert [trail(f, 5) for f in (NEVER, 10, FOREVER)] == [NEVER, 5, FOREVER]
