"""Verification of a recording: every operator re-executed by its recorded firings, every output compared by digest."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from dataflow.graph.model import Graph
from dataflow.records.comparison import Verification
from dataflow.records.firing import CALLS
from dataflow.records.reading import beginning, whole
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.report import OperatorCounts
from dataflow.supervision.run import Watch
from dataflow.verification import part
from dataflow.verification.compare import OutputComparison
from dataflow.verification.letters import shared_records
from dataflow.verification.processes import Call, Locate, Workers, call_workers
from dataflow.verification.report import StandIn, VerifyReport
from dataflow.verification.stored import StoredStream
from dataflow.verification.task import Task, prepare


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
    task = prepare(path, graph, first, only, start, jobs)
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


def _locate(task: Task) -> Locate:
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
    task: Task, answers: Iterable[Mapping[str, Any]], tolerance: float | None, start: float | None
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


def _stand_in(task: Task, name: str, stored: Iterable[StoredStream]) -> StandIn:
    """The books of a stand-in, with what reading its messages has shown."""
    made = StandIn.of(name, task.ledger.accounts[name], ended=task.ledger.ended, torn=task.ledger.torn)
    read = [s for s in stored if s.maker == name]
    return replace(
        made,
        unaccounted=max(made.unaccounted, sum(s.uncalled for s in read)),
        missing=max(made.missing, sum(s.missing for s in read)),
    )


def _repeat(
    task: Task, report: VerifyReport, request: Mapping[str, Any], options: Mapping[str, Any], workers: Workers
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
