"""Re-execution of runs that were made here: identical as long as nothing changed, and the right one is blamed."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from firing_operators import Collector, Dice, Echo, entry, node, run_all
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.editing.spans import folded
from dataflow.execution import runner as runner_module
from dataflow.execution.calls import Calls
from dataflow.execution.live import LiveRunner
from dataflow.execution.recorded import RecordedRunner
from dataflow.execution.runner import OperatorRunner
from dataflow.graph.model import Live, Node, Restart
from dataflow.records.firing import FiringRecord
from dataflow.records.repetition import Repetition, look_at
from dataflow.records.spacing import StateSpacing
from dataflow.sync import Entry, Firing

STREAM = "t/s/x"
MESSAGES = [entry(STREAM, 100, 0), entry(STREAM, 200, 1), entry(STREAM, 50, 0, 1), entry(STREAM, 60, 1, 1)]


def dice(shared: bool = False, **fields: Any) -> Node:
    return node(Dice, {"x": [STREAM]}, Live("block", 16, {"x": 0}, **fields), params={"shared": shared})


def live_run(made: Node, messages: Iterable[Entry], version: int, gains: Iterable[float] = (2.0,)) -> Collector:
    """A live run with a jump of the clock, parameters that change, and snapshots, whose generators are seeded by
    `version`."""
    collector = Collector()
    runner = LiveRunner(made, collector, static=frozenset(), event_clock=lambda: 10**6, snapshots=StateSpacing(1))
    runner.calls.version = version
    runner.setup()
    left = iter(gains)
    for message in messages:
        runner.push(STREAM, message)
        run_all(runner)
        if (gain := next(left, None)) is not None:
            runner.set_parameter("gain", gain)
    runner.end(STREAM, None, "")
    run_all(runner)
    return collector


def repeated_by(made: Node, records: Sequence[FiringRecord], begin: int | None = None) -> Repetition:
    repetition = Repetition(lambda: records, begin=begin, stateless=made.operator.stateless)
    look_at([repetition])
    return repetition


def again(
    made: Node, ran: Collector, messages: Iterable[Entry], begin: int | None = None, **fields: Any
) -> RecordedRunner:
    messages = list(messages)
    inputs = {STREAM: {(m.incarnation, m.seq): m.digest for m in messages}}
    repetition = repeated_by(made, ran.records, begin)
    runner = RecordedRunner(
        made, Collector(), **{"static": frozenset(), "repetition": repetition, "inputs": inputs, **fields}
    )
    runner.setup()
    for message in messages:
        runner.push(STREAM, message)
        run_all(runner)
    runner.end(STREAM, None, "")
    run_all(runner)
    return runner


def test_an_operator_that_draws_wherever_it_is_called_is_identical() -> None:
    ran = live_run(dice(shared=True), MESSAGES, version=2)

    runner = again(dice(shared=True), ran, MESSAGES)

    assert {"reset", "param", "snapshot", "finish"} <= set(ran.kinds())
    assert runner.result.first is None
    assert runner.result.verdict == "identical"
    assert runner.emitter.numbers == ran.numbers


def test_a_recording_of_the_first_seeding_is_identical_by_that_and_not_by_another() -> None:
    """There `on_reset`, `on_parameter` and `snapshot` go on with what the firing before has left."""
    ran = live_run(dice(), MESSAGES, version=1)

    assert again(dice(), ran, MESSAGES, seeding=1).result.verdict == "identical"
    assert again(dice(), ran, MESSAGES, seeding=2).result.verdict == "culprit"


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.integers(1, 50), min_size=1, max_size=6),
    st.lists(st.floats(0, 4, allow_nan=False), max_size=3),
    st.sampled_from([1, 2]),
)
def test_any_run_with_jumps_and_changes_is_identical(stamps: list[int], gains: list[float], version: int) -> None:
    messages: list[Entry] = []
    incarnation, seq, last = 0, 0, 0
    for stamp in stamps:
        if stamp <= last:
            incarnation, seq = incarnation + 1, 0
        messages.append(entry(STREAM, stamp, seq, incarnation))
        seq, last = seq + 1, stamp
    ran = live_run(dice(shared=version == 2), messages, version, gains)

    runner = again(dice(shared=version == 2), ran, messages, seeding=version)

    assert runner.result.first is None
    assert runner.result.verdict == "identical"


class Fails(RuntimeError):
    """A failure on purpose."""


def restarted_run(made: Node, messages: Iterable[Entry], changes: int) -> Collector:
    """A live run whose second firing fails; behind as many of the first messages the gain becomes 3."""
    collector = Collector()
    errors = iter([None, Fails("once"), None])
    faults: Any = SimpleNamespace(before=lambda firing: next(errors, None))
    runner = LiveRunner(
        made, collector, static=frozenset(), event_clock=lambda: 10**6, faults=faults, snapshots=StateSpacing(1)
    )
    runner.setup()
    for number, message in enumerate(messages):
        runner.push(STREAM, message)
        run_all(runner)
        if number < changes:
            runner.set_parameter("gain", 3.0)
            run_all(runner)
    runner.end(STREAM, None, "")
    run_all(runner)
    assert [r.detail.get("injected") for r in collector.records if r.outcome == "error"] == [True]
    assert runner.restarted == 1
    return collector


def test_an_operator_that_was_restarted_with_changed_parameters_is_identical(monkeypatch: pytest.MonkeyPatch) -> None:
    made = dice(shared=True, restart=Restart(max=1, backoff=0))
    messages = [entry(STREAM, 100 * seq, seq) for seq in range(1, 4)]
    ran = restarted_run(made, messages, changes=3)
    closed: list[Dice] = []
    monkeypatch.setattr(Dice, "close", lambda self: closed.append(self))

    runner = again(made, ran, messages)

    assert runner.result.verdict == "identical"
    assert closed
    assert runner.operator not in closed


def test_a_part_that_begins_behind_a_restart_begins_with_the_parameters_of_that() -> None:
    made = dice(restart=Restart(max=1, backoff=0))
    messages = [entry(STREAM, 100 * seq, seq) for seq in range(1, 5)]
    ran = restarted_run(made, messages, changes=1)
    begin = max(k for k, record in enumerate(ran.records) if record.kind == "setup")
    while ran.records[begin].kind != "snapshot":
        begin += 1
    part = Collector()
    part.records = [*folded(ran.records[: begin + 1]), *ran.records[begin + 1 :]]

    result = again(made, part, messages).result

    assert [record.kind for record in part.records[:3]] == ["setup", "cut", "fire"]
    assert (result.verdict, result.verified) == ("identical", 2)  # the last firing, and the end


def test_runs_live_runs_and_re_executions_draw_alike() -> None:
    messages = MESSAGES[:2]
    collector = Collector()
    runner = OperatorRunner(dice(shared=True), collector, static=frozenset(), snapshots=StateSpacing(1))
    runner.setup()
    for message in messages:
        runner.push(STREAM, message)
    runner.end(STREAM, None, "")
    run_all(runner)

    lived = live_run(dice(shared=True), messages, version=2, gains=())

    assert collector.numbers == lived.numbers
    assert [r.detail for r in collector.records] == [r.detail for r in lived.records]


def test_generators_are_as_they_were_for_setup_and_firings() -> None:
    """Values that recordings hold; they must not change for any version."""
    for version in (1, 2):
        made = dice()
        calls = Calls(made, made.make(), 7, version=version)
        calls.setup()
        assert (calls.operator.total, random.random()) == (0.33391226253429185, 0.3500716924112217)
        calls.operator.total = 0.0
        calls.process(Firing(100, "fire", inputs={"x": MESSAGES[0]}))
        assert (calls.operator.total, random.random()) == (0.32187845154943107, 0.9575942977611154)


def test_difference_after_an_input_without_digest_is_not_attributed_to_the_operator() -> None:
    """A producer whose log is torn: nobody knows whether this message is the recorded one."""
    made = node(Echo, {"x": [STREAM]}, Live("block", 16, {"x": 0}))
    messages = [entry(STREAM, 100, 0), entry(STREAM, 200, 1)]
    ran = live_run_echo(made, messages)
    changed = [messages[0], replace(entry(STREAM, 200, 2), seq=1)]
    known = {(0, 0): messages[0].digest}

    result = again(made, ran, changed, inputs={STREAM: known}).result

    assert (result.tainted, result.verdict) == (2, "downstream")


def live_run_echo(made: Node, messages: Iterable[Entry]) -> Collector:
    collector = Collector()
    runner = OperatorRunner(made, collector, static=frozenset())
    runner.setup()
    for message in messages:
        runner.push(STREAM, message)
    runner.end(STREAM, None, "")
    run_all(runner)
    return collector


def test_done_rises_with_every_firing_that_is_repeated() -> None:
    made = node(Echo, {"x": [STREAM]}, Live("block", 16, {"x": 0}))
    messages = [entry(STREAM, 100 + seq, seq) for seq in range(3)]
    ran = live_run_echo(made, messages)
    repetition = repeated_by(made, ran.records)
    runner = RecordedRunner(made, Collector(), static=frozenset(), repetition=repetition, inputs={})
    runner.setup()
    for message in messages:
        runner.push(STREAM, message)

    reached = []
    for _ in messages:
        assert runner.step()
        reached.append(runner.done)

    assert reached == [100, 101, 102]


def test_a_snapshot_that_is_too_large_to_be_recorded_is_left_out_and_counted(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = dice()
    with monkeypatch.context() as patched:
        patched.setattr(runner_module, "MAX_STATE_BYTES", 10)
        ran = live_run(made, MESSAGES[:2], version=2, gains=())

    snapshots = [r.detail for r in ran.records if r.kind == "snapshot"]
    assert snapshots
    assert all(detail.keys() == {"left_out"} and detail["left_out"] > 10 for detail in snapshots)
    assert f"at most 10 are recorded; {len(snapshots)} so far" in caplog.text
    repeated = again(made, ran, MESSAGES[:2])
    assert repeated.result.verdict == "identical"
    assert again(made, ran, MESSAGES[:2], begin=150).result.began == "start"


def test_a_parameter_that_is_set_after_the_end_has_the_stamp_of_the_end() -> None:
    made, collector = dice(), Collector()
    runner = LiveRunner(made, collector, static=frozenset(), event_clock=lambda: 10**6)
    runner.setup()
    runner.push(STREAM, MESSAGES[0])
    run_all(runner)
    runner.end(STREAM, None, "")
    run_all(runner)
    runner.set_parameter("gain", 3.0)

    finish, last = collector.records[-2:]
    assert (finish.kind, last.kind, last.stamp) == ("finish", "param", finish.stamp)
    assert again(made, collector, MESSAGES[:1]).result.verdict == "identical"
