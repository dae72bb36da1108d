"""What must hold after every scenario, however it went.

No hang: it is over in bounded simulated time. No loss without a count: what was made was taken, or dropped with a
reason, or is counted as missed. The recording verifies as identical, or, where the run was cut short, as far as it
goes; one with recorded states also from its middle. A replay, placed otherwise and on another machine, has the same
digests.
"""

from __future__ import annotations

import functools
import importlib
import os
import random
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dataflow.graph import Graph
from dataflow.graph.load import load_bundle
from dataflow.recording import Recording, RecordingError
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.core.report import RunReport
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.replay import plan_replay
from dataflow.sync import messages_of
from dataflow.verification.complete import complete
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify
from dataflow.verification.workers.board import Board
from dataflow.verification.workers.processes import Call
from simulation import reloading
from simulation.bindings import bound
from simulation.blocks import by_blocks
from simulation.flights import check_reasons, check_spans
from simulation.keeping import check_losses_of_files, files_of, joined, kept_by_flight
from simulation.opening import opened_once
from simulation.run import Machine, Outcome, simulate
from simulation.scenario import PATIENCE, TICKING, TIMEOUT, Scenario
from simulation.world import Violation

BUSY = 0.9
"""Share of the time after a stop in which a recorder waits for a disk that it cannot keep up with."""
MOST_PARTS = 8
"""Parts of a recording that are verified each by itself."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a scenario came to."""

    outcome: Outcome
    verdict: str
    replayed: bool = False
    drops: int = 0


def check(scenario: Scenario, folder: Path, *, replay: bool = True) -> Result:
    """Runs a scenario and everything that must hold of it. Raises `Violation`."""
    for old in folder.rglob("*.mcap"):
        old.unlink()
    with reloading.fresh_files():
        try:
            return _check(scenario, folder, replay=replay)
        except Violation:
            raise
        except Exception as error:
            raise Violation(f"{type(error).__name__}: {error}") from error


def _check(scenario: Scenario, folder: Path, *, replay: bool) -> Result:
    graph = scenario.load()
    plan = _plan(scenario, graph, folder)
    outcome = simulate(plan, scenario.machine, scenario.happenings, limit=scenario.limit)
    refused = outcome.disk_full and "not ready within" in str(outcome.failure)  # a disk that was full at the beginning
    if outcome.failure is not None and not (scenario.may_fail or refused or is_outrun(outcome)):
        raise Violation(f"the run failed: {outcome.failure}\n{outcome.failure.details}")
    if scenario.only_paused:
        _check_pauses(outcome)
    with opened_once():
        return _check_outcome(scenario, folder, graph, outcome, replay=replay)


def _check_outcome(scenario: Scenario, folder: Path, graph: Graph, outcome: Outcome, *, replay: bool) -> Result:
    report = outcome.report
    if scenario.keeping.flight:
        return Result(outcome, _check_flight(outcome, graph, folder / "flight"))
    path = _joined(scenario, folder, outcome)
    verdict = _verify(path, outcome, scenario)
    if scenario.keeping.states and verdict == "identical" and not scenario.keeping.topics:
        _verify_from_middle(path)
    drops = 0
    if report is not None and _holds_all(outcome):
        records = _records_of(path, graph)
        drops = _check_losses(records, graph, report, live=scenario.live)
        if not scenario.live:
            _check_window(records, graph, scenario, report)
    if report is not None and verdict == "identical" and scenario.keeping.topics:
        _check_completion(path, folder / "complete.mcap", graph, outcome)
    replayed = replay and report is not None and verdict == "identical" and _may_replay(scenario, report)
    if replayed:
        assert report is not None
        _check_replay(scenario, path, report)
    return Result(outcome, verdict, replayed, drops)


def _plan(scenario: Scenario, graph: Graph, folder: Path) -> RunPlan:
    flight = scenario.keeping.flight
    return RunPlan(
        graph,
        placement=scenario.placement,
        record=None if flight else folder / "run.mcap",
        flight=folder / "flight" if flight else None,
        live=scenario.live,
        rate=scenario.rate,
        storage=scenario.keeping.storage,
        faults=iter(scenario.faults) if scenario.faults and scenario.live else None,
        window=(scenario.window, 1 << 20),
        start_timeout=TIMEOUT,
        stall_timeout=TIMEOUT,
    )


