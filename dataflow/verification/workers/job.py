"""The work of one verification worker: operators re-executed and compared, stored messages checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from dataflow.execution.memory import MemoryGuard
from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.records.comparison import Verification
from dataflow.records.reading import FiringLog
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.sync import Entry
from dataflow.verification.compare import Comparer
from dataflow.verification.stored import StoredCheck
from dataflow.verification.workers.board import Board


def verify_part(request: Mapping[str, Any], board: Board) -> dict[str, Any]:
    """Re-executes the operators of one part. Runs in a worker.

    The request: `path`, `graph` (JSON), `operators`, `checks` (recorded streams to compare with their records),
    `incomplete` (recorded streams to be made again), `records` (see `FiringLog.to_wire`), `begin` (stamp, or None),
    `tolerance`, `slices` (by operator the stamps between which its calls are made), `until` (by operator a first
    difference, as `retrial.First`, or None: once each has differed, and not first so, the rest is left), `guard` (watch
    over messages in every call), `make_effects` (make them again), `in_turn` (operators called in the run's order).
    The answer: by operator `operators` (verifications), `comparisons`, `work` (see `OperatorCounts`); `digests` by
    stream, `stored`, CPU time of `reading` (ns), `wall` in seconds without set-up; `slices`: those of each operator;
    `reached`: see `MemoryGuard`.
    """
    graph = Graph.from_json(request["graph"])
    with Recording(request["path"], watch=board.goes_on) as recording:
        feeding = plan_feeding(recording, graph, request["operators"], incomplete=request["incomplete"])
        feeding = feeding.reading(request["checks"])
        log = FiringLog.from_wire(request["records"], recording)
        tolerance: float | None = request["tolerance"]
        comparer = Comparer(recording, graph, feeding.operators, tolerance, lambda name: work.runners[name].record)
        checks, slices = _checks(recording, graph, log, request), request["slices"]

        def read(stream: str, entry: Entry) -> None:
            if stream in checks:
                checks[stream].take((entry.incarnation, entry.seq), entry.digest)

        guard = MemoryGuard(keeping=True) if request["guard"] else None
        work = Recomputation(
            recording,
            graph,
            feeding,
            log,
            made=comparer.made,
            read=read,
            guard=guard,
            watcher=board,
            **{option: request[option] for option in ("begin", "slices", "make_effects", "in_turn")},
        )
        until = [(work.runners[name].result, first) for name, first in request["until"].items()]
        results = work.run(until=lambda: bool(until) and all(_differs(*one) for one in until))
        compared = comparer.close(results).items()
        stored = [check.result().to_wire() for check in checks.values()]
    counts = {
        name: [r.firings, r.ports.emitted, 0, r.work.cpu_ns, r.done, r.work.wall_ns] for name, r in work.runners.items()
    }
    return {
        "operators": {name: result.to_wire() for name, result in results.items() if name not in slices},
        "slices": {name: {"operator": results[name].to_wire(), "work": counts[name]} for name in slices},
        "comparisons": {name: asdict(comparison) for name, comparison in compared if name not in slices},
        "stored": stored,
        "digests": {
            state.stream: [state.digest.count, state.digest.hexdigest()]
            for name, runner in work.runners.items()
            if name not in slices
            for state in runner.ports.states.values()
        },
        "work": {name: values for name, values in counts.items() if name not in slices},
        "reading": work.reading_cpu_ns,
        "wall": work.wall,
        "reached": guard.reached if guard else {},
    }


def _differs(result: Verification, first: Sequence[Any] | None) -> bool:
    """Returns whether an operator has differed, and first otherwise than `first`."""
    found = result.first
    return found is not None and (first is None or tuple(first) != (found.incarnation, found.index, found.got))


def _checks(recording: Recording, graph: Graph, log: FiringLog, request: Mapping[str, Any]) -> dict[str, StoredCheck]:
    return {
        stream: StoredCheck(
            stream,
            graph.streams[stream].node,
            partial(log.emissions, graph.nodes[graph.streams[stream].node], stream),
            static=recording.streams[stream].static,
            whole=request["begin"] is None,
        )
        for stream in request["checks"]
    }
