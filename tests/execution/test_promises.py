"""How far a recorded stream may be promised when the clock behind it went back."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dataflow.execution.feeds.log import promises
from dataflow.sync import FOREVER, NEVER

INCARNATIONS = st.lists(st.lists(st.integers(0, 50), unique=True, min_size=1).map(sorted), max_size=5)


@given(INCARNATIONS)
def test_no_message_that_is_not_late_lies_within_a_promise(incarnations: list[list[int]]) -> None:
    stamps = [stamp for part in incarnations for stamp in part]
    for k, promised in enumerate(promises(stamps)):
        reached = max(stamps[:k], default=NEVER)
        for stamp in stamps[k:]:
            assert stamp > promised or stamp <= reached
            reached = max(reached, stamp)


@given(INCARNATIONS)
def test_no_message_of_the_same_incarnation_lies_within_a_promise(incarnations: list[list[int]]) -> None:
    given = promises([stamp for part in incarnations for stamp in part])
    before = 0
    for part in incarnations:
        for k in range(1, len(part)):
            assert part[k] > given[before + k]
        before += len(part)


def test_monotonic_stream_is_promised_up_to_its_next_message() -> None:
    assert promises([3, 5, 9]) == [2, 4, 8, FOREVER]


def test_a_stream_that_catches_up_promises_nothing_until_it_has() -> None:
    assert promises([3, 9, 4, 8, 12]) == [2, 8, 11, NEVER, NEVER, FOREVER]
