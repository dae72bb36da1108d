"""Live runner: it never spins, counts what it says, and follows a jump of the clock once."""

from __future__ import annotations

from typing import Any

import pytest
from firing_operators import Collector, Echo, Either, Gathers, Looks, Loop, Pair, Returned, entry, node, run_all
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.execution.driver import Ready
from dataflow.execution.live import LiveRunner
from dataflow.graph.model import Live
from dataflow.sync import FOREVER


def live(made: Any, **fields: Any) -> tuple[LiveRunner, Collector]:
    collector = Collector()
    runner = LiveRunner(made, collector, static=fields.pop("static", frozenset()), event_clock=lambda: 0, **fields)
    runner.setup()
    return runner, collector


def test_a_trigger_before_its_static_message_waits_without_working() -> None:
    made = node(Looks, {"x": ["t/s/x"], "constant": ["t/m/c"], "image": ["t/s/image"]})
    runner, collector = live(made, static=frozenset({"t/m/c"}))

    runner.push("t/s/x", entry("t/s/x", 100, 0))

    assert not runner.step()
    assert runner.next_due() is None  # the process may sleep
    assert runner.timeouts == {"image": 1}
    runner.push("t/m/c", entry("t/m/c", 0, 0))
    assert runner.step()
    assert [r.stamp for r in collector.records if r.kind == "fire"] == [100]


def test_a_static_trigger_of_a_merge_is_waited_for_without_working() -> None:
    made = node(Either, {"a": ["t/s/a"], "b": ["t/m/b"]})
    runner, _ = live(made, static=frozenset({"t/m/b"}))

    runner.push("t/s/a", entry("t/s/a", 100, 0))

    assert not runner.step()
    assert runner.next_due() is None
    assert not runner.timeouts


def test_timeout_is_no_drop_and_late_messages_are_counted() -> None:
    runner, _collector = live(node(Either, {"a": ["t/s/a"], "b": ["t/s/b"]}))

    runner.push("t/s/a", entry("t/s/a", 100, 0))
    run_all(runner)
    runner.push("t/s/b", entry("t/s/b", 90, 0))
    run_all(runner)

    assert runner.timeouts == {"b": 1}
    assert runner.drops == {("b", "late"): 1}
    assert runner.late == {"b": 1}


def test_a_late_message_that_serves_a_later_firing_is_late_and_not_dropped() -> None:
    runner, collector = live(node(Gathers, {"x": ["t/s/x"], "rest": ["t/s/rest"]}))

    runner.push("t/s/x", entry("t/s/x", 100, 0))
    run_all(runner)
    runner.push("t/s/rest", entry("t/s/rest", 90, 0))
    runner.push("t/s/x", entry("t/s/x", 200, 1))
    run_all(runner)

    assert (runner.late, runner.drops) == ({"rest": 1}, {})
    assert [sorted(r.late) for r in collector.records if r.kind == "fire"] == [[], ["rest"]]


def test_counts_go_on_after_a_jump_of_the_clock() -> None:
    runner, _ = live(node(Either, {"a": ["t/s/a"], "b": ["t/s/b"]}))

    def late_message(first: int, incarnation: int) -> None:
        runner.push("t/s/a", entry("t/s/a", first + 50, 0, incarnation))
        run_all(runner)
        runner.push("t/s/b", entry("t/s/b", first + 40, 0, incarnation))
        run_all(runner)

    late_message(1000, 0)
    assert runner.drops == {("b", "late"): 1}
    late_message(100, 1)

    assert runner.drops == {("b", "late"): 2}
    assert runner.late == {"b": 2}


