"""The course of a run without loss: from the barrier to the last process's end."""

from __future__ import annotations

import re

import pytest
from plays import LEFT, SUM, Play, asked_where, killed, sent, spawned

from dataflow.supervision.core.commands import Announce, RunEnded, Withdraw
from dataflow.supervision.core.events import (
    Aborted,
    Disconnected,
    Exited,
    LinkChanged,
    OrphansKilled,
    Paused,
    PlaybackRequested,
    Printed,
    Received,
    RunStarted,
    Tick,
)
from dataflow.supervision.core.life import how_it_ended
from dataflow.supervision.core.report import OperatorCounts
from dataflow.supervision.core.watchers.lateness import how_long
from dataflow.supervision.core.watchers.quiescence import MAX_WINDOW_DOUBLINGS, Proof
from dataflow.sync import FOREVER


def test_sources_are_released_when_every_edge_is_proven_and_not_before() -> None:
    play = Play()
    play.deaf.add("sum")

    assert spawned(play.tell(RunStarted())) == ["left", "sum"]
    play.tell(Received("sum", "joined", {}))
    assert sent(play.wait(1.0), "probe") == []
    asked = play.tell(Received("sum", "ready", {"first": 7, "steps": 3}), Tick())
    assert [label for label, _ in sent(asked, "probe")] == ["left", "sum"]
    assert sent(play.wait(1.0), "go") == []

    released = play.tell(Received("sum", "seen", {"stream": "test/left/fast"}), Tick())

    assert Announce(("left", "sum")) in released
    assert [(label, fields["first"]) for label, fields in sent(released, "go")] == [("left", 7), ("sum", 7)]
    assert play.core.status.phase == "running"


def test_a_time_in_which_the_supervisor_did_not_run_is_noted_and_recorded() -> None:
    play = Play(record="run.mcap").starts()

    (told,) = sent(play.tell(Paused(6.0)), "event")

    assert play.core.status.notes == ["the supervisor did not run for 6.0 s, which count against no process"]
    assert told[0] == "@recorder"
    assert told[1]["name"] == "paused"


def test_an_edge_that_is_not_proven_is_named_when_the_time_is_up() -> None:
    play = Play(start_timeout=10.0)
    play.deaf.add("sum")
    play.tell(RunStarted(), Received("sum", "joined", {}), Received("sum", "ready", {"first": None, "steps": None}))
    play.wait(25.0)

    assert play.failure() == "no connection within 10 s on: test/left/fast → sum"


def test_a_machine_that_goes_during_the_start_is_waited_for_shortly_and_named() -> None:
    play = Play(start_timeout=1000.0)
    play.deaf.add("sum")
    play.tell(RunStarted(), Received("sum", "joined", {}), LinkChanged("arm", ("sum",), up=False))
    play.wait(5.0)
    play.tell(LinkChanged("arm", ("sum",), up=True))
    play.wait(60.0)
    assert play.core.status.phase == "starting"

    play.tell(LinkChanged("arm", ("sum",), up=False))
    play.wait(35.0)

    assert "machine 'arm' was not heard for 30 s while its operators were to start" in play.failure()


def test_a_process_that_is_not_ready_is_named_when_the_time_is_up() -> None:
    play = Play(start_timeout=10.0)
    play.deaf.add("sum")
    play.tell(RunStarted(), Received("sum", "joined", {}))
    play.wait(25.0)

    assert play.failure() == "not ready within 10 s: process 'sum'"
    assert asked_where(play.commands) == ["sum"]
    assert killed(play.commands) == ["sum"]


def test_a_run_starts_and_ends_without_waiting_for_a_tick() -> None:
    play = Play(record="run.mcap")

    play.tell(RunStarted())
    assert play.core.status.phase == "running"
    play.tell(*(play.ended(label) for label in play.processes))

    assert play.report


def test_recorder_leaves_last() -> None:
    play = Play(record="run.mcap").starts()

    given = play.tell(*(play.ended(label) for label in play.processes))

    assert [label for label, _ in sent(given, "leave")] == ["left", "sum", "@recorder"]
    assert dict(sent(play.commands, "leave"))["@recorder"]["outcome"] == "complete"
    assert Withdraw() in play.commands
    assert play.report


