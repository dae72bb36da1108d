"""Verification of a recording: every operator re-executed by its recorded firings, every output compared by digest."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from dataflow.graph.model import Graph
from dataflow.graph.reach import with_makers
from dataflow.recording import Recording
from dataflow.recording.layout import RECOVERED
from dataflow.recording.streams.cutting import cut_of
from dataflow.records.comparison import Verification
from dataflow.records.firing import CALLS
from dataflow.records.reading import FiringLog
from dataflow.records.repetition import Repetition, look_at
from dataflow.records.window import records_from
from dataflow.reexecution.engine import plan_feeding
from dataflow.reexecution.recorded_run import ReplayError, final_stamps, graph_that_is_here, processes_of
from dataflow.supervision.core.report import OperatorCounts, Watch
from dataflow.verification.choice import (
    accountable,
    chosen_operators,
    env_of,
    require_ports,
    require_records,
    stored_checks,
    unfed_operators,
    without_environments,
)
from dataflow.verification.compare import OutputComparison
from dataflow.verification.facts import changes_of, differing_facts
from dataflow.verification.ledger import Ledger, incomplete_streams, read_ledger
from dataflow.verification.record_totals import GraphRecordTotals
from dataflow.verification.report import StandIn, VerifyReport
from dataflow.verification.retrial import Retrial, Trial, mates_of, retry
from dataflow.verification.stored import StoredStream
from dataflow.verification.workers import partition, slices
from dataflow.verification.workers.job import verify_part
from dataflow.verification.workers.prestart import EarlyWorkers
from dataflow.verification.workers.processes import Call, Locate, Workers, call_workers

Attempt = Callable[[Iterable[tuple[Mapping[str, Any], tuple[str, ...]]]], list[Any]]
"""Answers (what is special of a request, operators), as `verify_part` does."""


@dataclass(frozen=True, slots=True)
class _Task:
    """Holds what is to be verified, with its data from the recording: all that was read before any worker starts.

    `records`: see `FiringLog.to_wire`; `unfed`: operators that cannot be repeated, by the stream that they need and the
    recording does not hold; `placed`: the process in which each ran.
    """

    path: Path
    graph: Graph
    records: Mapping[str, Any]
    books: GraphRecordTotals
    ledger: Ledger
    operators: tuple[str, ...]
    stood_in: tuple[str, ...]
    stand_ins: tuple[str, ...]
    incomplete: frozenset[str]
    held: frozenset[str]
    parts: tuple[partition.Job, ...]
    unchecked: tuple[str, ...]
    facts: tuple[tuple[str, str, str], ...]
    begin: int | None
    span: float
    unfed: Mapping[str, str]
    torn: bool
    placed: Mapping[str, str]
    absent: Mapping[str, str]
    changes: Mapping[str, tuple[str, ...]]


def verify(
    path: Path,
    *,
    graph: Graph | None = None,
    first: str | None = None,
    only: Collection[str] | None = None,
    tolerance: float | None = None,
    start: float | None = None,
    jobs: int | None = None,
    paranoid: bool = False,
    make_effects: bool = False,
    stall_timeout: float = 120.0,
    watch: Watch | None = None,
    workers: Workers | None = None,
    early: EarlyWorkers | None = None,
) -> VerifyReport:
    """Re-executes a recording by its firing records and compares.

    `first`: verify that operator and what follows from it; `only`: those alone. Every operator is fed from the
    recording; where its inputs were not recorded, or not wholly, those that made them run with it. Operators marked
    `external` are always taken from it. Stored messages are compared with the digests in the firing records, too.
    `tolerance`: absolute, in the unit of each floating-point field. Culprits are run a second time, beside those with
    which they shared a process in the run (`verification.retrial`).
    `paranoid`: look after each call whether it has written into its inputs; else after the first few of each operator.
    `make_effects`: make effects again, and compare their answers with the recorded ones, which operators get.
    `start` (seconds from the first message) begins in the middle: an operator takes up its last recorded state at or
    before that moment, one without state begins there, any other is repeated from its beginning.
    `jobs`: worker processes; by default one for each core that may be used, fewer where there is little to do.
    `stall_timeout`: seconds allowed without progress. `workers`: what makes the calls, instead of processes;
    `early`: processes that wait for calls already.
    Raises `ReplayError` when the recording does not hold what is needed, `RunFailed` when an operator cannot run.
    """
    began = time.monotonic()
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise ReplayError(f"tolerance {tolerance}: expected a finite number, 0 or more")
    if jobs is not None and jobs < 1:
        raise ReplayError(f"{jobs} jobs: expected 1 or more")
    workers = workers or call_workers
    task = _prepare(path, graph, first, only, start, jobs, early)
    played = task.graph
    options: dict[str, Any] = {"threads": played.threads, "stall_timeout": stall_timeout, "watch": watch}
    options |= {"early": early, "locate": _locate(task)}
    request = _request(task, path, tolerance, paranoid=paranoid, make_effects=make_effects)

    def attempt(calls: Iterable[tuple[Mapping[str, Any], tuple[str, ...]]]) -> list[Any]:
        function = f"{verify_part.__module__}:{verify_part.__name__}"
        asked = [({**request, **more, "operators": list(names)}, names) for more, names in calls]
        return workers([Call(function, *each, env=env_of(played, each[1], task.held)) for each in asked], **options)

    answers = attempt((one.request(), one.operators) for one in task.parts)
    divided, left = slices.answer(task.books, answers)
    if envs := dict.fromkeys(played.nodes[name].env for name in task.operators if name in left):
        answers += attempt([({}, _in(env, played, left, task.operators, task.held)) for env in envs])
    answers.append(divided)
    report = _report(task, answers, tolerance, start, Retrial())
    if report.culprits:
        differing = [v.operator for v in report.operators if v.operator in report.culprits and v.first is not None]
        retrial = _retry(task, differing, answers, attempt)
        report = _report(task, answers, tolerance, start, retrial)
    return replace(report, total=time.monotonic() - began)


def _request(task: _Task, path: Path, tolerance: float | None, *, paranoid: bool, make_effects: bool) -> dict[str, Any]:
    """Returns what each worker is asked (`job.verify_part`), but for its operators."""
    return {
        "path": str(path),
        "graph": task.graph.to_json(),
        "records": task.records,
        "begin": task.begin,
        "incomplete": sorted(task.incomplete),
        "tolerance": tolerance,
        "checks": [],
        "slices": {},
        "until": {},
        "guard": paranoid,
        "in_turn": (),
        "make_effects": make_effects,
    }


def _prepare(
    path: Path,
    graph: Graph | None,
    first: str | None,
    only: Collection[str] | None,
    start: float | None,
    jobs: int | None,
    early: EarlyWorkers | None,
) -> _Task:
    with Recording(path) as recording:
        played, absent = (graph, dict[str, str]()) if graph is not None else _graph_here(recording)
        if gone := [name for name in [first, *(only or ())] if name in absent]:
            raise ReplayError(f"{gone[0]!r} cannot be verified: it is not here: {absent[gone[0]]}")
        if early is not None:
            wanted = with_makers(recording.streams.keys(), played, chosen_operators(played, first, only))
            early.foresee({played.nodes[name].use.partition(":")[0] for name in wanted})
        log = _read_records(recording, played, start)
        books = GraphRecordTotals(log, played)
        told = [n for n in played.nodes if accountable(recording, played, books, n)]
        incomplete = incomplete_streams(recording, played, books, told)
        held = recording.streams.keys() - incomplete
        chosen = with_makers(held, played, chosen_operators(played, first, only))
        unfed = {} if first or only else unfed_operators(recording, played, chosen, incomplete)
        if unfed.keys() >= chosen:
            env_of(played, plan_feeding(recording, played, sorted(chosen), incomplete=incomplete).operators, held)
        chosen -= unfed.keys()
        operators = tuple(name for name in played.nodes if name in chosen)
        require_records(recording, books.operators, operators)
        require_ports(recording, played, books, operators)
        plan_feeding(recording, played, operators, incomplete=incomplete)
        final_stamps(recording, recording.streams)  # raises where an end cannot be read
        feeding = {played.streams[s].node for name in chosen for s in played.nodes[name].taken} - chosen
        sources = set() if first or only else {node.name for node in played.nodes.values() if node.source}
        stand_ins = [n for n in played.nodes if n in feeding | sources and accountable(recording, played, books, n)]
        checks, unchecked = stored_checks(recording, played, books, [*operators, *stand_ins])
        parts = _parts(played, log, books, operators, held=held, jobs=jobs, divide=start is None)
        begin, last = _span(recording, start)
        return _Task(
            path=path,
            graph=played,
            records=log.to_wire(),
            books=books,
            ledger=read_ledger(recording, played, books, [*operators, *stand_ins]),
            operators=operators,
            stood_in=tuple(name for name in played.nodes if name in feeding),
            stand_ins=tuple(stand_ins),
            incomplete=incomplete,
            held=frozenset(held),
            parts=tuple(partition.with_checks(played, parts, checks)),
            unchecked=unchecked,
            facts=differing_facts(recording.metadata, played),
            begin=None if start is None else begin,
            span=(last - begin) * 1e-9,
            unfed=unfed,
            torn=recording.torn or RECOVERED in recording.metadata,
            placed=_placed(recording, played),
            absent=absent,
            changes={} if graph is None else changes_of(recording, graph),
        )


def _placed(recording: Recording, graph: Graph) -> dict[str, str]:
    """Returns, by operator, the process in which it ran, with its environment."""
    nodes = graph.nodes
    return {n: f"{at} {nodes[n].env or ''}" for n, at in processes_of(recording).items() if n in nodes}


def _graph_here(recording: Recording) -> tuple[Graph, dict[str, str]]:
    """Returns the graph that made the recording, and why operators are not here: their code, or their environment."""
    graph, absent = graph_that_is_here(recording)
    graph, elsewhere = without_environments(graph)
    return graph, {**absent, **elsewhere}


def _parts(
    graph: Graph,
    log: FiringLog,
    books: GraphRecordTotals,
    operators: Sequence[str],
    *,
    held: Collection[str],
    jobs: int | None,
    divide: bool,
) -> list[partition.Job]:
    """Returns the parts of the operators of each environment by itself: jobs and cores are divided among these."""
    envs = dict.fromkeys(graph.nodes[name].env for name in operators)
    options: dict[str, Any] = {"held": held, "divide": divide, "jobs": jobs and max(1, jobs // len(envs))}
    options["cores"] = max(1, len(os.sched_getaffinity(0)) // len(envs))
    return [
        part
        for env in envs
        for part in partition.planned(graph, log, books, _in(env, graph, operators, operators, held), **options)
    ]


def _in(
    env: str | None, graph: Graph, wanted: Iterable[str], operators: Iterable[str], held: Collection[str]
) -> tuple[str, ...]:
    """Returns those `wanted` of an environment, and the `operators` that make what these take and is not `held`."""
    chosen = with_makers(held, graph, {name for name in wanted if graph.nodes[name].env == env})
    return tuple(name for name in operators if name in chosen)


def _read_records(recording: Recording, graph: Graph, start: float | None) -> FiringLog:
    if start is None:
        return FiringLog.read(recording)
    again = [node for node in graph.nodes.values() if not node.source and not node.external]
    return records_from(
        recording,
        graph.nodes.values(),
        _span(recording, start)[0],
        stateless={node.name for node in again if node.operator.stateless},
        stateful={node.name for node in again if not node.operator.stateless},
    )


def _locate(task: _Task) -> Locate:
    """Names the call that an operator is at, from the number of calls that it has repeated."""

    def located(call: Call, operator: str, repeated: int) -> str:
        node = task.graph.nodes[operator]
        begin, _ = call.request["slices"].get(operator, (task.begin, None))
        with Recording(task.path) as recording:
            log, whole = FiringLog.from_wire(task.records, recording), FiringLog.read(recording)
            ahead = Repetition(partial(log.ordered, node), begin=begin, stateless=node.operator.stateless)
            look_at([ahead])
            record = next(islice((r for r in ahead if r.kind in CALLS), repeated, None), None)
            if record is None:
                return "its end"
            number = whole.call_at(node, (record.incarnation, record.index))
        return f"call {number} ({record.kind}) at stamp {record.stamp}"

    return located


def _report(
    task: _Task, answers: Sequence[Mapping[str, Any]], tolerance: float | None, start: float | None, retrial: Retrial
) -> VerifyReport:
    of = {**_answer_of_each(answers), **retrial.instead}
    found = {name: Verification.from_wire(answer["operators"][name]) for name, answer in of.items()}
    stored = [StoredStream.from_wire(s) for answer in answers for s in answer["stored"]]
    for name in task.operators:
        task.ledger.enter(found[name])
        retrial.enter(found[name])
    for name, stream in task.unfed.items():
        calls = task.books.of(name).calls
        found[name] = Verification(name, firings=calls, unverifiable=max(calls, 1), missing=stream)
    comparisons = {
        name: OutputComparison.from_wire(answer["comparisons"][name])
        for name, answer in of.items()
        if name in answer["comparisons"]
    }
    _count_calls(task, found, comparisons)
    operators = tuple(found[name] for name in task.graph.nodes if name in found)
    nodes = task.graph.nodes
    return VerifyReport(
        operators=operators,
        stood_in=task.stood_in,
        facts=task.facts,
        messages=sum(v.outputs for v in operators),
        streams=sum(len(nodes[name].outputs) for name in task.operators),
        wall=max(answer["wall"] for answer in answers),
        reading=max(answer["reading"] for answer in answers) * 1e-9,
        span=task.span,
        stand_ins=tuple(_stand_in(task, name, stored) for name in task.stand_ins),
        stored=tuple(sorted(stored, key=lambda s: s.stream)),
        unchecked=task.unchecked,
        tolerance=tolerance,
        comparisons=comparisons,
        digests={
            stream: tuple(answer["digests"][stream])
            for name, answer in of.items()
            for stream in nodes[name].outputs.values()
            if stream in answer["digests"]
        },
        outputs={name: tuple(nodes[name].outputs.values()) for name in task.operators},
        producers={name: frozenset(task.graph.streams[s].node for s in nodes[name].taken) for name in task.operators},
        start=start,
        torn=task.torn,
        part=task.ledger.part,
        work={name: OperatorCounts(*answer["work"][name]) for name, answer in of.items()},
        absent=task.absent,
        changes=task.changes,
        repeated=retrial.repeated,
        shared=retrial.shared,
        overwritten=retrial.overwritten,
        mates=_mates(task),
    )


def _mates(task: _Task) -> dict[str, tuple[str, ...]]:
    """Returns the operators beside which each ran in its process, whether or not they are verified."""
    mates = mates_of(task.placed, [name for name, node in task.graph.nodes.items() if not node.source])
    return {name: tuple(sorted(mates[name] - {name})) for name in task.operators}


def _count_calls(task: _Task, found: Mapping[str, Verification], comparisons: Mapping[str, OutputComparison]) -> None:
    """Gives first differences the number of their call."""
    with Recording(task.path) as recording:
        log = FiringLog.read(recording)
        for name, verification in found.items():
            node, first = task.graph.nodes[name], verification.first
            if first is not None:
                verification.first = replace(first, call=log.call_at(node, (first.incarnation, first.index)))
            if name in comparisons:
                outputs = comparisons[name].first
                outputs[:] = [replace(o, call=log.call_at(node, (o.incarnation, o.index))) for o in outputs]


def _answer_of_each(answers: Sequence[Mapping[str, Any]]) -> Mapping[str, Mapping[str, Any]]:
    """Returns, by operator, the answer about it: of those of several workers the first in which it differs, if any."""
    of: dict[str, Mapping[str, Any]] = {}
    for answer in answers:
        for name, verification in answer["operators"].items():
            if name not in of or (of[name]["operators"][name]["first"] is None and verification["first"] is not None):
                of[name] = answer
    return of


def _stand_in(task: _Task, name: str, stored: Iterable[StoredStream]) -> StandIn:
    """The books of a stand-in, with what reading its messages has shown."""
    made, read = StandIn.of(name, task.ledger), [s for s in stored if s.maker == name]
    unaccounted = max(made.unaccounted, sum(s.uncalled for s in read))
    return replace(made, unaccounted=unaccounted, missing=max(made.missing, sum(s.missing for s in read)))


def _retry(task: _Task, culprits: Iterable[str], answers: Sequence[Mapping[str, Any]], attempt: Attempt) -> Retrial:
    """Tries culprits again, as many at a time as there were workers."""

    def tried(trials: Sequence[Trial]) -> list[Any]:
        calls = []
        for trial in trials:
            made = {s for n in trial.operators for s in task.graph.nodes[n].outputs.values()} if trial.wired else set()
            chosen = with_makers(task.held - made, task.graph, set(trial.operators))
            operators = tuple(name for name in task.operators if name in chosen)
            incomplete = sorted(task.incomplete.union(made))
            asked = {"until": dict(trial.asked), "incomplete": incomplete, "guard": True}
            calls.append(({**asked, "in_turn": sorted(trial.operators) if trial.wired else ()}, operators))
        at_once = len(task.parts)
        return [answer for k in range(0, len(calls), at_once) for answer in attempt(calls[k : k + at_once])]

    return retry(culprits, _answer_of_each(answers), mates_of(task.placed, task.operators), tried)


def _span(recording: Recording, start: float | None) -> tuple[int, int]:
    """The stamp `start` seconds after the first message of the recording (or of what was cut out), and its last one."""
    spans = [s for s in recording.streams.values() if s.first is not None and not s.static and "/@/" not in s.name]
    first = min((s.first for s in spans if s.first is not None), default=0)
    last = max((s.last for s in spans if s.last is not None), default=0)
    part = cut_of(recording.metadata)
    if part is not None:
        first = first if part.start is None else part.start
        last = last if part.end is None else min(last, part.end)
    begin = first + round((start or 0.0) * 1e9)
    if start is None and last < first:
        raise ReplayError(f"{recording.path}: it has no message from the stamp {first} on: there is nothing to verify")
    if not first <= begin <= last:
        raise ReplayError(f"--start {start:g}: the recording is {(last - first) * 1e-9:.3g} s long")
    return begin, last
