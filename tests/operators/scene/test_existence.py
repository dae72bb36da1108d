"""Real entries of a map and false ones, told apart by how steadily a detector repeats itself."""

from __future__ import annotations

import numpy as np
import pytest

from operators.scene.existence import LOOK, Answers, log_odds

CUP, SINK = 0, 1


def answers(*, seen: int, missed: int, score: float, other: int = 0) -> Answers:
    """Returns an entry's answers, in independent looks."""
    made = Answers()
    for _ in range(seen):
        made.add(CUP, score, LOOK)
    for _ in range(other):
        made.add(SINK, score, LOOK)
    for _ in range(missed):
        made.miss(LOOK)
    return made


def test_what_most_plain_views_detect_is_real_and_what_most_miss_is_not() -> None:
    odds = log_odds({1: (CUP, answers(seen=9, missed=1, score=0.5)), 2: (CUP, answers(seen=2, missed=8, score=0.5))})
    assert odds[1] > 1
    assert odds[2] < -1


def test_one_that_is_called_otherwise_in_most_views_is_doubted() -> None:
    entries = {k: (CUP, answers(seen=8, missed=1, score=0.6)) for k in range(4)}
    entries[9] = CUP, answers(seen=4, missed=0, other=12, score=0.6)
    odds = log_odds(entries)
    assert odds[9] < min(odds[k] for k in range(4))


def test_worth_of_scores_is_learned_from_the_detector_itself() -> None:
    """Of two detectors one repeats itself where its scores are high, the other where they are low."""

    def world(steady: float, fickle: float) -> dict[int, tuple[int, Answers]]:
        real = {k: (CUP, answers(seen=20, missed=2, score=steady)) for k in range(8)}
        return real | {10 + k: (CUP, answers(seen=5, missed=15, score=fickle)) for k in range(20)}

    fresh = {score: answers(seen=2, missed=0, score=score) for score in (0.35, 0.75)}
    usual = log_odds(world(0.75, 0.35) | {100: (CUP, fresh[0.75]), 101: (CUP, fresh[0.35])})
    odd = log_odds(world(0.35, 0.75) | {100: (CUP, fresh[0.75]), 101: (CUP, fresh[0.35])})
    assert usual[100] > usual[101] + 1
    assert odd[100] < odd[101]


def test_views_in_quick_succession_tell_as_much_as_the_time_they_take() -> None:
    quick, slow = Answers(), Answers()
    for _ in range(30):
        quick.add(CUP, 0.5, 1 / 30)
    for _ in range(10):
        slow.add(CUP, 0.5, 0.1)
    assert quick.counts(CUP, (9, 12)).sum() == pytest.approx(slow.counts(CUP, (9, 12)).sum())


def test_answers_of_two_entries_of_one_thing_are_added_and_restored() -> None:
    one, other = answers(seen=3, missed=5, score=0.5), answers(seen=5, missed=3, score=0.7)
    one.take(other)
    np.testing.assert_allclose(one.counts(CUP, (10, 12)), [3, 0, 0, 3, 5])  # each was missed while the other was seen
    again = Answers.restored(one.snapshot())
    np.testing.assert_array_equal(again.counts(CUP, (10, 12)), one.counts(CUP, (10, 12)))


def test_no_entries_have_no_odds() -> None:
    assert log_odds({}) == {}