def test_a_recording_is_not_complete_when_a_close_fails_before_it() -> None:
    play = Play(record="run.mcap").starts()
    play.deaf.add("sum")
    play.tell(*(play.ended(label) for label in play.processes))
    play.wait(0.2)

    play.tell(play.failed("sum", "close()"), Received("sum", "closed", {"facts": {}}), Exited("sum", 1))
    play.wait(1.0)

    assert play.failure() == "operator 'sum' failed in close(): RuntimeError: no camera"
    outcome = dict(sent(play.commands, "leave"))["@recorder"]["outcome"]
    assert outcome == "failed: operator 'sum' failed in close(): RuntimeError: no camera"


def test_covered_goes_to_source_processes_only_and_replaces_the_queued_one() -> None:
    play = Play().starts()

    told = play.tell(play.progress("sum", {"sum": 5}), play.progress("sum", {"sum": 6}))

    covered = [c for c in told if getattr(c, "kind", "") == "covered"]
    assert [(c.label, c.fields["frontier"], c.replaces) for c in covered] == [("left", 5, True), ("left", 6, True)]
    told = play.tell(play.ended("sum"))
    assert sent(told, "covered") == [("left", {"frontier": FOREVER})]


def test_the_first_death_ends_the_run_with_how_far_it_was_and_its_last_words() -> None:
    play = Play().starts()
    play.tell(play.progress("sum", {"sum": 5}), Printed("sum", "a segment is at fault"))

    play.dies("sum", -11)
    play.wait(1.0)

    assert play.failure() == "process 'sum' was killed by SIGSEGV while running (sum had reached stamp 5)"
    assert play.failed_by.details == "a segment is at fault"
    assert dict(sent(play.commands, "leave"))["left"]["outcome"].startswith("failed: process 'sum' was killed")


def test_consequent_failure_is_noted_and_the_first_cause_stays() -> None:
    play = Play().starts()
    play.deaf.add("left")
    play.tell(play.failed("sum", "fire at stamp 5"))
    play.tell(play.failed("left", "close()"))
    play.dies("left", 1)
    play.wait(1.0)

    assert play.failure() == "operator 'sum' failed in fire at stamp 5: RuntimeError: no camera"
    notes = play.core.status.notes
    assert notes[0] == "then: operator 'left' failed in close(): RuntimeError: no camera"


def test_a_process_that_closes_its_channel_and_does_not_end_is_killed() -> None:
    play = Play().starts()
    play.tell(Disconnected("sum"))
    assert killed(play.wait(9.0)) == []

    assert killed(play.wait(3.0)) == ["sum"]
    assert "closed its channel and did not end" in play.failure()


def test_stall_kills_and_names_processes_without_answer() -> None:
    play = Play(stall_timeout=20.0).starts()
    play.deaf.add("sum")
    play.tell(Received("sum", "beat", {"memory": 1, "work": None}))

    play.wait(60.0)

    assert play.failure() == "no progress for 20 s; still busy: process 'left'; process 'sum'"
    assert asked_where(play.commands) == ["left", "sum"]
    assert "sum" in killed(play.commands)


def test_stuck_graph_is_proven_and_waiting_operators_are_named() -> None:
    play = Play().starts()

    play.state = {"waiting": {"sum": [7, {"x": 5}]}}
    play.wait(2.0)

    assert play.failure() == "the graph is stuck: nothing is on its way and no operator can fire"
    assert play.failed_by.details == "  sum waits at stamp 7 for x (≥ 5)"


def test_a_full_window_is_doubled_when_nothing_else_helps() -> None:
    play = Play(window=(8, 1 << 20)).starts()

    play.state = {"full": True}
    play.wait(0.6)

    assert {label for label, _ in sent(play.commands, "grow")} == {"left", "sum"}
    assert play.core.status.notes == ["the graph looks further ahead than the window: doubled to 16 messages"]


def test_messages_in_flight_prevent_the_proof_of_completion() -> None:
    play = Play().starts()

    for k in range(100):
        play.state = {"sent": 5 + k, "received": 4 + k}
        play.wait(0.05)
    play.state = {"idle": False}
    play.wait(5.0)
    play.state = {"sent": 5, "received": 4}
    play.wait(5.0)

    assert play.over is None