def is_outrun(outcome: Outcome) -> bool:
    """Tells whether a run that was stopped was given up because its disk was busy all the time: only the recorder owed
    anything, and it wrote without a rest."""
    said = str(outcome.failure)
    owed = said.partition("not everything was drained within")[2].partition(", sources")[0].partition(": ")[2]
    return owed.startswith("@recorder was at") and ";" not in owed and outcome.disk_busy >= BUSY


# Files


def _holds_all(outcome: Outcome) -> bool:
    """Whether the files hold all that the recorder was given. A run that failed does not tell what found no room."""
    if outcome.report is None:
        return not (outcome.disk_full or "@recorder" in outcome.killed)
    facts = outcome.report.files.get("@recorder", {})
    return not (facts.get("lost") or facts.get("deleted") or "@recorder" in outcome.killed)


def _joined(scenario: Scenario, folder: Path, outcome: Outcome) -> Path:
    """The recording as one file; of its parts, `MOST_PARTS` at most, each is verified as far as it goes."""
    files = files_of(folder / "run.mcap")
    if len(files) < 2:
        return files[0] if files else folder / "run.mcap"
    lacks = not (_holds_all(outcome) and _has_sources(scenario.load()))
    for file in _some(files, scenario.seed):
        _unchanged(file, lacks=lacks)
    try:
        path = joined(files, folder / "joined.mcap")
    except RecordingError as error:
        if "nothing is in any" in str(error) and not (outcome.failure is None and _holds_all(outcome)):
            return folder / "joined.mcap"
        raise Violation(f"its parts cannot be joined: {error}") from error
    if outcome.report is not None and "@recorder" not in outcome.killed:
        deleted = outcome.report.files["@recorder"]["deleted"]
        if not deleted:
            check_losses_of_files(outcome.report, path, scenario.load().record.streams)
    return path


def _some(parts: Sequence[Path], seed: int) -> list[Path]:
    """The first and the last parts, and drawn ones between them: a run may have a hundred."""
    if len(parts) <= MOST_PARTS:
        return list(parts)
    drawn = random.Random(f"parts {seed}").sample(parts[1:-1], MOST_PARTS - 2)
    return [parts[0], *sorted(drawn), parts[-1]]


def _check_flight(outcome: Outcome, graph: Graph, folder: Path) -> str:
    """What a flight recorder has kept is what it was asked for, and re-executes as far as its states are known."""
    if outcome.failure is not None:
        files = sorted(folder.glob("*.mcap"))
        for file in files:
            _unchanged(file, lacks=True)
        if not files and not (outcome.failure.interrupted or outcome.disk_full or "@recorder" in outcome.killed):
            raise Violation(f"the run failed, and its end is not kept: {outcome.failure}")
        return "kept" if files else "nothing kept"
    assert outcome.report is not None
    kept = kept_by_flight(outcome.report, full=outcome.disk_full)
    for one in kept:
        _unchanged(Path(one["path"]), lacks=not _holds_all(outcome))
    facts = outcome.report.files["@recorder"]
    if outcome.report.restarts and not facts["kept"] and _holds_all(outcome):
        raise Violation(f"nothing is kept, though {', '.join(outcome.report.restarts)} failed and was started again")
    if _holds_all(outcome):
        check_reasons(outcome.flown, facts)
        check_spans(outcome.flown, graph, facts)
    return "kept" if kept else "nothing kept"


def _unchanged(path: Path, *, lacks: bool) -> None:
    """A part of a recording verifies without a difference; `lacks`: what was given is not all in it."""
    try:
        report = verified(path)
    except (ReplayError, RecordingError) as error:
        if lacks or "there is nothing to verify" in str(error):
            return
        raise Violation(f"{path.name} cannot be verified: {error}") from error
    if any(v.first is not None for v in report.operators) or report.changed:
        raise Violation(f"{path.name} is verified as different:\n{_explained(report)}")


