"""The course of a live run: what fails is restarted by its policy, who is silent is not waited for."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from plays import LEFT, STEP, Play, asked_where, killed, sent, spawned

from dataflow.chaos.plan import Fault
from dataflow.recording.parts import Storage
from dataflow.records.firing import Emission, FiringRecord, encode_batch
from dataflow.supervision.core.closing import SHORTEST
from dataflow.supervision.core.commands import Command, Send, Signal, Spawn
from dataflow.supervision.core.events import (
    ClockMeasured,
    Exited,
    LinkChanged,
    NotReading,
    Paused,
    Received,
    RunStarted,
    Tick,
    TriggerRequested,
)
from dataflow.supervision.core.report import OperatorCounts
from dataflow.supervision.core.watchers.lateness import held_up_by
from dataflow.supervision.core.watchers.leftover_records import HANDED_OVER
from dataflow.sync import FOREVER

AGAIN = "live: {restart: {max: 2, backoff: 100ms}}"
SUM = "sum: {use: runtime_operators:Sum, inputs: {x: left/fast}}"
SMOOTH = f"smooth: {{use: runtime_operators:Smooth, inputs: {{x: left/fast}}, {AGAIN}}}"
AFTER = "after: {use: runtime_operators:Sum, inputs: {x: smooth/mean}}"


def robot(*operators: str, **options: object) -> Play:
    return Play(LEFT, SMOOTH, AFTER, *operators, live=True, **options)


def record(operator: str, index: int, stamp: int) -> FiringRecord:
    return FiringRecord(operator, 0, index, "fire", stamp, outputs=(Emission(index, stamp, bytes(16)),))


def test_dead_process_is_restarted_and_the_others_are_informed() -> None:
    play = robot(record="run.mcap").starts()
    play.keeps(record("smooth", 0, 5), record("smooth", 1, 7))

    play.dies("smooth", -9)
    told = play.tell()
    assert ("after", {"streams": ["test/smooth/mean"], "absent": True}) in sent(told, "absent")
    assert [len(fields["batches"]) for label, fields in sent(told, "records")] == [2]
    assert {fields["life"] for _, fields in sent(told, "gone")} == {1}
    assert play.core.status.restarts == {"smooth": 1}
    told = play.wait(0.3)

    assert spawned(told) == ["smooth"]
    ((_, config),) = sent(told, "operators")
    assert config["resume"]["smooth"] == {
        "incarnation": 1,
        "last": {"mean": 7},
        "changed": {},
        "places": {"mean": (0, 2)},
        "restarts": 1,
    }
    assert config["life"] == 2
    assert [label for label, _ in sent(told, "probe")] == ["smooth"]
    assert [label for label, _ in sent(told, "go")] == ["smooth"]
    assert play.core.status.notes == [
        "process 'smooth' was killed by SIGKILL; started again in 0.1 s",
        "process 'smooth' is back",
    ]
    play.ends()


def test_ended_recorder_continues_when_a_process_restarts() -> None:
    play = robot(record="run.mcap").starts()
    unaware = play.ended("@recorder")
    play.dies("smooth", -9)
    play.tell(play.ended("@recorder"))
    told = play.wait(0.3)
    assert [fields["times"] for _, fields in sent(told, "expect")] == [1]

    play.tell(unaware)  # it had not heard of that yet
    play.tell(*(play.ended(label) for label in play.processes if label != "@recorder"))
    assert not sent(play.wait(1.0), "leave")
    play.tell(play.ended("@recorder"))
    play.wait(1.0)
    assert play.report


def test_restarts_come_to_an_end() -> None:
    play = robot().starts()
    for _ in range(3):
        play.dies("smooth", -9)
        play.wait(1.0)

    assert play.failure() == "process 'smooth' was killed by SIGKILL while running"


def test_a_process_that_is_killed_while_starting_is_restarted_by_its_policy() -> None:
    play = robot()
    play.deaf.add("smooth")
    play.tell(RunStarted())
    play.dies("smooth", -9)

    told = play.wait(1.0)

    assert spawned(told) == ["smooth"]
    ((_, config),) = sent(told, "operators")
    assert "resume" not in config  # nobody had heard of the one before
    assert play.core.status.phase == "running"


def test_one_restarted_while_starting_may_see_a_probe_as_soon_as_it_is_ready() -> None:
    play = robot()
    play.tell(RunStarted())
    play.deaf.add("smooth")
    play.wait(STEP)
    play.dies("smooth", -9)
    while not spawned(play.wait(STEP)):  # the others are probing when its successor is ready
        pass

    play.tell(*(Received("smooth", "seen", {"stream": stream}) for stream in play.processes["smooth"].subscribe))
    play.wait(1.0)

    assert play.core.status.phase == "running"


def test_a_set_up_that_fails_is_tried_again_by_the_policy_until_it_is_used_up() -> None:
    play = robot()
    play.broken.add("smooth")
    play.tell(RunStarted())
    play.wait(5.0)

    assert len(spawned(play.commands)) == 3 + 2
    assert play.failure() == "operator 'smooth' failed in setup(): RuntimeError: no camera"

    play = robot()
    play.broken.add("smooth")
    play.tell(RunStarted())
    play.broken.clear()
    play.wait(1.0)
    assert play.core.status.phase == "running"


def test_a_set_up_that_fails_after_a_restart_is_tried_again_by_the_policy() -> None:
    play = robot().starts()
    play.broken.add("smooth")
    play.dies("smooth", -9)
    play.wait(0.15)
    play.broken.clear()
    play.wait(1.0)

    assert play.core.status.restarts == {"smooth": 2}
    assert play.core.status.notes[-1] == "process 'smooth' is back"


def test_failed_process_is_restarted_and_a_failed_operator_ends_the_run() -> None:
    play = robot().starts()
    failed = {"operator": None, "when": "", "summary": "ProcessFailure: no statics", "where": "", "traceback": "…"}
    play.tell(Received("smooth", "failed", failed))
    play.wait(1.0)
    assert play.core.status.notes[-1] == "process 'smooth' is back"

    play.tell(play.failed("smooth", "fire at stamp 5"))  # its process has tried
    play.wait(1.0)
    assert play.failure() == "operator 'smooth' failed in fire at stamp 5: RuntimeError: no camera"


def test_a_failure_that_is_outlived_keeps_its_line_and_traceback() -> None:
    play = robot(record="run.mcap").starts()
    failed = {"operator": "smooth", "when": "fire at stamp 5", "summary": "ZeroDivisionError: crashed", "pause": 0.5}
    play.tell(Received("smooth", "restarting", {**failed, "where": "crashy.py:12", "traceback": "Traceback …"}))

    ((_, event),) = sent(play.commands, "event")
    text = "operator 'smooth' failed in fire at stamp 5: ZeroDivisionError: crashed (crashy.py:12); made anew in 0.5 s"
    assert play.core.status.notes == [text]
    assert event["data"]["text"] == text
    assert (event["data"]["where"], event["data"]["traceback"]) == ("crashy.py:12", "Traceback …")


def test_failed_setup_keeps_its_line_and_traceback_across_the_restart() -> None:
    play = robot(record="run.mcap").starts()
    play.broken.add("smooth")
    play.dies("smooth", -9)
    play.wait(0.15)
    play.broken.clear()
    play.wait(1.0)

    text = "process 'smooth' has left: operator 'smooth' failed in setup(): RuntimeError: no camera (driver.py:7)"
    events = [fields["data"] for _, fields in sent(play.commands, "event")]
    (told,) = (data for data in events if data["text"].startswith(text))
    assert (told["where"], told["traceback"]) == ("driver.py:7", "…")


def test_one_that_failed_and_does_not_leave_is_killed() -> None:
    play = robot().starts()
    play.deaf.add("smooth")
    play.tell(
        Received("smooth", "failed", {"operator": None, "when": "", "summary": "x", "where": "", "traceback": ""})
    )

    assert killed(play.wait(11.0)) == ["smooth"]
    assert play.core.status.notes[-1] == "process 'smooth' is back"


def test_unresponsive_process_is_killed_and_restarted_by_its_policy() -> None:
    play = robot().starts()
    play.wait(1.0)
    play.deaf.add("smooth")
    assert killed(play.wait(4.0)) == ["smooth"]
    assert "process 'smooth' gave no sign of life for 3.0 s; started again" in play.core.status.notes[0]

    play = robot().starts()
    assert killed(play.tell(NotReading("smooth", 2.0, 9))) == []
    assert killed(play.tell(NotReading("smooth", 3.5, 9))) == ["smooth"]
    assert "process 'smooth' has read nothing for 3.5 s" in play.core.status.notes[0]


def test_overflowed_recorder_without_a_policy_ends_the_run() -> None:
    play = robot(record="run.mcap", storage=Storage(on_failure="end")).starts()
    play.deaf.add("@recorder")
    play.tell(NotReading("@recorder", 9.0, 500, overflowed=True))
    play.wait(20.0)

    assert play.failure() == "process '@recorder' has read nothing for 9 s"


def test_overflowed_recorder_is_replaced() -> None:
    play = robot(record="run.mcap").starts()
    assert killed(play.tell(NotReading("@recorder", 9.0, 500))) == []  # it may wait for its disk
    assert killed(play.tell(NotReading("@recorder", 9.0, 500, overflowed=True))) == ["@recorder"]
    play.wait(3.0)

    assert any("'@recorder' has read nothing for 9.0 s; started again" in note for note in play.core.status.notes)
    assert sum(isinstance(c, Spawn) and c.label == "@recorder" for c in play.commands) == 2


def covered(play: Play, stamp: int) -> tuple[int, int]:
    """What the source is told when it has given everything up to a stamp."""
    play.tell(play.progress("left", {"left": stamp}))
    _, fields = sent(play.commands, "covered")[-1]
    return fields["frontier"], fields["backlog"]


OTHER = "other: {use: runtime_operators:Sum, inputs: {x: left/fast}}"
DROPS = "sum: {use: runtime_operators:Sum, inputs: {x: left/fast}, live: {queue: newest, size: 1}}"


def stopped_for_a_while(consumer: str) -> Play:
    """A run in which the consumer `sum` was stopped at stamp 100, and reports again at 900."""
    play = Play(LEFT, consumer, OTHER, live=True).starts()
    play.wait(0.1)
    play.tell(play.progress("left", {"left": 100}))
    play.tell(play.progress("sum", {"sum": 100}), play.progress("other", {"other": 100}))
    play.deaf.add("sum")
    play.tell(play.progress("other", {"other": 500}))
    assert covered(play, 500)[1] == 100  # its backlog still counts

    play.wait(3.2)
    assert "process 'sum' gave no sign of life for 3.0 s; it is no longer waited for" in play.core.status.notes
    play.tell(play.progress("other", {"other": 900}))
    assert covered(play, 900)[1] == 900

    play.deaf.discard("sum")
    play.tell(play.beat("sum"))
    play.tell(play.progress("sum", {"sum": 300}), play.progress("other", {"other": 1000}))
    assert killed(play.commands) == []
    return play


def test_stopped_consumer_is_not_waited_for_and_starts_a_new_backlog() -> None:
    play = stopped_for_a_while(DROPS)

    assert covered(play, 1100)[1] == 900  # what it owes counts from when it was back


def test_lossless_process_catches_up_before_sources_continue() -> None:
    play = stopped_for_a_while(SUM)

    assert covered(play, 1100)[1] == 300


def test_gap_at_a_consumer_is_counted_as_its_drops() -> None:
    play = Play(LEFT, SUM, live=True).starts()
    gap = {"stream": "test/left/fast", "first": 10, "following": 15}
    play.tell(play.progress("sum", {"sum": 9}), Received("sum", "gap", gap), play.progress("sum", {"sum": 20}))

    assert play.core.status.drops["sum"] == {("x", "missed"): 5}
    assert play.core.status.operators["sum"].dropped == 5


BLOCKS = f"slow: {{use: runtime_operators:Smooth, inputs: {{x: left/fast}}, {AGAIN}}}"
SLOW = BLOCKS.replace("{restart", "{queue: newest, size: 1, restart")
NO_POLICY = SLOW.replace(", restart: {max: 2, backoff: 100ms}", "")


def backlog_while_at_a_call(slow: str, *, seconds: float, done: int) -> tuple[Play, list[Command]]:
    """A source drops, since much waits for `slow`, which has done all up to a stamp and has since been at one call;
    another operator is at stamp 100 of 1000."""
    play = Play(LEFT, slow, OTHER, live=True).starts()
    play.tell(play.progress("left", {"left": 1}))
    play.tell(play.progress("slow", {"slow": done}), play.progress("other", {"other": 100}))
    play.tell(play.progress("left", {"left": 1000}), play.beat("slow", ("slow", done + 1, seconds)))
    return play, play.tell(Received("left", "backlog", {"messages": 50, "bytes": 2_000_000}))


def test_hanging_operator_with_backlog_is_killed_and_restarted() -> None:
    play, told = backlog_while_at_a_call(SLOW, seconds=90.0, done=5)

    assert killed(told) == ["slow"]
    (note,) = [note for note in play.core.status.notes if "hangs" in note]
    assert note == (
        "process 'slow' hangs in 'slow': its firing at stamp 6 has taken 90.0 s, and 50 messages (2.0 MB) wait; "
        "started again in 0.1 s"
    )


def test_hanging_operator_without_a_policy_ends_the_run_with_a_remedy() -> None:
    play, _ = backlog_while_at_a_call(NO_POLICY, seconds=90.0, done=5)

    assert "wait: give it a `deadline` or a restart policy" in play.failure()


@pytest.mark.parametrize(
    ("slow", "seconds", "done"),
    [(SLOW, 1.0, 5), (SLOW, 90.0, 900), (BLOCKS, 90.0, 5)],
    ids=["short", "ahead", "blocks"],
)
def test_short_calls_and_calls_without_backlog_or_drops_are_no_hang(slow: str, seconds: float, done: int) -> None:
    play, told = backlog_while_at_a_call(slow, seconds=seconds, done=done)

    assert killed(told) == []
    assert play.over is None


def test_restarted_source_gets_the_covered_frontier_again() -> None:
    play = Play(f"left: {{use: runtime_operators:Counter, {AGAIN}}}", OTHER, live=True).starts()
    play.tell(play.progress("left", {"left": 100}), play.progress("other", {"other": 100}))
    (before, *_) = [fields for _, fields in sent(play.commands, "covered")[-1:]]

    play.dies("left", -9)
    told = play.wait(1.0)

    assert spawned(told) == ["left"]
    assert [fields for label, fields in sent(told, "covered") if label == "left"][-1:] == [before]


def test_idle_robot_keeps_running() -> None:
    play = robot(stall_timeout=20.0).starts()

    play.wait(300.0)

    assert play.over is None


@pytest.mark.parametrize("label", ["sum", "@recorder"])
def test_a_process_that_gives_no_sign_of_life_for_too_long_ends_the_run(label: str) -> None:
    play = Play(LEFT, SUM, live=True, record="run.mcap", stall_timeout=20.0).starts()
    play.deaf.add(label)
    play.state = {"idle": False}
    for _ in range(60):
        play.tell(play.progress("left", {"left": 5}))
        play.wait(0.5)

    assert play.failure() == f"process {label!r} gave no sign of life for 20 s"
    assert asked_where(play.commands) == [label]


def test_one_that_is_both_at_a_long_call_and_silent_is_asked_once_for_each() -> None:
    play = Play(LEFT, SUM, live=True, stall_timeout=20.0).starts()
    play.beating = False
    play.deaf.add("sum")
    play.tell(play.beat("sum", ("sum", 5, 19.9)))
    for _ in range(60):
        play.tell(play.beat("left"), play.progress("left", {"left": 5}))
        play.wait(0.5)

    assert play.failure() == "process 'sum' gave no sign of life for 20 s"
    assert asked_where(play.commands) == ["sum", "sum"]


def test_a_call_that_does_not_end_while_nothing_else_happens_is_named() -> None:
    play = robot(stall_timeout=20.0).starts()
    play.beating = False
    for k in range(50):
        play.tell(play.beat("left"), play.beat("after"), play.beat("smooth", ("smooth", 5, 0.5 * k)))
        play.wait(0.5)

    assert play.failure() == "no progress for 20 s; still busy: process 'smooth', smooth at stamp 5 for 20 s"
    assert asked_where(play.commands) == ["smooth"]


def test_endless_call_is_named_once_the_sources_have_ended() -> None:
    play = robot(stall_timeout=20.0).starts()
    play.beating = False
    for k in range(60):
        play.tell(play.beat("left"), play.beat("after", ("after", 5, 0.5 * k)), play.beat("smooth"))
        play.tell(play.progress("smooth", {"smooth": k}))
        play.wait(0.5)
    assert play.over is None  # sources may go on without it

    streams = play.plan.graph.nodes["left"].outputs.values()
    play.tell(*(Received("left", "stream_ended", {"stream": s, "reason": "end of source"}) for s in streams))
    play.wait(20.0)

    assert play.failure().startswith("all sources have ended, and a call does not: process 'after', after at stamp 5")


def test_after_a_restart_a_stuck_graph_is_proven_again() -> None:
    play = robot().starts()
    play.dies("smooth", -9)
    play.state = {"sent": 9, "received": 7}
    play.wait(4.0)
    assert play.over is None  # that may still be on its way
    play.wait(4.0)

    assert play.failure() == "the graph is stuck: nothing is on its way and no operator can fire"


def test_a_source_behind_the_clock_is_named_at_once_and_at_the_end() -> None:
    play = Play(LEFT, SUM, live=True, record="run.mcap").starts()
    play.wait(10.0)
    counts = {"left": [100, 100, 0, 9_000_000_000, 5]}
    play.tell(Received("left", "progress", {"done": {}, "counts": counts, "behind": {"left": [2.5, 2.5]}}))
    play.tell(Received("left", "progress", {"done": {}, "counts": counts, "behind": {"left": [3.5, 3.5]}}))

    told = "source 'left' has fallen behind the clock: reading it takes longer than real time"
    assert play.core.status.notes == [told]
    assert play.core.status.behind == {"left": 3.5}
    assert [fields["name"] for _, fields in sent(play.commands, "event")] == ["behind"]
    assert play.ends().notes[-1] == "source 'left' was 3.5 s behind the clock at the end, 3.5 s at most"


def test_busy_process_is_named_as_the_cause_of_a_late_source() -> None:
    play = Play(LEFT, SUM, live=True, placement="one_process").starts()
    (label,) = play.processes
    counts = {"left": [1, 1, 0, 0, 5], "sum": [1, 1, 0, 0, 5]}
    play.tell(Received(label, "progress", {"done": {}, "counts": counts, "behind": {"left": [0.1, 4.0]}}))

    assert play.core.status.notes == ["source 'left' has fallen behind the clock: its process is busy with sum"]


def test_a_source_whose_stamps_jumped_far_ahead_is_named() -> None:
    play = Play(LEFT, SUM, live=True).starts()
    play.tell(Received("left", "early", {"operator": "left", "last": 5, "stamp": 10**18, "seconds": 999_999_999.6}))

    assert play.core.status.notes == [
        "source 'left' waits 31.7 years for the clock, its stamps jump from 5 to 1000000000000000000: "
        "nothing comes until then"
    ]


def test_planned_faults_occur_on_time_and_frozen_processes_thaw() -> None:
    freeze, kill = Fault(0.5, "freeze", "smooth", {"span": 0.3}), Fault(2.0, "kill", "left", {})
    play = robot(faults=iter([freeze, kill, Fault(9.0, "raise", "smooth", {})])).starts()

    given = [(c.label, c.number) for c in play.wait(1.5) if isinstance(c, Signal)]
    assert given == [("smooth", signal.SIGSTOP), ("smooth", signal.SIGCONT)]
    assert killed(play.wait(1.0)) == ["left"]


def test_ctrl_c_while_a_process_is_away_ends_the_run() -> None:
    play = robot().starts()
    play.dies("smooth", -9)
    play.tell()
    play.stops()
    play.wait(1.0)

    assert play.failure() == "interrupted while process 'smooth' was to be started again"


def test_incomplete_draining_is_attributed_to_the_silent_process() -> None:
    play = Play(LEFT, SUM, live=True).starts()
    play.tell(play.progress("sum", {"sum": 9}))
    play.wait(1.0)
    play.deaf.add("left")
    play.wait(5.0)
    play.stops()
    play.wait(80.0)

    assert "not everything was drained within 60 s: process 'left' gives no sign of life; sum was at" in play.failure()


def test_records_of_a_failed_run_reach_the_recorder_when_the_others_have_left() -> None:
    play = robot(record="run.mcap").starts()
    play.keeps(record("after", 0, 5))
    play.dies("left", 1)
    play.tell()
    play.wait(1.0)

    told = [c.kind for c in play.commands if isinstance(c, Send) and c.label == "@recorder"]
    assert [kind for kind in told if kind in ("records", "leave")] == ["records", "leave"]
    assert play.over is not None


def test_lost_records_are_resent_by_their_process_or_from_its_black_box() -> None:
    play, lacks = robot(record="run.mcap").starts(), Received("@recorder", "lacks", {"operator": "smooth"})
    play.keeps(record("smooth", 0, 5))
    assert [(c.label, c.kind) for c in play.tell(lacks) if isinstance(c, Send)] == [("smooth", "lacks")]

    play.dies("smooth", -9)
    play.tell()
    assert [label for label, _ in sent(play.tell(lacks), "records")] == ["@recorder"]


def test_records_that_are_lacking_of_a_process_that_leaves_come_when_it_has_ended() -> None:
    play = robot(record="run.mcap").starts()
    play.keeps(record("smooth", 0, 5))
    play.deaf.add("smooth")
    play.tell(play.ended("left"), play.ended("smooth"), play.ended("after"), play.ended("@recorder"))
    play.wait(0.2)
    assert not sent(play.tell(Received("@recorder", "lacks", {"operator": "smooth"})), "records")
    play.dies("smooth", 0)

    assert [label for label, _ in sent(play.tell(), "records")] == ["@recorder"]


def test_a_process_that_died_again_at_once_does_not_use_an_incarnation_twice() -> None:
    play = robot().starts()
    play.keeps(FiringRecord("smooth", 3, 0, "fire", 5, outputs=(Emission(0, 5, bytes(16)),)))
    play.dies("smooth", -9)

    ((_, config),) = sent(play.wait(0.3), "operators")
    assert config["resume"]["smooth"]["incarnation"] == 4


def test_news_of_processes_that_ended_crosses_other_news_without_harm() -> None:
    play = robot().starts()
    play.tell(Exited("smooth", -9), play.progress("smooth", {"smooth": FOREVER}), play.ended("smooth"), Tick())

    assert play.over is None


def test_run_stopped_with_an_unreachable_machine_waits_briefly_and_names_it() -> None:
    play = Play(LEFT, SUM, live=True).starts()
    play.tell(LinkChanged("robot", ("sum",), up=False))
    play.deaf.add("sum")
    play.stops()
    play.tell(play.ended("left"))
    play.wait(4 * SHORTEST)

    assert f"not everything was drained within {SHORTEST:g} s: machine 'robot' is out of reach" in play.failure()


def test_processes_behind_a_link_that_is_down_are_neither_silent_nor_started_again() -> None:
    restarting = SUM[:-1] + ", live: {restart: {max: 2, backoff: 10ms}}}"
    play = Play(LEFT, restarting, live=True).starts()
    play.tell(LinkChanged("robot", ("sum",), up=False))
    play.beating = False

    for _ in range(200):  # 10 s, in which the others are heard
        play.tell(play.beat("left"))
        play.wait(0.05)
    play.tell(LinkChanged("robot", ("sum",), up=True))
    play.wait(2.0)  # until its first beat has come
    play.tell(play.beat("left"), play.beat("sum"))
    play.wait(0.05)

    assert not any(isinstance(command, Signal) for command in play.commands)
    assert not play.core.status.restarts
    assert [note for note in play.core.status.notes if "link" in note] == [
        "the link to machine 'robot' is down: that machine does not answer, and its operators go on",
        "the link to machine 'robot' is back",
    ]
    play.beating = False
    play.tell(play.beat("left"))
    play.wait(4.0)
    assert any(isinstance(command, Signal) and command.label == "sum" for command in play.commands)


def test_the_clock_of_another_machine_is_stored_now_and_then_and_shown_once() -> None:
    play = Play(LEFT, SUM, live=True, record=Path("run.mcap")).starts()
    for _ in range(21):
        play.tell(ClockMeasured("robot", 2_500_000, 400_000))
        play.wait(1.0)

    stored = [c.fields["data"] for c in play.commands if isinstance(c, Send) and c.fields.get("name") == "clock"]
    text = "the clock of machine 'robot' is +2.500 ms ahead, ± 0.200 ms"
    assert stored == [{"text": text, "machine": "robot", "offset": 2_500_000, "delay": 400_000}] * 3
    assert play.core.status.notes.count(text) == 1


# -- what is counted and told of --------------------------------------------------------------------------------------


def told(firings: int, dropped: int, timeouts: int) -> Received:
    """How far `smooth` is by its own count, which begins anew with its process."""
    counts = {"smooth": [firings, 2 * firings, dropped, 10 * firings, 5, 20 * firings]}
    drops, waits = {"smooth": [["x", "full", dropped]]}, {"smooth": [["x", "timeout", timeouts]]}
    return Received("smooth", "progress", {"done": {}, "counts": counts, "drops": drops, "waits": waits})


def test_counts_of_an_operator_span_its_restarts() -> None:
    play = robot().starts()
    play.tell(told(2, 1, 1), told(5, 4, 2))
    for _ in range(2):
        play.dies("smooth", -9)
        play.wait(1.0)
        play.tell(told(1, 0, 0), told(2, 1, 3))

    status = play.core.status
    assert status.operators["smooth"] == OperatorCounts(9, 18, 6, 90, 5, 180)
    assert status.drops["smooth"] == {("x", "full"): 6}
    assert status.waits["smooth"] == {("x", "timeout"): 8}


def test_operators_recreated_within_their_process_are_counted() -> None:
    play = robot().starts()
    failed = {"when": "fire at stamp 5", "summary": "x", "pause": 0.5, "where": "", "traceback": ""}
    for name in ("smooth", "after", "smooth"):
        play.tell(Received(name, "restarting", {"operator": name, **failed}))
    assert play.core.status.restarts == {"smooth": 2, "after": 1}


def test_health_is_judged_once_a_second_and_recorded() -> None:
    play = robot(record="run.mcap").starts()
    for k in range(1, 71):
        play.tell(told(k, max(0, k - 60), 0), play.progress("left", {"left": k}))
        play.wait(STEP)

    found = [fields for _, fields in sent(play.commands, "diagnostics")]
    assert len(found) == 4
    states = dict(zip(found[-1]["names"], (v["state"] for v in found[-1]["values"]), strict=True))
    assert states == {"left": "running", "smooth": "dropping", "after": "starting"}
    assert [h.operator for h in play.core.status.health] == found[-1]["names"]


@pytest.mark.parametrize(
    ("others", "read", "load", "wall", "expected"),
    [
        (["sum", "mix"], 0.4, 0.9, 0.9, "its process is busy with sum, mix"),
        ([], 0.4, 0.9, 0.9, "its process is busy with sending"),
        (["sum"], 2.0, 0.8, 0.9, "reading it takes longer than real time"),
        ([], 2.0, 0.01, 0.9, "reading it waits, for a device or a file, and computes next to nothing"),
        ([], 2.0, 0.0, 0.0, "reading it waits, for a device or a file, and computes next to nothing"),
        (["sum"], 2.0, 0.4, 0.8, "computes for 50% of the time that it takes, .* with sum, its process's others"),
        ([], 2.0, 0.4, 0.8, "computes for 50% of the time that it takes, .* it shares with other processes"),
    ],
)
def test_cause_of_a_late_source_follows_from_its_times(
    others: list[str], read: float, load: float, wall: float, expected: str
) -> None:
    assert re.search(expected, held_up_by(others, read, 2.0, load, wall))


def test_a_source_that_falls_behind_again_is_named_again() -> None:
    play = Play(LEFT, SUM, live=True).starts()
    for late in (0.9, 1.1, 0.6, 1.2, 0.4, 1.3):
        play.tell(Received("left", "progress", {"done": {}, "counts": {}, "behind": {"left": [late, late]}}))
    assert len(play.core.status.notes) == 2
    assert play.core.status.behind == {"left": 1.3}


def test_a_source_is_late_by_no_standstill_of_the_machine() -> None:
    play = Play(LEFT, SUM, live=True).starts()

    def late(read: float, sent: float) -> list[str]:
        play.tell(Received("left", "progress", {"done": {}, "counts": {}, "behind": {"left": [read, sent]}}))
        return [note for note in play.core.status.notes if "left" in note]

    late(0.0, 0.0)
    play.stood += 5.0
    play.tell(Paused(5.5, uncounted=5.0))
    assert late(0.0, 0.0) == []  # sent before
    assert late(1.0, 5.0) == late(5.2, 5.2) == []
    play.wait(2.0)
    assert late(5.3, 5.3) == late(0.2, 0.2) == []
    assert len(late(0.2, 1.4)) == 1  # it had caught up: that is its own
    assert play.core.status.behind == {"left": 1.4}


# -- rules that a process may break -----------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["restart: {max: 2, backoff: 100ms}, ", ""], ids=["with a policy", "without"])
@pytest.mark.parametrize("rule", ["memory", "deadline"])
def test_an_operator_that_takes_too_much_is_started_again_or_ends_the_run(policy: str, rule: str) -> None:
    limits = f"live: {{{policy}memory: 100MB, deadline: 2s}}"
    play = Play(LEFT, SUM[:-1] + f", {limits}}}", live=True).starts()
    modest = Received("sum", "beat", {"memory": 100_000_000, "work": None})
    assert killed(play.tell(modest)) == []
    broken = {
        "memory": Received("sum", "beat", {"memory": 101_000_000, "work": None}),
        "deadline": Received("sum", "overdue", {"operator": "sum", "stamp": 7, "seconds": 2.25}),
    }[rule]
    what = {
        "memory": "took 101 MB of memory (limit 100 MB)",
        "deadline": "missed the deadline of 'sum': its firing at stamp 7 has taken 2.25 s (deadline 2 s)",
    }[rule]
    play.tell(broken)
    play.wait(1.0)
    if policy:
        assert play.core.status.notes[0] == f"process 'sum' {what}; started again in 0.1 s"
        assert play.core.status.restarts == {"sum": 1}
    else:
        assert play.failure() == f"process 'sum' {what}"


def test_the_strictest_policy_of_a_process_is_that_of_all_its_operators() -> None:
    """One may be restarted twice after 100 ms, the other once after 400 ms."""
    other = AFTER[:-1] + ", live: {restart: {max: 1, backoff: 400ms}}}"
    play = Play(LEFT, SMOOTH, other, live=True, placement={"smooth": "both", "after": "both"}).starts()
    play.dies("both", -9)
    assert spawned(play.wait(0.3)) == []
    assert spawned(play.wait(0.3)) == ["both"]
    assert play.core.status.restarts == {"smooth": 1, "after": 1}
    play.dies("both", -9)
    play.wait(1.0)
    assert play.failure().startswith("process 'both' (operators smooth, after) was killed by SIGKILL")


def test_the_time_before_a_restart_doubles() -> None:
    play = robot().starts()
    for pause in (0.1, 0.2):
        play.dies("smooth", -9)
        play.tell()
        assert play.core.status.notes[-1].endswith(f"started again in {pause} s")
        play.wait(1.0)


def test_restarted_process_gets_the_streams_that_ended_meanwhile() -> None:
    play = robot(record="run.mcap").starts()
    play.dies("smooth", -9)
    play.tell(Received("left", "stream_ended", {"stream": "test/left/fast", "reason": "end of source"}))
    play.tell(Received("left", "stream_ended", {"stream": "test/left/slow", "reason": "end of source"}))
    given = play.wait(0.3)
    over = {"streams": ["test/left/fast"], "reason": "end of source"}
    assert sent(given, "ended_elsewhere") == [("smooth", over)]


def test_process_continues_without_a_stream_that_never_arrives() -> None:
    play = robot(AFTER.replace("after", "other")).starts()
    play.dies("smooth", -9)
    play.deaf.add("after")  # it sees no probe, and lives
    for _ in range(100):
        play.tell(play.beat("after"))
        play.wait(STEP)
    assert not [note for note in play.core.status.notes if "goes on without" in note]
    play.tell(play.beat("after"))
    play.wait(0.5)
    assert play.core.status.notes[-2:] == [
        "process 'smooth' goes on without: test/smooth/mean",
        "process 'smooth' is back",
    ]


def test_one_that_is_not_ready_again_in_time_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    play = robot(start_timeout=3.0).starts()
    play.dies("smooth", -9)
    monkeypatch.setattr(play, "_answer", lambda *_: [])
    assert killed(play.wait(2.9)) == []
    assert killed(play.wait(0.5)) == ["smooth"]
    assert any("was not ready again within 3 s" in note for note in play.core.status.notes)


def test_restarted_process_counts_as_progress() -> None:
    """Another one is at one call meanwhile, which alone would end the run after 20 s."""
    play = robot(stall_timeout=20.0).starts()
    play.beating = False
    for k in range(60):
        if k == 30:
            play.dies("smooth", -9)
        play.tell(play.beat("left"), play.beat("smooth"), play.beat("after", ("after", 5, 0.5 * k)))
        play.wait(0.5)
    assert play.over is None
    for k in range(60, 75):
        play.tell(play.beat("left"), play.beat("smooth"), play.beat("after", ("after", 5, 0.5 * k)))
        play.wait(0.5)
    assert play.failure().startswith("no progress for 20 s; still busy: process 'after', after at stamp 5")


def test_only_the_last_records_of_the_dead_are_handed_over() -> None:
    play = robot(record="run.mcap").starts()
    play.keeps(*(record("smooth", k, k) for k in range(HANDED_OVER + 3)))
    play.dies("smooth", -9)
    ((label, fields),) = sent(play.tell(), "records")
    assert (label, len(fields["batches"])) == ("@recorder", HANDED_OVER)
    assert fields["batches"][-1] == encode_batch([record("smooth", HANDED_OVER + 2, HANDED_OVER + 2)])


def test_trigger_forwarded_by_several_processes_fires_once() -> None:
    play = robot(record="run.mcap").starts()
    for label, number in (("left", "a"), ("smooth", "a"), ("smooth", "b"), ("after", "a")):
        play.tell(Received(label, "trigger", {"id": number, "text": f"bump {number}"}))
    play.tell(TriggerRequested("button"))
    given = [fields["data"]["text"] for _, fields in sent(play.commands, "event") if fields["name"] == "trigger"]
    assert given == ["bump a", "bump b", "button"]
