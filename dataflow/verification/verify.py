"""Verification of a recording: every operator re-executed by its recorded firings, every output compared by digest."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dataflow.firing.threads import environment
from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.facts import machine_facts
from dataflow.recording.layout import OUTCOME
from dataflow.records.comparison import Verification
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import FiringLog, beginning, whole
from dataflow.reexecution.engine import plan_feeding
from dataflow.reexecution.recorded_run import ReplayError, recorded_graph
from dataflow.supervision.report import OperatorCounts
from dataflow.supervision.run import Watch
from dataflow.verification import part, partition
from dataflow.verification.compare import OutputComparison
from dataflow.verification.ledger import COMPLETE, Ledger, incomplete_streams, read_ledger
from dataflow.verification.letters import shared_records
from dataflow.verification.processes import Call, Locate, Workers, call_workers
from dataflow.verification.report import StandIn, VerifyReport
from dataflow.verification.stored import StoredStream


@dataclass(frozen=True, slots=True)
class _Task:
    """Holds what is to be verified, and what the recording says of it: all that was read before any worker starts."""

    path: Path
    graph: Graph
    log: FiringLog
    ledger: Ledger
    operators: tuple[str, ...]
    stood_in: tuple[str, ...]
    stand_ins: tuple[str, ...]
    incomplete: frozenset[str]
    parts: tuple[partition.Part, ...]
    unchecked: tuple[str, ...]
    facts: tuple[tuple[str, str, str], ...]
    begin: int | None
    span: float
    torn: bool


def verify(
    path: Path,
    *,
    graph: Graph | None = None,
    first: str | None = None,
    only: str | None = None,
    tolerance: float | None = None,
    start: float | None = None,
    jobs: int | None = None,
    stall_timeout: float = 120.0,
    watch: Watch | None = None,
    workers: Workers | None = None,
) -> VerifyReport:
    """Re-executes a recording by its firing records and compares.

    `first`: verify that operator and what follows from it; `only`: that one alone. Every operator is fed from the
    recording; where its inputs were not recorded, or not wholly, those that made them run with it. Operators marked
    `external` are always taken from it. Stored messages are compared with the digests in the firing records, too.
    `tolerance`: absolute, in the unit of each floating-point field. Culprits are run a second time, to see whether they
    differ alike.
    `start` (seconds from the first message) begins in the middle: an operator takes up its last recorded state at or
    before that moment, one without state begins there, any other is repeated from its beginning.
    `jobs`: worker processes; by default one for each core that may be used, fewer where there is little to do.
    `stall_timeout`: seconds allowed without progress. `workers`: what makes the calls, instead of processes.
    Raises `ReplayError` when the recording does not hold what is needed, `RunFailed` when an operator cannot run.
    """
    began = time.monotonic()
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise ReplayError(f"tolerance {tolerance}: expected a finite number, 0 or more")
    if jobs is not None and jobs < 1:
        raise ReplayError(f"{jobs} jobs: expected 1 or more")
    workers = workers or call_workers
    task = _prepare(path, graph, first, only, start, jobs)
    options: dict[str, Any] = {"threads": task.graph.threads, "stall_timeout": stall_timeout, "watch": watch}
    with shared_records(task.log) as (descriptor, batches):
        options |= {"descriptors": (descriptor,), "locate": _locate(task)}
        request = {
            "path": str(path),
            "graph": task.graph.to_json(),
            "records": descriptor,
            "batches": batches,
            "begin": task.begin,
            "incomplete": sorted(task.incomplete),
            "tolerance": tolerance,
        }
        calls = [
            Call(
                f"{part.__name__}:{part.verify_part.__name__}",
                request | {"operators": list(one.operators), "checks": list(one.checks)},
                one.operators,
            )
            for one in task.parts
        ]
        answers = workers(calls, **options)
        report = _report(task, answers, tolerance, start)
        repeated = _repeat(task, report, request, options, workers)
    return replace(report, repeated=repeated, total=time.monotonic() - began)


def _prepare(
    path: Path, graph: Graph | None, first: str | None, only: str | None, start: float | None, jobs: int | None
) -> _Task:
    with Recording(path) as recording:
        played = graph or recorded_graph(recording)
        log = FiringLog.read(recording)
        told = [n for n in played.nodes if _accountable(recording, played, log, n)]
        incomplete = incomplete_streams(recording, played, log, told)
        held = recording.streams.keys() - incomplete
        chosen = _with_makers(held, played, _chosen(played, first, only))
        operators = tuple(name for name in played.nodes if name in chosen)
        require_records(recording, log, operators)
        require_ports(recording, played, log, operators)
        plan_feeding(recording, played, operators, incomplete=incomplete)
        feeding = {
            played.streams[s].node for name in chosen for taken in played.nodes[name].inputs.values() for s in taken
        } - chosen
        sources = set() if first or only else {node.name for node in played.nodes.values() if node.source}
        stand_ins = [n for n in played.nodes if n in feeding | sources and _accountable(recording, played, log, n)]
        checks, unchecked = _checks(recording, played, log, [*operators, *stand_ins])
        groups = partition.units(played, held, operators)
        work = {n: sum(r.duration + partition.PER_FIRING_NS for r in log.of(n)) for n in operators}
        jobs = jobs or partition.jobs_for(work, len(os.sched_getaffinity(0)))
        begin, last = _span(recording, start)
        return _Task(
            path=path,
            graph=played,
            log=log,
            ledger=read_ledger(recording, played, log, [*operators, *stand_ins]),
            operators=operators,
            stood_in=tuple(name for name in played.nodes if name in feeding),
            stand_ins=tuple(stand_ins),
            incomplete=incomplete,
            parts=tuple(partition.with_checks(played, partition.balanced(groups, work, jobs), checks)),
            unchecked=unchecked,
            facts=_differing_facts(recording.metadata, played),
            begin=None if start is None else begin,
            span=(last - begin) * 1e-9,
            torn=recording.torn,
        )


def _accountable(recording: Recording, graph: Graph, log: FiringLog, name: str) -> bool:
    """Tells whether the records of a node can be held against its streams.

    Not where another operator made them (with another graph), nor where a replay did of a stream whose clock had
    jumped: its records count one incarnation, its messages several.
    """
    node = graph.nodes[name]
    streams = [s for s in node.outputs.values() if s in recording.streams]
    makers = {recording.streams[s].metadata.get("operator", name) for s in streams}
    records = log.of(name)
    replayed = bool(records) and bool(records[0].detail.get("replayed"))
    jumped = any(len(recording.counts(s)) > 1 for s in streams)
    return makers == {name} and not (replayed and jumped) and _same_ports(records, node.outputs)


def _same_ports(records: Iterable[FiringRecord], outputs: Collection[str]) -> bool:
    record = next((r for r in records if r.outcome == "ok" and r.outputs), None)
    return record is None or len(record.outputs) == len(outputs)


def _checks(
    recording: Recording, graph: Graph, log: FiringLog, nodes: Iterable[str]
) -> tuple[list[str], tuple[str, ...]]:
    """The recorded streams of `nodes` that can be compared with their records, and those that cannot be read as the
    messages that they were."""
    able: list[str] = []
    unable: list[str] = []
    for name in nodes:
        if not log.of(name):
            continue
        for stream in graph.nodes[name].outputs.values():
            info = recording.streams.get(stream)
            if info is not None:
                (able if info.message_type is not None and not info.declared_otherwise else unable).append(stream)
    return able, tuple(unable)


def _locate(task: _Task) -> Locate:
    """Names the call that an operator is at, from the number of calls that it has repeated."""

    def located(operator: str, repeated: int) -> str:
        node = task.graph.nodes[operator]
        kept, _ = whole(task.log.of(operator))
        _, ahead, _ = beginning(kept, task.begin, stateless=node.operator.stateless)
        calls = [record for record in ahead if record.kind in CALLS]
        if repeated >= len(calls):
            return "its end"
        record = calls[repeated]
        return f"firing {record.index} ({record.kind}) at stamp {record.stamp}"

    return located


def _report(
    task: _Task, answers: Iterable[Mapping[str, Any]], tolerance: float | None, start: float | None
) -> VerifyReport:
    answers = list(answers)
    found = {v["operator"]: Verification.from_wire(v) for answer in answers for v in answer["operators"]}
    counts = {name: OperatorCounts(*values) for answer in answers for name, values in answer["work"].items()}
    stored = [StoredStream.from_wire(s) for answer in answers for s in answer["stored"]]
    operators = tuple(found[name] for name in task.operators)
    for verification in operators:
        task.ledger.enter(verification)
    nodes = task.graph.nodes
    return VerifyReport(
        operators=operators,
        stood_in=task.stood_in,
        facts=task.facts,
        messages=sum(v.outputs for v in operators),
        streams=sum(len(nodes[name].outputs) for name in task.operators),
        wall=max(answer["wall"] for answer in answers),
        span=task.span,
        stand_ins=tuple(_stand_in(task, name, stored) for name in task.stand_ins),
        stored=tuple(sorted(stored, key=lambda s: s.stream)),
        unchecked=task.unchecked,
        tolerance=tolerance,
        comparisons={
            name: OutputComparison.from_wire(values)
            for answer in answers
            for name, values in answer["comparisons"].items()
        },
        digests={s: (count, digest) for answer in answers for s, (count, digest) in answer["digests"].items()},
        outputs={name: tuple(nodes[name].outputs.values()) for name in task.operators},
        producers={
            name: frozenset(task.graph.streams[s].node for taken in nodes[name].inputs.values() for s in taken)
            for name in task.operators
        },
        start=start,
        torn=task.torn,
        work=counts,
    )


def _stand_in(task: _Task, name: str, stored: Iterable[StoredStream]) -> StandIn:
    """The books of a stand-in, with what reading its messages has shown."""
    made = StandIn.of(name, task.ledger.accounts[name], ended=task.ledger.ended, torn=task.ledger.torn)
    read = [s for s in stored if s.maker == name]
    return replace(
        made,
        unaccounted=max(made.unaccounted, sum(s.uncalled for s in read)),
        missing=max(made.missing, sum(s.missing for s in read)),
    )


def _repeat(
    task: _Task, report: VerifyReport, request: Mapping[str, Any], options: Mapping[str, Any], workers: Workers
) -> Mapping[str, bool]:
    """Runs the culprits once more, to the first difference of each: did they differ alike?"""
    culprits = report.culprits
    if not culprits:
        return {}
    calls = [
        Call(
            f"{part.__name__}:{part.repeat_part.__name__}",
            {**request, "operators": [name for name in one.operators if name in culprits]},
            one.operators,
        )
        for one in task.parts
        if not set(culprits).isdisjoint(one.operators)
    ]
    again = {name: first for answer in workers(calls, **options) for name, first in answer.items()}
    before = {v.operator: v.first for v in report.operators if v.first is not None}
    return {name: again[name] == [before[name].incarnation, before[name].index, before[name].got] for name in culprits}


def _span(recording: Recording, start: float | None) -> tuple[int, int]:
    """The stamp `start` seconds after the first message of the recording, and its last stamp."""
    spans = [s for s in recording.streams.values() if s.first is not None and not s.static and "/@/" not in s.name]
    first = min((s.first for s in spans if s.first is not None), default=0)
    last = max((s.last for s in spans if s.last is not None), default=0)
    begin = first + round((start or 0.0) * 1e9)
    if not first <= begin <= last:
        raise ReplayError(f"--start {start:g}: the recording is {(last - first) * 1e-9:.3g} s long")
    return begin, last


def require_records(recording: Recording, log: FiringLog, operators: Iterable[str]) -> None:
    """Raises `ReplayError` for the first operator without firing records."""
    outcome = recording.metadata.get(OUTCOME, {}).get("outcome", "")
    for name in operators:
        if log.batches(name):
            continue
        if recording.torn or outcome not in ("", COMPLETE):
            why = "the recording has no proper end" if recording.torn else f"it {outcome}"
            raise ReplayError(
                f"{recording.path}: the recorded run ended before operator {name!r} began ({why}): "
                "there is nothing to verify"
            )
        raise ReplayError(
            f"{recording.path}: operator {name!r} left no firing records there; "
            "name the graph that made the recording with --graph, or record with --record"
        )


def require_ports(recording: Recording, graph: Graph, log: FiringLog, operators: Iterable[str]) -> None:
    """Raises `ReplayError` for the first operator whose outputs are not those it was recorded with."""
    for name in operators:
        node = graph.nodes[name]
        if not _same_ports(log.of(name), node.outputs):
            recorded = next(len(r.outputs) for r in log.of(name) if r.outcome == "ok" and r.outputs)
            raise ReplayError(
                f"{recording.path}: operator {name!r} was recorded with {recorded} output ports and has "
                f"{len(node.outputs)} now ({', '.join(node.outputs)}), so its firings cannot be compared: verify with "
                f"the operator as it was, or record anew"
            )


def _chosen(graph: Graph, first: str | None, only: str | None) -> set[str]:
    """The operators to verify: all that are neither sources nor external, or those asked for."""
    able = {name for name, node in graph.nodes.items() if not node.source and not node.external}
    if not able:
        raise ReplayError(
            f"graph {graph.name!r} holds nothing to verify: all its operators ({', '.join(graph.nodes)}) are sources "
            "or external, whose recorded output is taken as it is; name a graph with further operators with --graph"
        )
    for asked in (first, only):
        if asked is not None and asked not in able:
            raise ReplayError(
                f"{asked!r} cannot be verified: it is "
                + ("a source or external" if asked in graph.nodes else "no operator of the graph")
                + f"; those that can: {', '.join(sorted(able))}"
            )
    if only is not None:
        return {only}
    if first is None:
        return able
    following, edges = {first}, list(graph.edges())
    while new := {e.consumer for e in edges if e.producer in following} - following:
        following |= new
    return following & able


def _with_makers(held: Collection[str], graph: Graph, chosen: set[str]) -> set[str]:
    """The operators with those that make what they take, as far as it is not held in the recording."""
    wanted, left = set(chosen), list(chosen)
    while left:
        for stream in {s for taken in graph.nodes[left.pop()].inputs.values() for s in taken}:
            maker = graph.nodes[graph.streams[stream].node]
            if stream not in held and not (maker.source or maker.external or maker.name in wanted):
                wanted.add(maker.name)
                left.append(maker.name)
    return wanted


def _differing_facts(metadata: Mapping[str, Mapping[str, str]], graph: Graph) -> tuple[tuple[str, str, str], ...]:
    """Facts of the machine, packages, threads and devices that are not as when the recording was made."""
    here = machine_facts(environment(graph.threads))
    here["threads"] = {name: value for name, value in here["threads"].items() if name in metadata.get("threads", {})}
    facts = [
        (f"{group} {name}", metadata[group].get(name, "–"), here[group].get(name, "–"))
        for group in sorted(here.keys() & metadata.keys())
        for name in sorted(here[group].keys() | metadata[group].keys())
        if metadata[group].get(name) != here[group].get(name)
    ]
    threads = metadata.get("dataflow:run", {}).get("threads", str(graph.threads))
    if threads != str(graph.threads):
        facts.append(("graph threads", threads, str(graph.threads)))
    return tuple(facts)
