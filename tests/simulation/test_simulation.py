"""The engine on a simulated machine: whole runs by seed, in one thread, and what must hold of each."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace

import pytest

pytest.importorskip("greenlet", reason="simulated runs need the package greenlet (pip install -e '.[dev]')")

from simulation import bindings
from simulation import check as checks
from simulation.check import check, is_outrun
from simulation.disk import Disk
from simulation.flights import Flown
from simulation.keeping import Keeping, check_losses_of_files
from simulation.mutants import MUTANTS, Mutant
from simulation.pipes import journey_of, travel
from simulation.run import Happening, Machine, Outcome, simulate
from simulation.scenario import DRAWN, LONGEST_PAUSE, TICK, TICKING, Scenario, scenario_of
from simulation.shrink import shrink
from simulation.world import MOST_CALLS, Process, Violation, World

from dataflow.recording import RecordingError
from dataflow.recording.parts import Storage
from dataflow.supervision.core.report import RunFailed, RunReport
from dataflow.supervision.plan import RunPlan

PLAIN = Scenario(
    seed=1,
    graph="chain",
    live=False,
    count=6,
    period=5_000_000,
    work=0.0,
    reading=0.0,
    policy="",
    placement="process_each",
    window=256,
    machine=Machine(1),
)


@pytest.fixture
def memory(tmp_path: Path) -> Path:
    """A folder in memory, where there is one: simulated disks are as quick as that."""
    shared = Path("/dev/shm") / f"simulation-{os.getpid()}"
    if not shared.parent.is_dir():
        return tmp_path
    shared.mkdir(exist_ok=True)
    return shared


# The world


def test_tasks_wait_on_simulated_time_and_are_woken() -> None:
    world, seen = World(1), []
    process = world.process("one")

    def sleeper() -> None:
        world.wait(3600.0)
        seen.append(("slept", round(world.now)))
        world.wake(other)

    def waiter() -> None:
        assert world.wait()
        seen.append(("woken", round(world.now)))

    world.start("sleeper", process, sleeper)
    other = world.start("waiter", process, waiter)
    world.run(lambda: len(seen) == 2, 4000.0)

    assert seen == [("slept", 3600), ("woken", 3600)]


def test_killed_process_stops_and_a_frozen_one_resumes() -> None:
    world = World(1)
    seen: Counter[str] = Counter()

    def counting(process: Process) -> None:
        while True:
            world.wait(1.0)
            seen[process.label] += 1

    one, two = world.process("one"), world.process("two")
    for process in (one, two):
        world.start("main", process, lambda process=process: counting(process))
    world.at(5.5, lambda: world.kill(one))
    world.at(5.5, lambda: world.freeze(two))
    world.at(8.0, lambda: world.thaw(two))
    world.run(lambda: world.now > 12.0, 20.0)

    assert seen["one"] == 5
    assert 8 <= seen["two"] <= 10


def test_spinning_task_is_named() -> None:
    world = World(1, preempt=0.0)

    def spin() -> None:
        while True:
            world.clock()

    world.start("main", world.process("one"), spin)
    with pytest.raises(Violation, match="one: its task 'main' spins"):
        world.run(lambda: False, 1000.0)


def test_ticks_of_the_longest_pause_are_fewer_than_the_calls_of_a_spin() -> None:
    assert round(LONGEST_PAUSE / TICK) * 10 <= MOST_CALLS


def test_deleting_a_file_frees_disk_space(tmp_path: Path) -> None:
    disk = Disk(World(1), tmp_path, room=100)
    descriptor = disk.open(tmp_path / "one", os.O_WRONLY | os.O_CREAT, 0o600)
    while disk.statvfs(tmp_path).f_bavail:
        disk.write(descriptor, memoryview(bytes(150)))
    with pytest.raises(OSError, match="No space left"):
        disk.write(descriptor, memoryview(bytes(1)))
    disk.close(descriptor)
    size = (tmp_path / "one").stat().st_size
    (tmp_path / "one").unlink()

    assert (size, disk.full) == (100, True)
    assert disk.statvfs(tmp_path).f_bavail == 100


def test_nothing_reads_the_clock_past_the_simulation() -> None:
    """The engine reads time through the name `time` of each module: a function bound there would be the real one."""
    names = {module for module, _ in bindings.clocks()}
    assert {"dataflow.process.operator_process", "dataflow.supervision.supervisor", "dataflow.execution.live"} <= names
    real = {time.monotonic, time.time, time.sleep, time.monotonic_ns, time.perf_counter}
    for module in names:
        bound = [name for name, thing in vars(sys.modules[module]).items() if callable(thing) and thing in real]
        assert not bound, f"{module} binds {bound}"
        functions = [thing for thing in _functions(sys.modules[module]) if thing.__module__ == module]
        defaults = {f.__qualname__: [*(f.__defaults__ or ()), *(f.__kwdefaults__ or {}).values()] for f in functions}
        given = [name for name, values in defaults.items() if any(value is each for value in values for each in real)]
        assert not given, f"{module} has the real clock as a default of {given}"


def _functions(module: ModuleType) -> Iterator[FunctionType]:
    """The functions of a module, and those of its classes."""
    for thing in vars(module).values():
        inner = vars(thing).values() if isinstance(thing, type) else (thing,)
        yield from (function for function in inner if isinstance(function, FunctionType))


# Runs


def test_time_limit_allows_for_ticks_due_during_a_pause() -> None:
    ticks = replace(PLAIN, graph=TICKING, live=True, work=0.05)
    frozen, paused = (
        replace(ticks, happenings=(Happening(0.1, kind, "left", {"span": 6.0}),)) for kind in ("freeze", "pause")
    )
    assert paused.limit >= frozen.limit


def test_a_seed_gives_one_course(memory: Path) -> None:
    scenario = scenario_of(3)
    courses = []
    for _ in range(2):
        path = memory / "once.mcap"
        plan = RunPlan(scenario.load(), placement="process_each", record=path, overwrite=True)
        outcome = simulate(plan, scenario.machine)
        assert outcome.report is not None
        courses.append((outcome.seconds, outcome.turns, outcome.calls, dict(outcome.report.streams)))

    assert courses[0] == courses[1]


def test_killed_process_of_a_live_run_restarts_and_the_recording_is_whole(memory: Path) -> None:
    policy = "restart: {max: 5, backoff: 10ms}"
    kills = (Happening(0.03, "kill", "relay"), Happening(0.06, "kill", "left"))
    scenario = replace(PLAIN, live=True, policy=policy, count=12, period=20_000_000, happenings=kills)

    result = check(scenario, memory)

    assert result.verdict == "identical"
    assert result.outcome.report is not None
    assert result.outcome.report.restarts == {"relay": 1, "left": 1}


def test_a_full_disk_ends_the_run_and_leaves_a_readable_recording(memory: Path) -> None:
    scenario = replace(PLAIN, machine=Machine(1, room=12_000))

    result = check(scenario, memory)

    assert result.outcome.disk_full
    assert "No space left on device" in str(result.outcome.failure)


def test_a_disk_that_is_full_at_the_beginning_refuses_the_run(memory: Path) -> None:
    keeping = Keeping(storage=Storage(on_failure="go_on"), flight=True)
    scenario = replace(PLAIN, live=True, keeping=keeping, machine=Machine(1, room=2_000))

    result = check(scenario, memory)

    told = str(result.outcome.failure)
    assert told.startswith("not ready within 20 s: process '@recorder', which failed")
    assert "No space left on device" in told


def test_a_frozen_process_is_not_waited_for_without_end(memory: Path) -> None:
    frozen = (Happening(0.001, "freeze", "relay", {"span": 1e6}),)

    result = check(replace(PLAIN, happenings=frozen, window=2), memory)

    assert "no progress for 20 s" in str(result.outcome.failure)
    assert result.outcome.seconds < 60.0


RESTARTED = "restart: {max: 5, backoff: 10ms}"


@pytest.mark.parametrize(
    "policy", ["", pytest.param(RESTARTED, marks=pytest.mark.long), f"deadline: 200ms, {RESTARTED}"]
)
@pytest.mark.parametrize("target", ["*", "", "relay", "@recorder"])
@pytest.mark.parametrize("span", [pytest.param(6.0, marks=pytest.mark.long), 40.0])
def test_pause_of_supervisor_and_others_kills_and_blames_no_process(
    target: str, span: float, policy: str, memory: Path
) -> None:
    pause = (Happening(0.05, "pause", target, {"span": span}),)

    result = check(replace(PLAIN, live=True, policy=policy, count=12, happenings=pause, work=0.05), memory)

    assert result.outcome.report is not None
    (note,) = result.outcome.report.notes
    assert note == f"the supervisor did not run for {span:.1f} s, which count against no process"


def test_a_process_that_stands_still_longer_than_the_pause_is_started_again(memory: Path) -> None:
    happenings = (Happening(0.15, "pause", "", {"span": 6.0}), Happening(0.15, "freeze", "relay", {"span": 12.0}))
    plain = replace(PLAIN, live=True, policy=RESTARTED, count=12, period=20_000_000)

    result = check(replace(plain, happenings=happenings), memory)

    assert result.outcome.report is not None
    assert result.outcome.report.restarts == {"relay": 1}


@pytest.mark.parametrize("first", [0, *(pytest.param(at, marks=pytest.mark.long) for at in range(25, 200, 25))])
def test_seeds(first: int, memory: Path) -> None:
    """No hang, no loss without a count, recordings that verify, replays that are equal."""
    for seed in range(first, first + 25):
        scenario = scenario_of(seed)
        try:
            check(scenario, memory, replay=seed % 4 == 0)
        except Violation as violation:
            pytest.fail(f"{scenario.describe()}\n{violation}")


def test_recording_lacking_inputs_of_actuators_is_completed_not_replayed(memory: Path) -> None:
    parts = (
        "left: {SOURCE}",
        "arm: {use: simulation.operators:Arm, inputs: {x: left/fast}}",
        "relay: {use: simulation.operators:Relay, inputs: {x: left/slow}}",
    )
    scenario = replace(PLAIN, graph=DRAWN, parts=parts, keeping=Keeping("exclude: ['left/fast']"))

    result = check(scenario, memory)

    assert (result.verdict, result.replayed) == ("identical", False)


@pytest.mark.parametrize(
    ("owed", "busy", "outrun"),
    [
        ("@recorder was at stamp 5 after 0 firings, sources had given up to 9", 0.97, True),
        ("@recorder was at stamp 5 after 0 firings, sources had given up to 9", 0.2, False),  # it waits, for nothing
        ("@recorder was at stamp 5 after 0 firings; sum was at stamp 3 after 1 firings", 0.97, False),
        ("sum was at stamp 3 after 1 firings, sources had given up to 9", 0.97, False),
    ],
)
def test_only_a_constantly_writing_recorder_excuses_incomplete_draining(owed: str, busy: float, outrun: bool) -> None:
    failure = RunFailed(f"interrupted, and not everything was drained within 20 s: {owed}", interrupted=True)

    assert is_outrun(Outcome(failure=failure, disk_busy=busy)) is outrun


SEEDS = [23_000_041, 23_000_109, 23_000_334, 23_000_461, 23_000_570, 23_000_869, 25_050_699]


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_seeds_that_broke_a_promise_once(seed: int, memory: Path) -> None:
    check(scenario_of(seed), memory)


@pytest.mark.parametrize("first", [0, *(pytest.param(at, marks=pytest.mark.long) for at in range(10, 100, 10))])
def test_links_between_machines(first: int) -> None:
    """Frames arrive once and in order, whatever becomes of the link; clocks are known to half the delay."""
    for seed in range(first, first + 10):
        travel(journey_of(seed))


def test_clocks_of_silent_machines_are_measured() -> None:
    """A beat and its answer take longer than a second here."""
    travel(journey_of(25_002_417))


# Planted faults

FOUND_BY = {
    "frontier": replace(PLAIN, graph="diamond", happenings=(Happening(0.01, "freeze", "two", {"span": 0.2}),)),
    "frozen": replace(
        PLAIN,
        graph="join",
        live=True,
        count=12,
        machine=Machine(2, socket_room=2),
        happenings=(
            Happening(0.01, "freeze", "@recorder", {"span": 1e6}),
            Happening(0.1, "freeze", "smooth", {"span": 0.05}),
        ),
    ),
    "gap": replace(
        PLAIN,
        graph=TICKING,
        live=True,
        policy="queue: newest, size: 1",
        period=20_000_000,
        window=2,
        machine=Machine(1, ring_bytes=4096),
        happenings=(Happening(0.01, "freeze", "sum", {"span": 1.0}), Happening(0.02, "freeze", "left", {"span": 0.05})),
    ),
    "itself": replace(
        PLAIN,
        graph=DRAWN,
        live=True,
        count=6,
        period=20_000_000,
        machine=Machine(7),
        happenings=(Happening(0.01, "freeze", "loop", {"span": 0.05}),),
        parts=(
            "left: {SOURCE}",
            "loop: {use: simulation.operators:LoopedBatch, inputs: {x: left/fast, last: loop/y, rest: left/fast}}",
        ),
    ),
    "pause": replace(
        PLAIN,
        live=True,
        happenings=(Happening(0.01, "pause", "*", {"span": 6.0}), Happening(0.02, "set", "relay", {"gain": 2.0})),
    ),
}
"""Scenarios that find a planted fault; how many seeds each needs: benchmarks/simulation.md."""


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(FOUND_BY))
def test_a_planted_fault_is_found_and_its_plan_shrunk(name: str, memory: Path) -> None:
    scenario = FOUND_BY[name]
    check(scenario, memory, replay=False)

    with MUTANTS[name].planted():
        with pytest.raises(Violation) as broken:
            check(scenario, memory, replay=False)
        small, said = shrink(scenario, memory, broken.value, most=6)

    assert said
    assert len(small.happenings) < len(scenario.happenings)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "seed"), [("part", 36), ("state", 26), ("reload", 93), ("again", 4), ("drops", 173), ("half", 11)]
)
def test_recording_mutants_are_detected(name: str, seed: int, memory: Path) -> None:
    check(scenario_of(seed), memory, replay=False)

    with MUTANTS[name].planted(), pytest.raises(Violation):
        check(scenario_of(seed), memory, replay=False)


def test_pipe_mutant_that_ignores_link_losses_is_detected() -> None:
    travel(journey_of(3))

    with MUTANTS["link"].planted(), pytest.raises(Violation, match=r"out of order|was changed|did not come"):
        travel(journey_of(3))


def test_a_graph_is_shrunk_only_to_graphs(memory: Path) -> None:
    """One that leaves out a stream by its name does not load without the operator that publishes it."""
    relay = "relay: {use: simulation.operators:Relay, inputs: {x: right/fast}}"
    parts = ("left: {SOURCE}", "right: {SOURCE}", relay)
    scenario = replace(PLAIN, graph=DRAWN, parts=parts, keeping=Keeping("exclude: ['left/fast']"))

    def run(tried: Scenario, folder: Path) -> None:
        if "left/fast" not in tried.load().record.streams and tried.keeping.topics:
            raise Violation("it is left out")

    small, said = shrink(scenario, memory, Violation("broken"), run=run)

    assert said == "it is left out"
    assert small.count == 1


def test_unexpected_exception_is_a_violation_of_its_seed(memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulation.check._verify", lambda *_: 1 // 0)

    with pytest.raises(Violation, match="ZeroDivisionError"):
        check(PLAIN, memory)


def test_planting_a_fault_leaves_nothing_behind() -> None:
    places = {place: place[0].__dict__[place[1]] for mutant in MUTANTS.values() for place in mutant.replaced()}
    for mutant in MUTANTS.values():
        assert isinstance(mutant, Mutant)
        with mutant.planted():
            pass
    assert all(cls.__dict__[name] is function for (cls, name), function in places.items())


RUN = Path(__file__).resolve().parent.parent / "recordings_of" / "run.mcap"
"""A whole recording."""


@pytest.mark.parametrize("lost", [{}, {"lost": {"messages": 1}}], ids=["not counted", "counted"])
def test_empty_recordings_are_accepted_only_with_counted_losses(
    lost: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of one that was killed when it began, of which the next one found the disk full."""
    for name in ("run_000.mcap", "run_001.mcap"):
        shutil.copy(RUN, tmp_path / name)
    monkeypatch.setattr("simulation.check._unchanged", lambda *_, **__: None)
    monkeypatch.setattr("simulation.check.joined", _nothing_is_there)
    report = RunReport("robot", {}, {}, {}, {}, {}, {"@recorder": lost}, 0, 1, 0.0, interrupted=False, notes=())
    outcome = Outcome(report)

    if lost:
        assert checks._verify(checks._joined(PLAIN, tmp_path, outcome), outcome, PLAIN) == "no recording"
    else:
        with pytest.raises(Violation, match="nothing is in any"):
            checks._joined(PLAIN, tmp_path, outcome)


