"""Ticks that are left out in a live run: which, and that nothing else changes."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.sync import Aligner, AlignSpec, TriggerSpec, refs_of

from .scenarios import Repeater, entries, poll_all

SPEC = AlignSpec((TriggerSpec("a", ("a",)),), every=10)


def told(*stamps: int) -> Aligner:
    aligner = Aligner(SPEC)
    for entry in entries("a", *stamps):
        aligner.push("a", entry)
    return aligner


def test_ticks_before_a_stamp_are_dropped_and_the_next_is_on_the_grid() -> None:
    aligner = told(1, 100)

    aligner.skip_ticks(75)

    assert [(f.stamp, f.tick) for f in poll_all(aligner)] == [(1, False), (80, True), (90, True), (100, True)]
    assert aligner.drops == {("@tick", "overflow"): 7}
    assert [d.stamp for d in aligner.take_drops()] == [10, 20, 30, 40, 50, 60, 70]


def test_messages_between_skipped_ticks_fire_without_their_tick() -> None:
    aligner = told(1, 30, 45, 100)

    aligner.skip_ticks(75)

    assert [(f.stamp, f.tick) for f in poll_all(aligner)][:4] == [(1, False), (30, False), (45, False), (80, True)]


def test_only_ticks_known_to_be_due_are_skipped() -> None:
    aligner = told(1, 32)

    aligner.skip_ticks(1000)
    assert aligner.drops == {("@tick", "overflow"): 3}
    aligner.push("a", next(iter(entries("a", 55))))

    assert [f.stamp for f in poll_all(aligner)] == [1, 32, 40, 50, 55]


@settings(max_examples=60)
@given(
    st.lists(st.integers(0, 200), min_size=1, unique=True).map(sorted),
    st.lists(st.integers(0, 250), max_size=4).map(sorted),
)
def test_stamps_increase_ticks_are_made_or_dropped_and_the_firings_can_be_had_again(
    stamps: list[int], skips: list[int]
) -> None:
    aligner = told(*stamps)
    firings = []
    for skip in skips:
        aligner.skip_ticks(skip)
        firing = aligner.poll()
        firings += [] if firing is None else [firing]
    aligner.end("a")
    firings += poll_all(aligner)

    fired = [f.stamp for f in firings]
    assert fired == sorted(set(fired))
    ticks = [f.stamp for f in firings if f.tick] + [d.stamp for d in aligner.take_drops() if d.input == "@tick"]
    assert sorted(ticks) == list(range(-(-stamps[0] // 10) * 10, stamps[-1] + 1, 10))
    again = Repeater(SPEC, [refs_of(f) for f in firings])
    for entry in entries("a", *stamps):
        again.push("a", entry)
    assert [f.stamp for f in poll_all(again)] == fired
