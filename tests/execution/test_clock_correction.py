"""Stamps of another machine's clock become stamps of the supervisor's, and keep their order."""

from __future__ import annotations

from dataflow.execution.clock_correction import ClockCorrection

SECOND = 1_000_000_000


def test_stamps_are_shifted_once_the_clock_offset_is_measured() -> None:
    clock = ClockCorrection()
    assert clock.shift(5 * SECOND) == 0

    clock.measured(3 * SECOND, delay=0)

    assert clock.shift(6 * SECOND) == -3 * SECOND


def test_a_new_offset_is_approached_so_slowly_that_stamps_keep_their_order() -> None:
    clock = ClockCorrection()
    clock.measured(0, delay=0)
    clock.shift(0)
    clock.measured(50_000_000, delay=0)

    shifts = [clock.shift(k * SECOND) for k in range(1, 60)]

    assert shifts[:3] == [-1_000_000, -2_000_000, -3_000_000]
    assert shifts[-1] == -50_000_000
    clock.measured(0, delay=0)
    assert clock.shift(59 * SECOND) == -50_000_000  # no time has passed


def test_the_offset_of_a_clock_that_was_set_holds_at_once() -> None:
    clock = ClockCorrection()
    clock.measured(0, delay=0)
    clock.shift(0)

    clock.measured(-3600 * SECOND, delay=0)

    assert clock.shift(SECOND) == 3600 * SECOND


def test_an_offset_that_the_delay_of_the_link_explains_is_no_clock_that_was_set() -> None:
    clock = ClockCorrection()
    clock.measured(0, delay=300_000_000)  # of a queue in one direction: 150 ms wrong
    assert clock.shift(0) == 0

    clock.measured(150_000_000, delay=2_000_000)

    assert clock.shift(SECOND) == -1_000_000
    clock.measured(401_000_000, delay=2_000_000)
    assert clock.shift(SECOND) == -401_000_000
