"""Event time: it runs, also where a device's stamps lie ahead of the clock, or its first message came late."""

from __future__ import annotations

import pytest
from firing_operators import Collector, Either, entry, node, run_all

from dataflow.execution.admission import EventTime
from dataflow.execution.live import LiveRunner
from dataflow.graph.model import Live

MS, S = 10**6, 10**9


class Clock:
    """A clock that is put forward by hand."""

    def __init__(self) -> None:
        self.ns = 100 * S

    def event(self) -> int:
        return self.ns

    def seconds(self) -> float:
        return self.ns * 1e-9


def test_event_time_is_the_clocks_and_not_before_a_stamp_that_was_seen() -> None:
    clock = Clock()
    time = EventTime(clock.event)

    time.see(clock.ns + 500 * MS)

    assert time.now() == 100 * S + 500 * MS
    clock.ns += S
    assert time.now() == 101 * S


def test_time_until_a_stamp_shrinks_by_the_clock_while_event_time_stands() -> None:
    clock = Clock()
    time = EventTime(clock.event)
    time.see(clock.ns + 500 * MS)
    stamp = clock.ns + 500 * MS + 1_000

    assert time.until(clock.ns + 500 * MS) == 0
    assert time.until(stamp) == stamp - clock.ns
    clock.ns += 499 * MS
    assert time.until(stamp) == stamp - clock.ns


@pytest.mark.parametrize("off", [0, -50 * S, 50 * S], ids=["the machine's clock", "one behind", "one ahead"])
def test_a_first_message_that_was_held_up_does_not_put_event_time_back(off: int) -> None:
    clock = Clock()
    time = EventTime(clock.event)

    time.see(clock.ns + off - 2 * S)  # stamped two seconds ago
    time.see(clock.ns + off)

    clock.ns += S
    assert time.now() == clock.ns + off
    assert time.until(clock.ns + off + 5) == 5


def test_wait_after_a_delayed_first_message_is_within_the_timeout() -> None:
    """As after a freeze: what was sent meanwhile arrives at once, and one stream goes on while the other is away."""
    clock = Clock()
    runner = LiveRunner(
        node(Either, {"a": ["t/s/a"], "b": ["t/s/b"]}, Live("block", 16, {"a": 100 * MS, "b": 100 * MS})),
        Collector(),
        static=frozenset(),
        clock=clock.seconds,
        event_clock=clock.event,
    )
    runner.setup()
    for seq, ago in enumerate((2 * S, S, 0)):
        runner.push("t/s/a", entry("t/s/a", clock.ns - ago, seq))
    begun, waits = clock.ns, 0

    while runner.aligner.waiting() is not None or runner.queue.holds:
        run_all(runner)
        if (due := runner.next_due()) is not None:
            waits += 1
            clock.ns += max(1, round(due * 1e9))

    assert waits <= 4
    assert clock.ns - begun <= 3 * 100 * MS
    assert runner.timeouts == {"b": 3}
