"""How far apart states are recorded follows from what repeating the calls between them takes."""

from __future__ import annotations

import itertools

from dataflow.records.spacing import CPU_SPACING, LARGE, MOST_OFTEN, REPEATING, StateSpacing


def due(spacing: StateSpacing, each: int, nbytes: int, calls: int) -> list[int]:
    """The calls, of `each` ns of CPU time, behind which a state of `nbytes` is recorded."""
    found = []
    for call in range(1, calls + 1):
        if spacing.is_due(call, call * each, call):
            found.append(call)
            spacing.took(nbytes)
    return found


def test_states_by_event_time_come_at_the_same_firings_whatever_they_cost() -> None:
    assert due(StateSpacing(3), 1, 1, 10) == due(StateSpacing(3), CPU_SPACING, LARGE, 10) == [4, 7, 10]


def test_a_large_state_is_recorded_for_each_spacing_of_cpu_time() -> None:
    each = CPU_SPACING // 10 - REPEATING
    found = due(StateSpacing("cpu"), each, LARGE, 50)
    assert [b - a for a, b in itertools.pairwise(found)] == [10, 10, 10, 10]
    assert due(StateSpacing("cpu"), each, 100 * LARGE, 50) == found


def test_a_small_state_is_recorded_more_often_within_a_bound() -> None:
    each = CPU_SPACING // MOST_OFTEN - REPEATING
    for nbytes, apart in ((LARGE // 4, 4), (49, 1), (0, 1)):
        found = due(StateSpacing("cpu"), each, nbytes, 40)
        assert {b - a for a, b in itertools.pairwise(found)} == {apart}


def test_operators_in_front_that_are_repeated_count_with_each_call() -> None:
    calls = CPU_SPACING // REPEATING
    alone, behind = (due(StateSpacing("cpu", repeated), 0, LARGE, 4 * calls) for repeated in (1, 5))
    assert alone[2] - alone[1] == calls
    assert behind[2] - behind[1] == calls // 5
