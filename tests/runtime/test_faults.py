"""Each fault on its own: what a live run does about it, that it says so, and that the recording repeats it."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from dataflow.chaos.plan import plan_of
from dataflow.graph import Graph, load_graph
from dataflow.messages import Diagnostics
from dataflow.names import diagnostics_key
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.core.report import RunFailed, RunReport
from dataflow.supervision.core.watchers import heartbeats
from dataflow.supervision.run import replay, run
from dataflow.verification.verify import verify

pytestmark = pytest.mark.usefixtures("in_process")

AGAIN = "restart: {max: 5, backoff: 20ms}"


def graph_of(*operators: str) -> Graph:
    """A graph for a live run, of operators given as YAML lines."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.yaml"
        path.write_text("\n  ".join(("graph: robot\nnamespace: test\noperators:", *operators)))
        return load_graph(path, live=True)


def robot(*operators: str, count: int = 100) -> Graph:
    """A counter named `left` at 100 Hz, and operators after it."""
    left = f"left: {{use: runtime_operators:Counter, params: {{count: {count}}}, live: {{{AGAIN}}}}}"
    return graph_of(left, *operators)


class Ran:
    """A recorded live run, and what its recording says."""

    def __init__(self, graph: Graph, path: Path, *faults: Mapping[str, Any], **options: Any) -> None:
        self.path = path
        plan = plan_of({"faults": list(faults)}, graph) if faults else None
        self.report: RunReport = run(
            graph, live=True, record=path, **{"placement": "process_each", "faults": plan} | options
        )

    def events(self, name: str) -> list[str]:
        with Recording(self.path) as recording:
            return [str(event.data["text"]) for event in recording.events() if event.name == name]

    def kinds(self, operator: str) -> list[tuple[int, str]]:
        with Recording(self.path) as recording:
            return [(r.incarnation, r.kind) for r in recorded_firings(recording, operator)]

    def numbers(self, stream: str) -> list[Sequence[float]]:
        with Recording(self.path) as recording:
            return [r.message.vectors[0].tolist() for r in recording.messages([stream])]

    def states(self, operator: str) -> list[str]:
        with Recording(self.path) as recording:
            found = [r.message for r in recording.messages([diagnostics_key("test")])]
        assert all(isinstance(m, Diagnostics) for m in found)
        return [m.pairs(m.names.index(operator))["state"] for m in found]

    def dropped(self, operator: str, reason: str, input: str | None = None) -> int:
        found = self.report.drops.get(operator, ())
        return sum(n for name, why, n in found if why == reason and input in (None, name))

    def recorded(self, source: str, reason: str) -> int:
        """How many steps a source has not sent, by its firing records."""
        with Recording(self.path) as recording:
            return sum(r.detail.get(reason, 0) for r in recorded_firings(recording, source))

    def diagnosed(self, operator: str) -> dict[str, str]:
        """What the last diagnostics say of an operator."""
        with Recording(self.path) as recording:
            *_, last = (r.message for r in recording.messages([diagnostics_key("test")]))
        assert isinstance(last, Diagnostics)
        return last.pairs(last.names.index(operator))

    def is_repeated(self) -> bool:
        return verify(self.path, jobs=1).identical


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


SMOOTH = f"smooth: {{use: runtime_operators:Smooth, inputs: {{x: left/fast}}, live: {{{AGAIN}}}}}"
FALLBACK = "{}: {{use: faulty_operators:Fallback, inputs: {{x: left/fast, other: smooth/mean}}{}}}"


def test_crashed_process_is_replaced_while_the_rest_continues(path: Path) -> None:
    graph = robot(
        SMOOTH,
        FALLBACK.format("other", ""),
        FALLBACK.format("without", ", live: {size: 1000, on_stale: drop}"),
        count=250,
    )

    ran = Ran(graph, path, {"kind": "kill", "operator": "smooth", "at": "300ms"})

    assert ran.report.restarts == {"smooth": 1}
    (event,) = ran.events("restart")
    assert "process 'smooth' was killed by SIGKILL; started again in 0.02 s" in event
    assert ran.events("restarted") == ["process 'smooth' is back"]
    assert [i for i, kind in ran.kinds("smooth") if kind == "setup"] == [0, 1]
    stale = [row[0] for row in ran.numbers("test/other/y")]
    assert len(stale) == 250  # nobody else lost anything
    assert stale[0] == stale[-1] == 0.0
    assert 1.0 in stale  # and while it was away, its stream was marked
    assert {row[1] for row in ran.numbers("test/without/y") if row[0]} == {-1.0}  # marked, and none was given
    assert ran.is_repeated()


