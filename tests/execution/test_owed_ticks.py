"""Timers that owe an absurd number of ticks, since a stamp lies far ahead: refused, or left out and counted."""

from __future__ import annotations

import pytest
from firing_operators import Collector, Strict, Timer, entry, node, run_all

from dataflow.execution.failure import OperatorFailure
from dataflow.execution.live import LiveRunner
from dataflow.execution.runner import MOST_DROPPED, OperatorRunner
from dataflow.graph.model import Live
from dataflow.sync import TICK

MS = 10**6
BOOT, TODAY = 1_000 * MS, 1_790_000_000_000 * MS


def test_a_stamp_far_ahead_is_refused_in_words() -> None:
    runner = OperatorRunner(node(Timer, {"x": ["t/s/x"]}), Collector(), static=frozenset())
    runner.setup()
    runner.push("t/s/x", entry("t/s/x", BOOT, 0))
    run_all(runner)
    runner.push("t/s/x", entry("t/s/x", TODAY, 1))

    with pytest.raises(
        OperatorFailure, match=r"'n' failed in its timer.*137,692,307,\d\d\d ticks, one every 13ms"
    ) as e:
        runner.step()

    assert "from 1.001" in str(e.value)
    assert "2026-09-21" in str(e.value)


@pytest.mark.parametrize("queue", ["newest", "block"])
def test_a_live_run_leaves_ticks_out_and_counts_them(queue: str) -> None:
    made = node(Timer, {"x": ["t/s/x"]}, Live(queue, 4, {"x": 0}))
    collector = Collector()
    runner = LiveRunner(made, collector, static=frozenset(), event_clock=lambda: BOOT)
    runner.setup()
    runner.push("t/s/x", entry("t/s/x", BOOT, 0))
    run_all(runner)
    runner.push("t/s/x", entry("t/s/x", TODAY, 1))
    run_all(runner)
    runner.end("t/s/x", TODAY, "")
    run_all(runner)

    ticks = [r.stamp for r in collector.records if r.kind == "tick"]
    between = TODAY // (13 * MS) - (BOOT - 1) // (13 * MS)
    assert len(ticks) <= 6
    assert len(ticks) + runner.drops[TICK, "overflow"] == between
    assert collector.kinds()[-1] == "finish"


def test_many_ticks_that_are_dropped_do_not_keep_the_process_from_its_other_work() -> None:
    runner = OperatorRunner(node(Strict, {"x": ["t/s/x"]}), Collector(), static=frozenset())
    runner.setup()
    runner.push("t/s/x", entry("t/s/x", 0, 0))
    runner.push("t/s/x", entry("t/s/x", 13 * MS * 50_000, 1))

    steps, most, before = 0, 0, 0
    while runner.step():
        steps += 1
        dropped = sum(runner.drops.values())
        most, before = max(most, dropped - before), dropped

    assert sum(runner.drops.values()) > 49_000
    assert most <= MOST_DROPPED


def test_a_timer_that_cannot_keep_up_does_not_keep_the_process_from_its_other_work() -> None:
    asked = 0

    def clock() -> int:  # a tick and a half go by whenever somebody looks
        nonlocal asked
        asked += 1
        assert asked < 100_000, "one step went on without end"
        return BOOT + asked * 20 * MS

    runner = LiveRunner(
        node(Timer, {"x": ["t/s/x"]}, Live("newest", 1, {"x": 0})), Collector(), static=frozenset(), event_clock=clock
    )
    runner.setup()
    runner.push("t/s/x", entry("t/s/x", BOOT, 0))
    for _ in range(5):
        assert runner.step()

    runner.end("t/s/x", BOOT, "")
    run_all(runner)

    assert runner.ended