def _check_completion(path: Path, out: Path, graph: Graph, outcome: Outcome) -> None:
    """A thin recording is completed to the streams of the run, but for those of sources that it leaves out, and for
    what a recorder lost that was killed."""
    report = outcome.report
    assert report is not None
    with bound({("dataflow.verification.complete", "call_workers"): _call_here}):
        made = complete(path, out, overwrite=True)
    if not made.whole:
        raise Violation(f"a thin recording cannot be completed: {made}")
    with Recording(out) as recording:
        stored = {name: stream.count for name, stream in recording.streams.items()}
    left_out = _sourced(graph) - set(graph.record.streams)
    expected = {stream: number for stream, (number, _) in report.streams.items() if stream not in left_out}
    lacking = [stream for stream, number in expected.items() if stored.get(stream, 0) != number]
    if lacking and not report.restarts and _holds_all(outcome):
        raise Violation(f"completed, a thin recording lacks messages of {', '.join(lacking)}")


def _check_pauses(outcome: Outcome) -> None:
    """A pause of the supervisor, alone or with others, is no evidence against any process."""
    blamed = [line for line in _notes(outcome) if "no longer waited for" in line or "started again" in line]
    if outcome.killed or blamed:
        raise Violation(f"a pause killed or blamed {sorted(outcome.killed)}: {'; '.join(blamed)}")


def _notes(outcome: Outcome) -> tuple[str, ...]:
    return () if outcome.report is None else outcome.report.notes


# Verification


def _verify(path: Path, outcome: Outcome, scenario: Scenario) -> str:
    """Verifies what was recorded. A run that failed may be cut, but what is there must be as it was."""
    if not path.exists():
        if outcome.failure is None and _holds_all(outcome):
            raise Violation("there is no recording")
        return "no recording"
    try:
        report = verified(path)
    except (ReplayError, RecordingError) as error:
        if outcome.failure is None and _has_sources(scenario.load()) and _holds_all(outcome):
            raise Violation(f"the recording cannot be verified: {error}") from error
        return "nothing to verify"
    if outcome.failure is None:
        if report.identical:
            return "identical"
        unchanged = all(report.verdict(v) in ("identical", "unverifiable") for v in report.operators)
        lacks = _missed_by_recorder(outcome.report) or not _holds_all(outcome) or not _has_sources(scenario.load())
        if unchanged and not report.changed and lacks:
            return "unverifiable"
        raise Violation(f"verified as different:\n{_explained(report)}")
    if any(v.first is not None for v in report.operators) or report.changed:
        raise Violation(f"of a failed run, verified as different:\n{_explained(report)}")
    if scenario.live and "@recorder" not in outcome.killed and not outcome.disk_full:
        lost = [v for v in report.operators if v.lost_records or v.after_cut]
        if lost:
            raise Violation(f"records of a live run are lost:\n{_explained(report)}")
    return "cut" if report.cut else "identical" if report.identical else "unverifiable"


def _has_sources(graph: Graph) -> bool:
    """Whether a recording has all that cannot be made again."""
    return _sourced(graph) <= set(graph.record.streams)


def _sourced(graph: Graph) -> set[str]:
    return {stream for stream, made in graph.streams.items() if graph.nodes[made.node].source}


def _missed_by_recorder(report: RunReport | None) -> int:
    """How many messages a link to the recorder has lost, as the run's report tells."""
    assert report is not None
    return sum(n for _, why, n in report.drops.get("@recorder", ()) if why == "missed")


def _explained(report: VerifyReport) -> str:
    lines = [f"  {report.verdict(v)}: {v.to_wire()}" for v in report.operators if report.verdict(v) != "identical"]
    lines += [f"  changed: {stream.to_wire()}" for stream in report.changed]
    lines += [f"  source: {each}" for each in report.stand_ins if not each.whole]
    return "\n".join(lines)


def _verify_from_middle(path: Path) -> None:
    """What verifies as a whole verifies from the states that operators had in the middle, too."""
    with Recording(path) as recording:
        source = recording.streams.get("sim/left/fast")
        begins = [
            s.first for s in recording.streams.values() if s.first is not None and not (s.static or "/@/" in s.name)
        ]
    first, last = min(begins, default=0), 0 if source is None or source.last is None else source.last
    if last > first:
        report = verified(path, start=(last - first) * 0.5e-9, jobs=2)
        if not report.identical:
            raise Violation(f"verified as different from the middle:\n{_explained(report)}")


