"""The report of a run that has ended in order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.supervision.core.report import RunReport
from dataflow.supervision.core.run_state import RunState
from dataflow.sync import FOREVER, NEVER


def report_of(run: RunState, ended_at: float, *, interrupted: bool) -> RunReport:
    """Returns the report of a run; `ended_at` is when everything was drained (steady s).

    One that was interrupted while starting has done nothing, for 0 s.
    """
    status = run.status
    reports = {p.label: p.report or {} for p in run.processes.values()}
    streams = {s: (n, d) for r in reports.values() for s, (n, d) in r.get("streams", {}).items()}
    reached = [c.done for c in status.operators.values() if c.done not in (NEVER, FOREVER)]
    return RunReport(
        graph=run.graph.name,
        streams=dict(sorted(streams.items())),
        operators=dict(status.operators),
        drops={
            node: tuple((i, why, n) for (i, why), n in sorted(status.drops[node].items()))
            for node in status.operators
            if status.drops.get(node)
        },
        summaries=summaries_of(run),
        transport={label: r["transport"] for label, r in reports.items() if "transport" in r},
        files={p.label: p.facts for p in run.processes.values() if p.is_sink},
        first=status.began if status.first is None else status.first,
        last=max(reached, default=None),
        wall=0.0 if run.release is None else ended_at - run.release.at.steady + run.paused,
        interrupted=interrupted,
        notes=tuple(status.notes),
        sources=tuple(node.name for node in run.graph.sources() if node.name in status.operators),
        restarts=dict(status.restarts),
        waits={
            node: tuple((i, what, n) for (i, what), n in sorted(found.items()))
            for node, found in status.waits.items()
            if found
        },
        namespace=run.graph.namespace,
    )


def summaries_of(run: RunState) -> dict[str, Mapping[str, Any]]:
    """Returns what operators summed up at their end, as far as their processes have told."""
    reports = [process.report or {} for process in run.processes.values()]
    return {node: found for report in reports for node, found in report.get("summaries", {}).items()}
