"""The restart policy: how often, and after what pause."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dataflow.execution.restarts import LONGEST_BACKOFF, MOST_DOUBLINGS, Restarts
from dataflow.graph.model import Restart


class Clock:
    """Time as a test sets it, in seconds."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def policy(most: int, backoff: float = 0.1) -> tuple[Restarts, Clock]:
    clock = Clock()
    return Restarts(Restart(most, round(backoff * 1e9)), clock), clock


@given(st.integers(0, 20))
def test_number_of_attempts_is_that_of_the_policy(most: int) -> None:
    restarts, clock = policy(most)

    outlived = 0
    while restarts.failed():
        outlived += 1
        assert restarts.pending
        clock.now += restarts.due_in()
        restarts.begun()
    assert not restarts.pending
    assert outlived == most == restarts.total


def test_the_pause_doubles_and_is_bounded() -> None:
    restarts, _ = policy(100, backoff=0.1)

    pauses = [restarts.failed() and round(restarts.due_in(), 6) for _ in range(8)]

    longest = 0.1 * 2**MOST_DOUBLINGS
    assert pauses == [0.1, 0.2, 0.4, 0.8, longest, longest, longest, longest]
    slow, _ = policy(100, backoff=20.0)
    assert [slow.failed() and slow.due_in() for _ in range(3)] == [20.0, LONGEST_BACKOFF, LONGEST_BACKOFF]


def test_the_pause_ends_with_time() -> None:
    restarts, clock = policy(3, backoff=0.5)
    restarts.failed()

    clock.now += 0.3
    assert round(restarts.due_in(), 6) == 0.2
    clock.now += 1.0
    assert restarts.due_in() == 0.0


def test_a_long_time_without_failure_is_a_new_beginning() -> None:
    restarts, clock = policy(2, backoff=0.1)
    assert restarts.failed()
    clock.now += 1.0
    assert restarts.failed()

    clock.now += restarts.forgive_after + 1.0
    assert restarts.failed()
    assert round(restarts.due_in(), 6) == 0.1
    assert restarts.failed()
    assert not restarts.failed()
    assert restarts.total == 4
