"""Numbers of the messages of a replay: without gaps, and as recorded where there are none."""

from __future__ import annotations

from itertools import groupby

from hypothesis import given
from hypothesis import strategies as st

from dataflow.execution.feeds.log import gapless
from dataflow.messages import Number
from dataflow.recording import Recorded

PLACES = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 9)), unique=True, max_size=30).map(sorted)


def recorded(stream: str, incarnation: int, seq: int) -> Recorded:
    message = Number(stamp=seq, value=0.0)
    return Recorded(stream=stream, message=message, seq=seq, incarnation=incarnation)


@given(PLACES, PLACES)
def test_numbers_of_an_incarnation_follow_each_other(left: list[tuple[int, int]], right: list[tuple[int, int]]) -> None:
    mixed = sorted([(place, "left") for place in left] + [(place, "right") for place in right])

    given = list(gapless(recorded(stream, *place) for place, stream in mixed))

    assert [(g.stream, g.incarnation) for g in given] == [(stream, place[0]) for place, stream in mixed]
    for stream, places in (("left", left), ("right", right)):
        numbers = [(g.incarnation, g.seq) for g in given if g.stream == stream]
        for k, (_, part) in enumerate(groupby(numbers, key=lambda each: each[0])):
            taken = [number for _, number in part]
            begin = 0 if k else places[0][1]
            assert taken == list(range(begin, begin + len(taken)))


def test_gapless_numbering_returns_the_recorded_messages() -> None:
    items = [recorded("left", 0, seq) for seq in range(7, 12)]

    assert all(mine is theirs for mine, theirs in zip(gapless(items), items, strict=True))