def test_one_jump_of_a_source_with_two_ports_resets_its_consumer_once() -> None:
    runner, collector = live(node(Either, {"a": ["t/s/a"], "b": ["t/s/b"]}))
    for seq, stamp in enumerate((1000, 1010)):
        runner.push("t/s/a", entry("t/s/a", stamp, seq))
        runner.push("t/s/b", entry("t/s/b", stamp, seq))
    run_all(runner)

    runner.push("t/s/a", entry("t/s/a", 500, 0, 1))
    runner.push("t/s/b", entry("t/s/b", 1020, 2))  # still under way when the clock jumped
    runner.push("t/s/b", entry("t/s/b", 500, 0, 1))
    runner.push("t/s/a", entry("t/s/a", 510, 1, 1))
    runner.push("t/s/b", entry("t/s/b", 510, 1, 1))
    run_all(runner)

    assert isinstance(runner.operator, Either)
    assert runner.operator.resets == 1
    assert [r.stamp for r in collector.records if r.kind == "fire"] == [1000, 1010, 500, 510]
    assert runner.drops == {("b", "reset"): 1}


def test_a_second_jump_resets_again() -> None:
    runner, _ = live(node(Either, {"a": ["t/s/a"], "b": ["t/s/b"]}))
    for incarnation in range(3):
        runner.push("t/s/a", entry("t/s/a", 1000 - incarnation, 0, incarnation))
        runner.push("t/s/b", entry("t/s/b", 1000 - incarnation, 0, incarnation))
        run_all(runner)

    assert isinstance(runner.operator, Either)
    assert runner.operator.resets == 2


def test_clock_jump_restarts_ended_streams_without_waiting_for_absent_ones() -> None:
    runner, collector = live(node(Pair, {"a": ["t/s/a"], "b": ["t/s/b"]}, Live("block", 16, {"a": None, "b": None})))
    for stream in ("t/s/a", "t/s/b"):
        runner.push(stream, entry(stream, 1000, 0))
    runner.end("t/s/a", 1000, "")
    run_all(runner)

    runner.push("t/s/a", entry("t/s/a", 500, 0, 1))
    runner.push("t/s/b", entry("t/s/b", 500, 0, 1))
    run_all(runner)

    assert [r.stamp for r in collector.records if r.kind == "fire"] == [1000, 500]


def test_ended_static_stream_is_not_waited_for_after_a_clock_jump() -> None:
    runner, collector = live(node(Either, {"a": ["t/s/a"], "b": ["t/m/b"]}), static=frozenset({"t/m/b"}))
    runner.end("t/m/b", None, "its source has none")
    for stamp, incarnation in ((1000, 0), (500, 1)):
        runner.push("t/s/a", entry("t/s/a", stamp, 0, incarnation))
        run_all(runner)

    assert [r.stamp for r in collector.records if r.kind == "fire"] == [1000, 500]


@pytest.mark.parametrize("queue", ["newest", "block"])
def test_messages_behind_a_frontier_are_refused_and_the_run_continues(queue: Any) -> None:
    inputs = {"x": ["t/s/x"], "rest": ["t/s/rest"]}
    runner, collector = live(node(Gathers, inputs, Live(queue, 16, {"x": 0, "rest": 0})))
    for stream in ("t/s/x", "t/s/rest"):
        runner.push(stream, entry(stream, 100, 0, 1))
        runner.push(stream, entry(stream, 110, 0))  # of an incarnation that is over
        runner.advance(stream, FOREVER)
    runner.push("t/s/x", entry("t/s/x", 120, 1, 1))
    run_all(runner)

    assert runner.refused == {"t/s/x": 2, "t/s/rest": 2}
    assert runner.drops == {("x", "refused"): 1, ("rest", "refused"): 1}
    assert [r.stamp for r in collector.records if r.kind == "fire"] == [100, 120]


def test_an_operator_that_never_fires_keeps_a_bounded_number_of_drops() -> None:
    made = node(Pair, {"a": ["t/s/a"], "b": ["t/s/b"]}, Live("newest", 1, {"a": None, "b": None}))
    runner, _collector = live(made)

    for seq in range(10_000):
        runner.push("t/s/a", entry("t/s/a", seq, seq))
    dropped = runner.drops["a", "overflow"]
    listed, more = runner.take_drops()

    assert dropped == 9_999
    assert len(listed) == 4_096
    assert [d.seq for d in listed[-2:]] == [9_997, 9_998]
    assert more == {("a", "overflow"): 9_999 - 4_096}