def verified(path: Path, *, start: float | None = None, jobs: int = 1) -> VerifyReport:
    """Verifies in this process: the workers' functions are called, one after the other."""
    bindings = {
        ("dataflow.verification.facts", "machine_facts"): lambda environment: {"threads": {}},
        ("dataflow.graph", "load_bundle"): _load_bundle,
    }
    importlib.import_module("dataflow.verification.facts")
    if reloading.Files.revision:
        reloading.leave_files(path)
    with bound(bindings | reloading.bindings()):
        return verify(path, start=start, jobs=jobs, workers=_call_here)


@functools.lru_cache(maxsize=1024)
def _load_bundle(bundle: str) -> Graph:
    """The graph in a recording; the same ones come again and again."""
    with by_blocks():
        return load_bundle(bundle)


def _call_here(calls: Sequence[Call], **options: Any) -> list[Any]:
    answers = []
    for call in calls:
        module, _, name = call.function.partition(":")
        function = getattr(importlib.import_module(module), name)
        descriptor = os.memfd_create("board")
        try:
            answers.append(function(call.request, Board(descriptor, call.operators)))
        finally:
            os.close(descriptor)
    return answers


# Losses

Place = tuple[str, int, int]
"""Stream, incarnation and number of a message."""
Records = Mapping[str, Sequence[FiringRecord]]


def _records_of(path: Path, graph: Graph) -> Records:
    """The firing records of a recording, by operator."""
    with Recording(path) as recording:
        log = FiringLog.read(recording)
        return {name: log.of(name) for name in graph.nodes}


def _check_losses(records: Records, graph: Graph, report: RunReport, *, live: bool) -> int:
    """Every message that was made is taken by each trigger it reaches, or dropped or missed and counted."""
    counted = 0
    _check_stale(graph, records)
    for name, node in graph.nodes.items():
        if node.source or report.restarts.get(name):
            continue
        triggers = {port.name for port in node.spec.inputs.values() if port.kind != "sampled"}
        taken: set[Place] = set()
        drops: Counter[str] = Counter()
        unlisted = 0
        for record in records[name]:
            for value in record.inputs.values():
                taken |= {(m.stream, m.incarnation, m.seq) for m in messages_of(value)}
            for drop in record.drops:
                taken.add((drop.stream, drop.incarnation, drop.seq))
                drops[drop.reason] += 1
            unlisted += sum(number for _, _, number in record.detail.get("unlisted_drops", ()))
        counted += drops.total() + unlisted
        missed = sum(n for _, why, n in report.drops.get(name, ()) if why in ("missed", "reset"))
        last = max((record.stamp for record in records[name] if record.kind in ("fire", "tick")), default=None)
        over = any(record.kind == "finish" for record in records[name])
        for input_name in triggers:
            for stream in node.inputs.get(input_name, ()):
                made = _made(graph, records, stream, report)
                if over and node.spec.inputs[input_name].kind == "batch":  # what comes after its end is for nothing
                    made = {p: stamp for p, stamp in made.items() if not live and last is not None and stamp <= last}
                lost = made.keys() - taken
                if len(lost) > missed + unlisted:
                    raise Violation(
                        f"{name}.{input_name} lost {len(lost)} messages of {stream}, and {missed} are counted: "
                        f"{sorted(lost)[:5]}"
                    )
    return counted


def _check_stale(graph: Graph, records: Records) -> None:
    """What a dead producer has left is given to no call whose policy drops it."""
    for name, node in graph.nodes.items():
        dropping = {
            port.name
            for port in node.spec.inputs.values()
            if node.live.on_stale == "drop" and port.kind == "sampled" and not port.required
        }
        for record in records[name]:
            for port_name in dropping & record.stale:
                if record.inputs.get(port_name) is not None:
                    raise Violation(f"{name} was given a stale {port_name} at {record.stamp}, which it drops")


