"""Stamps of evenly spaced frames do not drift."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from operators.sources.pacing import frame_stamp


@given(st.integers(0, 10**12), st.integers(1, 1000))
def test_whole_rates_hit_whole_seconds(seconds: int, rate: int) -> None:
    assert frame_stamp(seconds * rate, rate, 7) == 7 + seconds * 10**9


def test_a_rate_counts_as_the_decimal_it_is_written_as() -> None:
    assert frame_stamp(2997 * 10**9, 29.97, 0) == 100 * 10**9 * 10**9


@given(st.integers(0, 10**6), st.floats(0.1, 1000))
def test_stamps_strictly_increase(index: int, rate: float) -> None:
    assert frame_stamp(index + 1, rate, 0) > frame_stamp(index, rate, 0)