@pytest.mark.long
def test_crashed_source_is_restarted_at_the_current_time(path: Path) -> None:
    ran = Ran(robot(SMOOTH, count=250), path, {"kind": "kill", "operator": "left", "at": "300ms"})

    assert ran.report.restarts == {"left": 1}
    numbers = [row[0] for row in ran.numbers("test/left/fast")]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 249
    assert len(numbers) > 100
    assert ran.is_repeated()


@pytest.mark.long
def test_operator_that_raises_is_recreated_in_the_same_process(path: Path) -> None:
    ran = Ran(robot(SMOOTH), path, {"kind": "raise", "operator": "smooth", "at": "300ms"})

    assert ran.report.restarts == {"smooth": 1}
    said = r"operator 'smooth' failed in (fire|tick) at stamp \d+: InjectedFault: planned; made anew"
    assert re.search(said, ran.events("restart")[0])
    assert not ran.events("restarted")
    assert ran.is_repeated()


def test_restarts_come_to_an_end_and_the_last_cause_is_named(path: Path) -> None:
    graph = robot(
        "doomed: {use: faulty_operators:Doomed, inputs: {x: left/fast}, live: {restart: {max: 2, backoff: 1ms}}}"
    )

    with pytest.raises(RunFailed, match=r"operator 'doomed' failed in fire .* no calibration") as caught:
        Ran(graph, path)

    assert caught.value.operator == "doomed"
    with Recording(path) as recording:
        assert recording.metadata["dataflow:outcome"]["outcome"].startswith("failed: operator 'doomed'")
        outcomes = [r.outcome for r in recorded_firings(recording, "doomed") if r.kind == "fire"]
        outlived = [event.data for event in recording.events() if event.name == "restart"]
        logged = [line for _, line in recording.logs() if line.source == "dataflow.failure"]
    assert outcomes == ["error"] * 3
    assert len(outlived) == 2
    assert all(re.search(r"no calibration \(faulty_operators.py:\d+\); made anew", event["text"]) for event in outlived)
    assert all('faulty_operators.py", line ' in event["traceback"] for event in outlived)
    assert [(line.level, line.operator, Path(line.file).name) for line in logged] == [
        ("error", "doomed", "faulty_operators.py")
    ] * 2


HANGS = "bad: {{use: runtime_operators:Broken, params: {{how: hang}}, inputs: {{x: left/fast}}, live: {{{}}}}}"


@pytest.mark.long
def test_an_operator_that_hangs_is_killed_at_its_deadline_and_started_again(path: Path) -> None:
    ran = Ran(robot(HANGS.format(f"size: 1000, deadline: 200ms, {AGAIN}")), path)

    assert ran.report.restarts == {"bad": 1}
    (event,) = ran.events("restart")
    assert "process 'bad' missed the deadline of 'bad': its firing at stamp 1200000000 has taken 0.2" in event
    assert "(deadline 0.2 s)" in event
    assert ran.is_repeated()


def test_without_a_policy_a_hang_ends_the_run_and_names_operator_and_deadline(path: Path) -> None:
    with pytest.raises(RunFailed, match=r"missed the deadline of 'bad'.*\(deadline 0.2 s\)") as caught:
        Ran(robot(HANGS.format("size: 1000, deadline: 200ms")), path)

    assert caught.value.operator == "bad"
    with Recording(path) as recording:
        assert recording.streams["test/bad/y"].count > 0


SMALL = {"window": (8, 64 << 20)}
"""So that little has to wait for an operator before it counts as hung."""


