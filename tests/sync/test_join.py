"""Rule 2: who matches whom, and how soon that is decided."""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import takewhile

from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.sync import Aligner, AlignSpec, Entry, Firing, TriggerSpec

from . import reference
from .scenarios import Step, entries, interleave, poll_all, push, tell


def join(tolerance: int, inputs: int = 2) -> Aligner:
    names = "axyz"[:inputs]
    return Aligner(AlignSpec(tuple(TriggerSpec(n, (n,)) for n in names), tolerance=tolerance))


def pairs(fired: Sequence[Firing]) -> list[tuple[int, int]]:
    return [(f.stamp, x.stamp) for f in fired if isinstance(x := f.inputs.get("x"), Entry)]


def test_nearest_is_mutual_where_greedy_would_pair_the_first_that_fits() -> None:
    aligner = join(tolerance=10)
    push(aligner, "a", 0, 10)
    push(aligner, "x", 9)
    aligner.end("a", 10)
    aligner.end("x", 9)
    assert pairs(poll_all(aligner)) == [(10, 9)]
    assert aligner.drops == {("a", "unmatched"): 1}


def test_a_tie_goes_to_the_earlier_stamp_on_either_side() -> None:
    anchors_tie = join(tolerance=5)
    push(anchors_tie, "x", 5)
    push(anchors_tie, "a", 0, 10)
    assert pairs(poll_all(anchors_tie)) == [(0, 5)]

    others_tie = join(tolerance=5)
    push(others_tie, "x", 0, 10)
    push(others_tie, "a", 5)
    assert pairs(poll_all(others_tie)) == [(5, 0)]


def test_a_matched_message_still_is_the_nearest_of_a_later_anchor() -> None:
    aligner = join(tolerance=10)
    push(aligner, "a", 0, 4, 30)
    push(aligner, "x", 1, 12, 31)
    aligner.end("x", 31)
    aligner.end("a", 30)
    assert pairs(poll_all(aligner)) == [(0, 1), (30, 31)]  # not (4, 12): the nearest of 4 is 1, which 0 has
    assert aligner.drops == {("a", "unmatched"): 1, ("x", "unmatched"): 1}


def test_unmatched_anchors_and_unmatched_others_are_counted_apart() -> None:
    aligner = join(tolerance=0)
    push(aligner, "a", 1, 2, 3)
    push(aligner, "x", 0, 2, 4, 5)
    aligner.end("a", 3)
    aligner.end("x", 5)
    assert pairs(poll_all(aligner)) == [(2, 2)]
    assert aligner.drops == {("a", "unmatched"): 2, ("x", "unmatched"): 3}
    assert {(d.input, d.stamp) for d in aligner.take_drops()} == {("a", 1), ("a", 3), ("x", 0), ("x", 4), ("x", 5)}
    assert aligner.take_drops() == []


def test_an_exact_match_decides_at_once() -> None:
    aligner = join(tolerance=10)
    push(aligner, "a", 100)
    assert aligner.poll() is None
    push(aligner, "x", 100)
    assert pairs(poll_all(aligner)) == [(100, 100)]


def test_an_earlier_candidate_decides_once_nothing_nearer_can_follow() -> None:
    aligner = join(tolerance=10)
    push(aligner, "a", 100)
    push(aligner, "x", 97)
    aligner.advance("x", 101)
    assert aligner.poll() is None  # 102 would be nearer than 97
    aligner.advance("x", 102)  # min(100 + 10, 2 * 100 - 97 - 1)
    assert pairs(poll_all(aligner)) == [(100, 97)]


def test_an_anchor_is_passed_over_once_the_tolerance_is() -> None:
    aligner = join(tolerance=10)
    push(aligner, "a", 100)
    aligner.advance("x", 109)
    assert aligner.waiting().stamp == 100
    aligner.advance("x", 110)
    assert aligner.waiting() is None
    assert aligner.drops == {("a", "unmatched"): 1}


def test_a_later_candidate_waits_for_the_next_anchor_to_be_farther() -> None:
    aligner = join(tolerance=10)
    push(aligner, "a", 100)
    push(aligner, "x", 104)
    aligner.advance("a", 106)
    assert aligner.poll() is None  # an anchor at 107 would be nearer to 104
    assert aligner.waiting().needs == {"a": 107}
    aligner.advance("a", 107)  # 2 * 104 - 100 - 1
    assert pairs(poll_all(aligner)) == [(100, 104)]


def test_a_match_does_not_wait_for_messages_that_cannot_change_it() -> None:
    aligner = join(tolerance=10)
    push(aligner, "a", 100)
    push(aligner, "x", 104)
    push(aligner, "a", 108)
    assert pairs(poll_all(aligner)) == [(100, 104)]


def test_one_hopeless_input_passes_the_anchor_without_waiting_for_the_others() -> None:
    aligner = join(tolerance=1, inputs=3)
    push(aligner, "a", 10)
    aligner.advance("x", 11)
    assert aligner.waiting() is None
    push(aligner, "y", 10)
    aligner.end("a", 10)
    assert aligner.waiting() is None
    assert aligner.drops == {("a", "unmatched"): 1, ("y", "unmatched"): 1}


def decided_by_rule(tolerance: int, anchor: int, anchors: list[int], a_front: int, xs: list[int], x_front: int) -> bool:
    """Rule 2's condition, word for word: is enough known of the other input to decide `anchor`?"""
    below = [x for x in xs if x <= anchor]
    enough = min(anchor + tolerance, 2 * anchor - max(below) - 1) if below else anchor + tolerance
    if not (any(x >= anchor for x in xs) or x_front >= enough):
        return False
    near = reference.nearest(anchor, xs)
    if near is None or near <= anchor or near - anchor > tolerance:
        return True
    return any(a > anchor and a >= near for a in anchors) or a_front >= 2 * near - anchor - 1


@settings(max_examples=150, deadline=None)
@given(
    st.integers(0, 10),
    st.lists(st.integers(0, 40), unique=True, max_size=8).map(sorted),
    st.lists(st.integers(0, 40), unique=True, max_size=8).map(sorted),
    st.randoms(use_true_random=False),
)
def test_anchor_is_decided_no_later_than_by_the_rule(
    tolerance: int, anchors: list[int], others: list[int], rng: random.Random
) -> None:
    aligner = join(tolerance)
    streams = {"a": entries("a", *anchors), "x": entries("x", *others)}
    matched = reference.matches(aligner.spec, streams)
    says: dict[str, list[Step]] = {stream: [] for stream in streams}
    for stream, messages in streams.items():
        for entry in messages:
            says[stream] += [("advance", stream, entry.stamp - rng.randint(1, 6)), ("push", stream, entry)]
    seen: dict[str, list[int]] = {"a": [], "x": []}
    front = {"a": -100, "x": -100}
    fired: set[int] = set()
    for step in interleave(says, rng):
        tell(aligner, step)
        _, stream, argument = step
        if isinstance(argument, Entry):
            seen[stream].append(argument.stamp)
        front[stream] = max(front[stream], argument.stamp if isinstance(argument, Entry) else int(str(argument)))
        fired |= {f.stamp for f in poll_all(aligner)}
        decided = takewhile(
            lambda t: decided_by_rule(tolerance, t, seen["a"], front["a"], seen["x"], front["x"]), seen["a"]
        )
        assert {t for t in decided if t in matched} <= fired <= set(matched)