def test_a_rate_at_which_nothing_is_ever_due_is_named() -> None:
    play = Play(rate=1e-300, stall_timeout=3.0).starts()
    play.state = {"idle": False, "due": 1e298}
    play.wait(5.0)

    assert "no progress for 3 s" in play.failure()
    assert "the next message of process 'sum' is due in 3.17e+290 years at rate 1e-300" in play.failure()


def test_ctrl_c_drains_and_a_second_one_does_not_wait() -> None:
    play = Play().starts()
    assert {label for label, _ in sent(play.stops(), "stop")} == {"left", "sum"}
    assert play.ends().interrupted

    play = Play().starts()
    play.stops()
    play.deaf |= {"left", "sum"}
    play.stops()
    play.wait(2.0)
    assert play.failure() == "stopped before everything was drained"
    assert play.failed_by.interrupted


def test_ctrl_c_while_starting_is_an_orderly_end_of_a_run_that_did_nothing() -> None:
    play = Play(record="run.mcap")
    play.deaf.add("sum")  # it is being set up
    play.tell(RunStarted(), Received("sum", "joined", {}))
    play.stops()
    play.deaf.discard("sum")
    play.tell(Received("sum", "closed", {"facts": {}}))
    play.dies("sum", 0)
    play.wait(1.0)

    assert (play.report.interrupted, play.report.wall, play.report.streams) == (True, 0.0, {})
    assert [fields["outcome"] for _, fields in sent(play.commands, "leave")] == ["interrupted"] * 3
    assert sent(play.commands, "go") == []
    assert killed(play.commands) == []


def test_process_still_starting_at_ctrl_c_is_killed_without_failure() -> None:
    play = Play(record="run.mcap")
    play.deaf.add("sum")
    play.tell(RunStarted(), Received("sum", "joined", {}))
    play.stops()
    play.wait(7.0)

    assert killed(play.commands) == ["sum"]
    assert asked_where(play.commands) == []
    assert play.report.interrupted
    assert play.report.notes == ("still starting, and killed: process 'sum'",)
    assert sent(play.commands, "leave")[-1][1]["outcome"] == "interrupted"


def test_a_recorder_that_does_not_close_after_ctrl_c_while_starting_is_a_failure() -> None:
    play = Play(record="run.mcap")
    play.deaf.add("@recorder")
    play.begins()
    play.stops()
    play.wait(20.0)

    assert "did not close within 10 s: process '@recorder'" in play.failure()


def test_a_second_ctrl_c_while_starting_does_not_wait() -> None:
    play = Play()
    play.deaf.add("sum")
    play.begins()
    play.stops()
    play.stops()
    play.wait(2.0)

    assert play.failure() == "stopped before everything was closed"


def test_draining_is_bounded_and_reports_the_backlog() -> None:
    play = Play(stall_timeout=30.0).starts()
    play.tell(play.progress("left", {"left": 1_800_000_000}))
    play.stops()

    for k in range(40):
        play.tell(play.progress("sum", {"sum": k}))
        play.wait(1.0)

    assert re.fullmatch(
        "interrupted, and not everything was drained within 30 s: "
        "sum was at stamp (28|29|30) after 1 firings, sources had given up to 1800000000",
        play.failure(),
    )
    assert play.failed_by.interrupted


@pytest.mark.parametrize(("patience", "closes_within"), [(120.0, 60.0), (8.0, 8.0), (1.0, 5.0)])
def test_patience_shortens_the_time_for_closing(patience: float, closes_within: float) -> None:
    play = Play(stall_timeout=patience).starts()
    play.deaf.add("sum")

    play.tell(*(play.ended(label) for label in play.processes))
    play.wait(100.0)

    assert play.failure() == f"did not close within {closes_within:g} s: process 'sum'"
    assert killed(play.commands) == ["sum"]
    assert asked_where(play.commands) == ["sum"]


