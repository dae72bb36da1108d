"""Verification that begins in the middle of a recording, from the snapshots of operators' states that it holds."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.records.comparison import Verification
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.sync import Entry
from dataflow.verification.worker import Tell, apart


def verify_from(
    path: Path, graph: Graph, operators: Collection[str], begin: int, *, told: Tell | None = None
) -> tuple[list[Verification], float]:
    """Re-executes operators from the stamp `begin` (ns) on, fed by the recording; and the seconds it took.

    An operator takes up its last recorded state at or before `begin`; one that has no state begins there; any other is
    repeated from its beginning, and its result says so. What makes streams that were not recorded is repeated too, as
    far back as needed. In a process of its own.
    Raises `ReplayError` where a source's stream was not recorded, `RunFailed` when an operator cannot run.
    """
    with Recording(path) as recording:
        plan_feeding(recording, graph, operators)
    request = {"path": str(path), "graph": graph.to_json(), "operators": sorted(operators), "begin": begin}
    answer = apart(f"{__name__}:answer", request, threads=graph.threads, told=told)
    found = {v["operator"]: Verification.from_wire(v) for v in answer["operators"]}
    return [found[name] for name in graph.nodes if name in operators], answer["wall"]


def answer(request: Mapping[str, Any], tell: Tell) -> dict[str, Any]:
    """`verify_from`, in the process that does it."""
    import time

    graph = Graph.from_json(request["graph"])
    made = 0

    def count(stream: str, entry: Entry) -> None:
        nonlocal made
        made += 1
        tell({"messages": made})

    with Recording(request["path"]) as recording:
        feeding = plan_feeding(recording, graph, request["operators"])
        work = Recomputation(recording, graph, feeding, made=count, begin=request["begin"])
        started = time.monotonic()
        results = work.run()
        return {"operators": [v.to_wire() for v in results.values()], "wall": time.monotonic() - started}
