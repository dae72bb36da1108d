"""Pairing while messages come gives what pairing of the whole lists gives, and keeps little."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from operators.association import mutually_nearest
from operators.evaluation.pairing import Pairing

stamps = st.lists(st.integers(0, 300), max_size=30, unique=True).map(sorted)


@settings(max_examples=150, deadline=None)
@given(stamps, stamps, st.integers(0, 20), st.integers(1, 60))
def test_pairs_are_those_of_the_whole_lists(found: list[int], truth: list[int], tolerance: int, step: int) -> None:
    pairing: Pairing[int, int] = Pairing(tolerance)
    pairs: list[tuple[int, int]] = []
    for now in range(0, 300 + step, step):
        for stamps, add in ((found, pairing.add_found), (truth, pairing.add_truth)):
            for stamp in stamps:
                if now - step < stamp <= now:
                    add(stamp, stamp)
        pairs += pairing.settle(now)
    pairs += pairing.finish()
    expected = [(found[i], truth[j]) for i, j in mutually_nearest(found, truth, tolerance)]
    assert sorted(pairs) == expected
    assert pairing.pairs == len(expected)
    assert pairing.unmatched_found == len(found) - len(expected)
    assert pairing.unmatched_truths == len(truth) - len(expected)


def test_pairing_discards_decided_entries() -> None:
    pairing: Pairing[int, int] = Pairing(1)
    for stamp in range(0, 10_000, 10):
        pairing.add_found(stamp, stamp)
        pairing.add_truth(stamp, stamp)
        pairing.settle(stamp)
        assert len(pairing._found) + len(pairing._truth) <= 4