def test_failure_details_hold_output_of_the_late_process_and_no_old_output_of_others() -> None:
    play = Play(stall_timeout=8.0).starts()
    play.deaf.add("sum")
    for label in play.processes:
        play.tell(*(Printed(label, f"{label} {k}") for k in range(10)))
    play.tell(*(play.ended(label) for label in play.processes))
    play.wait(7.5)
    play.tell(Printed("sum", 'File "driver.py", line 7 in release'))
    play.wait(2.0)

    details = play.failed_by.details
    assert '[sum] File "driver.py", line 7 in release' in details
    assert "[sum] sum 0" in details
    assert "[left] left 9" in details
    assert "[left] left 0" not in details


def test_processes_left_behind_are_named() -> None:
    play = Play().starts()
    play.tell(OrphansKilled(("sum",), ("sleep (process 12)",)), OrphansKilled(("left", "sum"), ("cat (process 13)",)))
    assert play.ends().notes == (
        "process 'sum' left processes behind, which were killed: sleep (process 12)",
        "process 'left' or 'sum' left processes behind, which were killed: cat (process 13)",
    )


def test_a_program_that_cannot_go_on_ends_the_run_in_order() -> None:
    play = Play().starts()
    play.tell(Aborted("the process that starts the others has ended"))
    play.wait(1.0)

    assert play.failure() == "the process that starts the others has ended"


def test_after_the_end_nothing_is_commanded() -> None:
    play = Play().starts()
    play.ends()

    assert play.tell(Tick(), Received("sum", "progress", {"done": {}, "counts": {}}), Exited("sum", 0)) == []
    assert [c for c in play.commands if isinstance(c, RunEnded)] == [play.over]


def test_progress_between_polling_rounds_invalidates_the_proof() -> None:
    """Everybody is idle, and as much was received as sent, in every round."""
    play = Play().starts()
    play.state = {"sent": 5, "received": 5}
    for k in range(3):
        play.now += 0.31
        play.tell(Tick())
        play.tell(Tick())
        play.tell(play.progress("sum", {"sum": k}))
    assert play.over is None

    play.now += 0.31
    for _ in range(3):
        play.tell(Tick())
    assert play.failure() == "the graph is stuck: nothing is on its way and no operator can fire"


@pytest.mark.parametrize("lost_after", [None, 5.0])
def test_unreceived_messages_count_as_lost_only_after_an_idle_period(
    lost_after: float | None,
) -> None:
    proof = Proof(lost_after)
    under_way = [{"idle": True, "sent": 5, "received": 2}, {"idle": True, "sent": 1, "received": 3}]
    assert not proof.judge([{**under_way[0], "idle": False}], 0.0)
    assert [proof.judge(under_way, now) for now in (1.0, 5.9)] == [False] * 2
    assert proof.judge(under_way, 6.0) is (lost_after is not None)
    more = [under_way[0], {**under_way[1], "received": 4}]
    assert [proof.judge(more, now) for now in (7.0, 7.1)] == [False, True]


def test_a_window_is_doubled_only_so_often() -> None:
    play = Play(window=(8, 1 << 20)).starts()
    play.state = {"full": True}
    play.wait(60.0)
    assert play.failure().startswith("the graph is stuck")
    assert play.core.status.notes[-1].endswith(f"doubled to {8 << MAX_WINDOW_DOUBLINGS} messages")
    assert len(sent(play.commands, "grow")) == 2 * MAX_WINDOW_DOUBLINGS


def test_first_stamps_and_steps_are_those_of_all_sources() -> None:
    play = Play(LEFT, "right: {use: runtime_operators:Counter}", SUM)
    play.deaf |= {"left", "right"}
    play.begins()
    for label, first, steps in (("left", 9, 3), ("right", 7, 5)):
        play.tell(Received(label, "joined", {}), Received(label, "ready", {"first": first, "steps": steps}))
    assert (play.core.status.first, play.core.status.steps) == (7, 5)
    play.deaf.clear()
    play.wait(0.2)
    for label, first in (("left", 12), ("right", 11), ("left", 13)):
        play.tell(play.progress(label, {}, first=first))
    assert play.core.status.began == 11


