"""Preparation of a verification: which operators, fed from what, compared with which records, divided how."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from dataflow.firing.threads import environment
from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.facts import machine_facts
from dataflow.recording.layout import OUTCOME
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.reexecution.engine import plan_feeding
from dataflow.reexecution.recorded_run import ReplayError, recorded_graph
from dataflow.verification import partition
from dataflow.verification.ledger import COMPLETE, Ledger, incomplete_streams, read_ledger


@dataclass(frozen=True, slots=True)
class Task:
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


def prepare(
    path: Path, graph: Graph | None, first: str | None, only: str | None, start: float | None, jobs: int | None
) -> Task:
    """Reads what is asked for, and divides it. Raises `ReplayError` when the recording does not hold what is needed."""
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
        return Task(
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