def _nothing_is_there(*_: object) -> Path:
    raise RecordingError("nothing is in any of these files")


@pytest.mark.parametrize(
    ("outcome", "whole"),
    [
        (Outcome(failure=RunFailed("interrupted")), True),
        (Outcome(failure=RunFailed("interrupted"), disk_full=True), False),
        (Outcome(failure=RunFailed("interrupted"), killed={"@recorder"}), False),
    ],
)
def test_a_run_that_failed_does_not_tell_what_found_no_room(outcome: Outcome, whole: bool) -> None:
    assert checks._holds_all(outcome) is whole


def test_a_stream_that_no_file_has_is_lost_a_flight_without_a_file_kept_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checks themselves: of files, of a completed recording, and of a flight recorder."""
    streams, files = {"robot/nothing/out": (5, "")}, {"@recorder": {"kept": [], "not_kept": 0}}
    report = RunReport("robot", streams, {}, {}, {}, {}, files, 0, 1, 0.0, interrupted=False, notes=())
    with pytest.raises(Violation, match="of 5 messages of robot/nothing/out 0 are stored"):
        check_losses_of_files(report, RUN, streams)
    monkeypatch.setattr("simulation.check.complete", lambda *_, **__: SimpleNamespace(whole=True))
    with pytest.raises(Violation, match="lacks messages of robot/nothing/out"):
        checks._check_completion(RUN, RUN, PLAIN.load(), Outcome(report))
    checks._check_completion(RUN, RUN, PLAIN.load(), Outcome(report, killed={"@recorder"}))
    graph = replace(PLAIN, keeping=Keeping(flight=True)).load()
    assert checks._check_flight(Outcome(report), graph, tmp_path) == "nothing kept"
    with pytest.raises(Violation, match="nothing is kept, though left failed"):
        checks._check_flight(Outcome(replace(report, restarts={"left": 1})), graph, tmp_path)
    reason = {"what": "left failed", "operators": ["left"], "stamp": 7}
    no_room = {"kept": [{"path": "a.mcap", "reasons": [reason], "error": "No space left on device"}], "not_kept": 0}
    restarted = replace(report, restarts={"left": 1}, files={"@recorder": no_room})
    with pytest.raises(Violation, match="could not keep what was asked for: No space left"):
        checks._check_flight(Outcome(restarted), graph, tmp_path)
    flown = Flown(asked=[(("restart", "left", 7), 7)], kept=[(0, frozenset())])
    assert checks._check_flight(Outcome(restarted, disk_full=True, flown=flown), graph, tmp_path) == "nothing kept"
    asked = Flown(asked=[(("drops", "left", 7), 7)])
    with pytest.raises(Violation, match=r"was asked .*'drops', 'left', 7.* and kept \[\]"):
        checks._check_flight(Outcome(report, flown=asked), graph, tmp_path)
    with pytest.raises(Violation, match="its end is not kept: a call failed"):
        checks._check_flight(Outcome(failure=RunFailed("a call failed")), graph, tmp_path)