def test_pauses_steps_and_speeds_go_to_all_and_what_processes_say_of_them_is_shown() -> None:
    play = Play()
    asked = PlaybackRequested("pause", 1, None)
    play.deaf.add("sum")
    play.begins()
    assert sent(play.tell(asked), "playback") == []  # nothing is paused that has not begun
    play = Play(record="run.mcap").starts()
    assert sent(play.tell(PlaybackRequested("step", 3, 0.5)), "playback") == [
        (label, {"action": "step", "steps": 3, "speed": 0.5}) for label in ("left", "sum", "@recorder")
    ]
    play.tell(
        Received("left", "progress", {"done": {}, "counts": {}, "paused": True}),
        Received("left", "playback", {"speed": 2.0}),
    )
    assert (play.core.status.paused, play.core.status.speed) == (True, 2.0)
    play.tell(Received("left", "progress", {"done": {}, "counts": {}, "paused": False}))
    assert not play.core.status.paused


def test_a_run_that_is_paused_is_not_stuck() -> None:
    play = Play(stall_timeout=10.0).starts()
    play.state = {"idle": False}
    for _ in range(5):
        play.wait(8.0)
        play.tell(Received("left", "playback", {"paused": True, "speed": None}))
    assert play.over is None
    play.wait(11.0)
    assert "no progress for 10 s" in play.failure()


def test_event_time_goes_by_the_rate_from_the_first_stamp() -> None:
    play = Play(record="run.mcap", rate=2.0)
    play.deaf.add("left")
    play.begins()
    play.tell(Received("left", "joined", {}), Received("left", "ready", {"first": 5_000_000_000, "steps": None}))
    play.deaf.clear()
    play.tell(
        *(
            Received(label, "seen", {"stream": s})
            for label in play.processes
            for s in play.core.run.processes[label].unseen
        )
    )
    play.tell(Tick())
    play.now += 1.5
    ((_, event),) = sent(play.tell(Paused(6.0)), "event")
    assert event["stamp"] == pytest.approx(8_000_000_000, abs=1e3)


def test_report_collects_the_figures_of_processes() -> None:
    play = Play(record="run.mcap").starts()
    play.tell(play.progress("left", {"left": 70}, drops={"sum": [["x", "full", 2]]}))
    play.now += 2.5
    play.tell(Paused(6.5, uncounted=6.0))
    counts = {"left": {"left": [3, 6, 0, 9, 90, 12]}, "sum": {"sum": [2, 0, 0, 5, 80, 7]}, "@recorder": {}}
    more = {
        "left": {"streams": {"test/left/fast": [3, "abc"]}},
        "sum": {"summaries": {"sum": {"mean": 4.5}}, "waits": {"sum": [["x", "late", 1]]}},
    }
    for label, each in counts.items():
        handed_in = {"counts": each, "streams": {}, "transport": {"sent": 1}, "expected": 0, **more.get(label, {})}
        play.tell(Received(label, "ended", {"report": handed_in}))
    report = play.report
    assert report.digests() == {"test/left/fast": "abc"}
    assert report.operators["left"] == OperatorCounts(3, 6, 0, 9, 90, 12)
    assert (report.drops, report.waits) == ({"sum": (("x", "full", 2),)}, {"sum": (("x", "late", 1),)})
    assert report.summaries == {"sum": {"mean": 4.5}}
    assert (report.last, report.sources, report.interrupted) == (90, ("left",), False)
    assert report.wall == pytest.approx(8.5, abs=0.2)
    assert set(report.files) == {"@recorder"}
    leave = dict(sent(play.commands, "leave"))
    assert leave["@recorder"]["summaries"] == {"sum": {"mean": 4.5}}


def test_exit_codes_and_spans_in_words() -> None:
    codes = {3: "exited with code 3", -11: "was killed by SIGSEGV", -99: "was killed by signal 99"}
    assert {code: how_it_ended(code) for code in codes} == codes
    assert how_it_ended(None) == "ended in a way that is not known"
    spans = {119.6: "120 s", 7199: "7199 s", 7200: "2 hours", 86400: "24 hours", 172800: "2 days", 1e9: "31.7 years"}
    assert {seconds: how_long(seconds) for seconds in spans} == spans
