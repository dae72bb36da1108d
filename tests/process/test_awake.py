"""A clock that stands still while its process does."""

from __future__ import annotations

from dataflow.process.awake_clock import LONGEST_STEP, AwakeClock


class Hands:
    """A clock that goes on as the test says."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_clock_that_is_read_often_goes_on_as_time_does() -> None:
    hands = Hands()
    clock = AwakeClock(hands)
    for _ in range(100):
        hands.now += 0.05
        clock()

    assert round(clock(), 6) == 105.0
    assert clock.take_lost() == 0.0


def test_time_without_readings_counts_as_one_step() -> None:
    hands = Hands()
    clock = AwakeClock(hands)
    hands.now += 6.0

    assert clock() == 100.0 + LONGEST_STEP
    hands.now += 0.25
    assert clock() == 100.0 + LONGEST_STEP + 0.25
    assert clock.take_lost() == 6.0 - LONGEST_STEP
    assert clock.take_lost() == 0.0
