"""Drops are all counted; of very many, the newest are kept one by one."""

from __future__ import annotations

from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.sync import TICK, Drop, DropLog
from dataflow.sync.drops import KEPT

spans = st.sampled_from([0, 1, 7, KEPT, KEPT + 50, 10**12])


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(st.booleans(), spans, st.integers(1, 20), st.booleans()), max_size=3))
def test_every_drop_is_counted_and_kept_or_counted_as_unlisted(steps: list[tuple[bool, int, int, bool]]) -> None:
    log = DropLog()
    expected: Counter[tuple[str, str]] = Counter()
    accounted: Counter[tuple[str, str]] = Counter()
    for is_ticks, number, period, take in steps:
        if is_ticks:
            log.ticks(range(0, number * period, period), "overflow")
            expected[TICK, "overflow"] += number
        else:
            for seq in range(min(number, KEPT + 50)):
                log.add(Drop("x", "s", seq, seq, 0, "late"))
            expected["x", "late"] += min(number, KEPT + 50)
        if take:
            kept = log.take()
            assert len(kept) <= KEPT
            accounted.update((d.input, d.reason) for d in kept)
            accounted.update(log.take_unlisted())
    accounted.update((d.input, d.reason) for d in log.take())
    accounted.update(log.take_unlisted())

    assert +log.counts == +expected == +accounted


def test_the_newest_are_kept() -> None:
    log = DropLog()

    log.ticks(range(0, 10**12, 10), "overflow")

    assert [d.stamp for d in log.take()] == list(range(10**12 - 10 * KEPT, 10**12, 10))