def test_record_counts_its_unlisted_drops() -> None:
    runner, collector = live(node(Echo, {"x": ["t/s/x"]}, Live("newest", 1, {"x": 0})))

    for seq in range(5_000):
        runner.push("t/s/x", entry("t/s/x", seq, seq))
    run_all(runner)

    (record,) = [r for r in collector.records if r.kind == "fire"]
    assert len(record.drops) == 4_096
    assert record.detail["unlisted_drops"] == [["x", "overflow", 4_999 - 4_096]]


def looped(**live: Any) -> tuple[LiveRunner, Returned, Ready]:
    made = node(Loop, {"x": ["t/s/x"], "last": ["t/n/y"], "rest": ["t/s/rest"]}, Live(**live))
    collector = Returned()
    runner = LiveRunner(made, collector, static=frozenset(), event_clock=lambda: 0)
    collector.runner, ready = runner, Ready()
    ready.add(runner)
    runner.setup()
    return runner, collector, ready


def fired(collector: Collector) -> list[int]:
    return [r.stamp for r in collector.records if r.kind == "fire"]


def test_self_sampling_operator_fires_once_its_frontier_decides() -> None:
    waits = {"x": None, "last": None, "rest": None}
    runner, collector, ready = looped(queue="newest", size=16, wait=waits)
    runner.advance("t/s/rest", 1_000)
    for seq, stamp in enumerate((100, 200, 300)):
        runner.push("t/s/x", entry("t/s/x", stamp, seq + 1))
        while ready.step():
            pass

        assert fired(collector)[-1:] == [stamp]
    assert collector.numbers == [1.0, 3.0, 6.0]


def test_self_sampling_operator_makes_all_firings_of_its_messages() -> None:
    """Every call decides the next one by what it gives to itself; nothing else arrives."""
    waits = {"x": None, "last": None, "rest": None}
    runner, collector, ready = looped(queue="block", size=16, wait=waits)
    runner.advance("t/s/rest", 1_000)
    for seq, stamp in enumerate(range(100, 600, 100)):
        runner.push("t/s/x", entry("t/s/x", stamp, seq + 1))
    while ready.step():
        pass

    assert fired(collector) == [100, 200, 300, 400, 500]
    assert runner.waiting() == (None, {})


def test_done_rises_with_every_firing() -> None:
    runner, _ = live(node(Echo, {"x": ["t/s/x"]}))
    for seq in range(3):
        runner.push("t/s/x", entry("t/s/x", 100 + seq, seq))

    reached = []
    while runner.step():
        reached.append(runner.done)

    assert reached == [100, 101, 102]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("abr"), st.integers(1, 60), st.booleans()), max_size=40))
def test_every_message_is_taken_or_dropped_or_held_whatever_arrives(arrivals: list[tuple[str, int, bool]]) -> None:
    """Also messages of wrong order and frontiers that break their own promise: nothing raises, nothing is lost."""
    runner, collector = live(node(Either, {"a": ["t/s/a"], "b": ["t/s/b"]}, Live("newest", 2, {"a": 0, "b": None})))
    pushed = 0
    for seq, (port, stamp, step) in enumerate(arrivals):
        if port == "r":
            runner.advance("t/s/a", stamp)
        else:
            pushed += 1
            runner.push(f"t/s/{port}", entry(f"t/s/{port}", stamp, seq))
        if step:
            run_all(runner)
    run_all(runner)
    runner.end("t/s/a", None, "")
    runner.end("t/s/b", None, "")
    run_all(runner)

    taken = sum(ref is not None for r in collector.records for ref in r.inputs.values())
    assert taken + sum(runner.drops.values()) == pushed
    assert sum(len(r.drops) for r in collector.records) == sum(runner.drops.values())