@pytest.mark.long
@pytest.mark.parametrize("placement", ["process_each", "one_process"])
def test_a_hang_without_a_deadline_ends_the_run_when_too_much_waits_for_it(
    placement: str, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(heartbeats, "HUNG_AFTER", 1.0)
    graph = robot(HANGS.format("queue: newest, size: 1"), count=1000)

    with pytest.raises(
        RunFailed,
        match=r"hangs in 'bad': its firing at stamp 1200000000 has taken [\d.]+ s, "
        r"and \d+ messages \([\d.]+ MB\) wait: give it a `deadline` or a restart policy",
    ) as caught:
        Ran(graph, path, placement=placement, **SMALL)

    assert caught.value.operator == "bad"


@pytest.mark.long
def test_a_hang_without_a_deadline_is_ended_by_its_restart_policy(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeats, "HUNG_AFTER", 1.0)
    ran = Ran(robot(HANGS.format(f"queue: newest, size: 1, {AGAIN}"), count=400), path, **SMALL)

    assert ran.report.restarts == {"bad": 1}
    assert "process 'bad' hangs in 'bad': its firing at stamp 1200000000" in ran.events("restart")[0]
    assert ran.is_repeated()


LEAK = {"kind": "leak", "operator": "smooth", "megabytes": 400, "at": "200ms"}


def leaky(live: str) -> Graph:
    return robot(
        f"smooth: {{use: runtime_operators:Smooth, inputs: {{x: left/fast}}, live: {{memory: 350MB, {live}}}}}",
        count=200,
    )


@pytest.mark.long
def test_a_process_that_leaks_past_its_limit_is_started_again(path: Path) -> None:
    ran = Ran(leaky(AGAIN), path, LEAK)

    assert ran.report.restarts == {"smooth": 1}
    assert "MB of memory (limit " in ran.events("restart")[0]
    assert ran.is_repeated()


@pytest.mark.long
def test_without_a_policy_a_leak_ends_the_run_before_the_machine_does(path: Path) -> None:
    with pytest.raises(RunFailed, match=r"process 'smooth' took \d+ MB of memory \(limit \d+ MB\)"):
        Ran(leaky("restart: {max: 0}"), path, LEAK)


@pytest.mark.long
def test_slow_operator_drops_by_policy_without_delaying_others(path: Path) -> None:
    graph = robot(
        "slow: {use: runtime_operators:Smooth, inputs: {x: left/fast}, live: {queue: newest, size: 1}}",
        "sum: {use: runtime_operators:Sum, inputs: {x: left/fast}, live: {size: 1000}}",
        count=250,
    )
    slow = {"kind": "slow", "operator": "slow", "by": "1500ms", "for": "1s", "at": "200ms"}

    ran = Ran(graph, path, slow, window=(64, 64 << 20))  # much more than a window comes while it is at one firing

    assert ran.dropped("slow", "overflow", "x") > 100
    assert ran.dropped("slow", "overflow", "@tick") > 0  # nor does its own timer fall behind
    assert ran.report.operators["left"].dropped == 0
    assert ran.report.summaries["sum"]["count"] == 250
    assert "dropping" in ran.states("slow")
    assert ran.is_repeated()


@pytest.mark.long
def test_a_source_that_stops_is_an_event_in_the_diagnostics(path: Path) -> None:
    graph = robot(SMOOTH, "sum: {use: runtime_operators:Sum, inputs: {x: left/fast}}", count=1000)

    ran = Ran(graph, path, {"kind": "stop", "operator": "left", "for": "2500ms", "at": "500ms"})

    assert "silent" in ran.states("left")
    assert "silent" in ran.states("sum")
    assert ran.states("left")[-1] != "silent"
    assert "silent" not in ran.states("smooth")  # its timer goes on
    assert ran.is_repeated()


@pytest.mark.long
def test_a_source_that_stops_holds_up_no_other(path: Path) -> None:
    graph = robot(
        "right: {use: runtime_operators:Counter, params: {count: 250}}",
        "one: {use: runtime_operators:Sum, inputs: {x: left/fast}, live: {size: 1000}}",
        f"other: {{use: runtime_operators:Sum, inputs: {{x: right/fast}}, live: {{queue: block, {AGAIN}}}}}",
        count=250,
    )
    stop = {"kind": "stop", "operator": "right", "for": "1300ms", "at": "900ms"}
    kill = {"kind": "kill", "operator": "other", "at": "1100ms"}

    ran = Ran(graph, path, stop, kill, window=(64, 64 << 20))  # less than the other gives in that time

    assert ran.report.restarts == {"other": 1}
    assert ran.report.operators["left"].dropped == 0
    assert ran.report.summaries["one"]["count"] == 250
    assert len(ran.numbers("test/right/fast")) < 150
    assert ran.is_repeated()


@pytest.mark.long
def test_a_flood_is_dropped_where_it_is_too_much_and_counted(path: Path) -> None:
    graph = robot(
        "slow: {use: runtime_operators:Smooth, params: {sleep: 0.01}, inputs: {x: left/fast}, "
        "live: {queue: newest, size: 4}}"
    )

    flood = {"kind": "flood", "operator": "left", "factor": 50, "for": "300ms", "at": "300ms"}

    ran = Ran(graph, path, flood, window=(2048, 64 << 20))

    assert len(ran.numbers("test/left/fast")) > 500
    assert ran.dropped("slow", "overflow", "x") > 300
    assert ran.is_repeated()


@pytest.mark.long
def test_source_drops_are_counted_by_reason_in_report_and_recording(path: Path) -> None:
    graph = robot(
        "slow: {use: runtime_operators:Smooth, params: {sleep: 0.05}, inputs: {x: left/fast}, live: {queue: block}}",
        count=250,
    )

    ran = Ran(graph, path, window=(8, 64 << 20))

    dropped = ran.dropped("left", "overflow", "")
    assert dropped == ran.report.operators["left"].dropped == ran.recorded("left", "overflow") > 50
    assert dropped + len(ran.numbers("test/left/fast")) == 250
    assert 0 < int(ran.diagnosed("left")["dropped.overflow"]) <= dropped
    assert ran.is_repeated()


@pytest.mark.long
def test_drops_of_a_killed_process_stay_counted(path: Path) -> None:
    graph = robot(
        f"slow: {{use: runtime_operators:Smooth, inputs: {{x: left/fast}}, live: {{queue: newest, size: 1, {AGAIN}}}}}",
        count=250,
    )
    slow = {"kind": "slow", "operator": "slow", "by": "100ms", "for": "1s", "at": "200ms"}

    ran = Ran(graph, path, slow, {"kind": "kill", "operator": "slow", "at": "1700ms"})

    assert ran.report.restarts == {"slow": 1}
    assert ran.dropped("slow", "overflow", "x") > 50
    assert ran.report.operators["slow"].dropped == sum(n for _, _, n in ran.report.drops["slow"])
    assert int(ran.diagnosed("slow")["dropped.x.overflow"]) > 50
    assert ran.is_repeated()


@pytest.mark.long
def test_source_slower_than_the_clock_is_reported_at_once_and_at_the_end(path: Path) -> None:
    graph = graph_of(
        "left: {use: runtime_operators:Counter, params: {count: 40, sleep: 0.15}}",
        "sum: {use: runtime_operators:Sum, inputs: {x: left/fast}, live: {size: 1000}}",
    )

    ran = Ran(graph, path)

    (event,) = ran.events("behind")
    assert event.startswith("source 'left' has fallen behind the clock: reading it waits")
    assert ran.report.notes[-1].startswith("source 'left' was ")
    assert "s behind the clock at the end" in ran.report.notes[-1]


def test_clock_jump_back_starts_an_incarnation_and_resets_operators(path: Path) -> None:
    graph = robot("resets: {use: faulty_operators:Resets, inputs: {x: left/fast}}")

    ran = Ran(graph, path, {"kind": "jump", "operator": "left", "by": "300ms", "at": "500ms"})

    assert (1, "reset") in ran.kinds("left")
    assert (1, "reset") in ran.kinds("resets")
    assert {row[0] for row in ran.numbers("test/resets/y")} == {0.0, 1.0}
    (event,) = ran.events("clock_jump")
    assert event.startswith("the clock of 'left' jumped back to ")
    assert ran.is_repeated()


@pytest.mark.long
def test_replay_after_a_clock_jump_back_drops_repeated_stamps_as_late(path: Path) -> None:
    graph = robot(
        "right: {use: runtime_operators:Counter, params: {count: 100}}",
        "both: {use: faulty_operators:Fallback, inputs: {x: left/fast, other: right/fast}}",
    )
    Ran(graph, path, {"kind": "jump", "operator": "left", "by": "300ms", "at": "500ms"}, placement="one_process")
    with Recording(path) as recording:
        stamps = [r.stamp for r in recording.messages(["test/left/fast"])]

    together, apart = (replay(path, placement=placement) for placement in ("one_process", "process_each"))

    late = sum(stamp <= max(stamps[:k], default=0) for k, stamp in enumerate(stamps))
    assert late > 10
    assert together.drops["both"] == apart.drops["both"] == (("x", "late", late),)
    assert together.digests() == apart.digests()


@pytest.mark.long
def test_clock_jump_ahead_continues_the_incarnation(path: Path) -> None:
    graph = robot("resets: {use: faulty_operators:Resets, inputs: {x: left/fast}}")

    ran = Ran(graph, path, {"kind": "jump", "operator": "left", "by": "10s", "back": False, "at": "500ms"})

    assert {row[0] for row in ran.numbers("test/resets/y")} == {0.0}
    assert len(ran.numbers("test/resets/y")) == 100
    assert ran.is_repeated()


@pytest.mark.long
def test_past_stamps_and_malformed_outside_messages_are_dropped(path: Path) -> None:
    past = {"kind": "past", "operator": "left", "by": "200ms", "every": "200ms"}

    ran = Ran(robot(SMOOTH), path, past, {"kind": "malformed", "operator": "left", "at": "300ms"})

    assert ran.report.transport["smooth"]["malformed"] == 0
    assert ran.dropped("left", "past") == ran.recorded("left", "past") >= 1
    assert len(ran.numbers("test/left/fast")) == 100
    assert not ran.events("clock_jump")
    assert ran.is_repeated()


@pytest.mark.long
def test_a_device_runs_by_the_clock_and_is_repeated(path: Path) -> None:
    graph = graph_of(
        f"device: {{use: faulty_operators:Device, live: {{{AGAIN}}}}}",
        f"resets: {{use: faulty_operators:Resets, inputs: {{x: device/count}}, live: {{{AGAIN}}}}}",
    )

    ran = Ran(graph, path, {"kind": "kill", "operator": "device", "at": "300ms"})

    assert ran.report.restarts == {"device": 1}
    assert [i for i, kind in ran.kinds("device") if kind == "setup"] == [0, 1]
    assert ran.is_repeated()


@pytest.mark.long
def test_source_that_raises_is_recreated_in_the_same_process(path: Path) -> None:
    graph = graph_of(
        f"camera: {{use: faulty_operators:Camera, live: {{{AGAIN}}}}}",
        "resets: {use: faulty_operators:Resets, inputs: {x: camera/count}}",
        "other: {use: faulty_operators:Fallback, inputs: {x: camera/count, other: camera/constant}}",
    )

    ran = Ran(graph, path)

    assert ran.report.restarts == {"camera": 1}
    assert "operator 'camera' failed in stream() after stamp " in ran.events("restart")[0]
    assert re.search(
        r"OSError: no such device \(faulty_operators.py:\d+\); made anew in 0.02 s", ran.events("restart")[0]
    )
    assert [i for i, kind in ran.kinds("camera") if kind == "setup"] == [0, 1]
    assert len(ran.numbers("test/resets/y")) == 130
    assert {row[1] for row in ran.numbers("test/other/y")} == {42.0}
    assert ran.is_repeated()


@pytest.mark.long
def test_without_a_policy_a_source_that_raises_ends_the_run(path: Path) -> None:
    graph = graph_of(
        "camera: {use: faulty_operators:Camera}", "resets: {use: faulty_operators:Resets, inputs: {x: camera/count}}"
    )

    with pytest.raises(RunFailed, match=r"'camera' failed in stream\(\) after stamp \d+: OSError: no such device"):
        Ran(graph, path)