def _made(graph: Graph, records: Records, stream: str, report: RunReport) -> dict[Place, int]:
    """The messages of a stream with their stamps, by its maker's records; none of a static stream, or of a maker that
    was restarted."""
    made = graph.streams[stream]
    if made.static or report.restarts.get(made.node):
        return {}
    port = list(graph.nodes[made.node].outputs.values()).index(stream)
    outputs = ((r.incarnation, r.outputs[port]) for r in records[made.node] if port < len(r.outputs))
    return {(stream, life, m.seq): m.stamp for life, m in outputs if m is not None and m.seq >= 0}


# Flow control


def _check_window(records: Records, graph: Graph, scenario: Scenario, report: RunReport) -> None:
    """Sources were never further ahead of the operators than their window; it grew only where the graph needs it."""
    grown = any("further ahead than the window" in note for note in report.notes)
    if grown:
        if graph.name in NO_LOOK_AHEAD:
            raise Violation(f"the window of graph {graph.name!r} had to grow, which looks no stamp ahead")
        return
    worked = [
        (record.stamp, record.wall_start + record.duration)
        for name, node in graph.nodes.items()
        for record in records[name]
        if not node.source and record.kind in ("fire", "tick")
    ]
    for label, nodes in graph.processes(scenario.placement).items():
        given = sorted(
            (record.wall_start, record.stamp, sum(1 for made in record.outputs if made is not None))
            for name in nodes
            for record in records[name]
            if graph.nodes[name].source and record.kind == "fire"
        )
        for now, stamp, _ in given:
            undone = min((s for s, when in worked if when > now and s < stamp), default=stamp)
            ahead = sum(messages for when, s, messages in given if when < now and undone <= s < stamp)
            if ahead >= scenario.window + MOST_OF_A_STEP:
                raise Violation(f"{label}: {ahead} messages ahead of {undone}, with a window of {scenario.window}")


NO_LOOK_AHEAD = ("chain", "diamond")
"""Graphs whose operators can fire at each stamp as soon as it has come."""
MOST_OF_A_STEP = 2
"""Messages of one step, which is admitted whole."""


# Replays


def _may_replay(scenario: Scenario, report: RunReport) -> bool:
    """Whether a replay is to give the same: not of a run that was stopped, of one whose clock went back, or of which
    parameters were set, nor of a recording without a source's stream that an operator takes, if only an external one.

    Nor is one run whose timer would make up for a long silence: it makes more ticks than a simulated run has time for.
    """
    silent = any(happening.fields.get("span", 0) > PATIENCE for happening in scenario.happenings)
    if scenario.graph == TICKING and silent:
        return False
    graph = scenario.load()
    taken = {stream for node in graph.nodes.values() for stream in node.taken}
    if not taken & _sourced(graph) <= set(graph.record.streams):
        return False
    changed = any(happening.kind == "set" for happening in scenario.happenings)
    went_back = any(fault.kind == "jump" for fault in scenario.faults) or any("PAIR" in p for p in scenario.parts)
    return not (report.interrupted or changed or (scenario.live and went_back))


def _check_replay(scenario: Scenario, path: Path, report: RunReport) -> None:
    """A replay has the digests of the run; of a live run, those of another replay."""
    first = _replay(scenario, path, 1)
    expected = _replay(scenario, path, 2).streams if scenario.live else report.streams
    differing = [s for s, found in first.streams.items() if s in expected and expected[s] != found]
    if differing or not first.streams.keys() <= expected.keys():
        raise Violation(f"a replay differs in {', '.join(differing) or 'its streams'}")


def _replay(scenario: Scenario, path: Path, number: int) -> RunReport:
    graph = scenario.load()
    with Recording(path) as recording:
        log = plan_replay(recording, graph)
    placement: Any = "process_each" if (scenario.placement == "one_process") == (number == 1) else "one_process"
    plan = RunPlan(graph, placement=placement, log=log, window=(scenario.window, 1 << 20), stall_timeout=TIMEOUT)
    machine = replace(Machine(scenario.seed + 7919 * number), preempt=0.05)
    outcome = simulate(plan, machine, mode="replay", limit=scenario.limit)
    if outcome.report is None:
        raise Violation(f"a replay failed: {outcome.failure}\n{outcome.failure and outcome.failure.details}")
    return outcome.report
