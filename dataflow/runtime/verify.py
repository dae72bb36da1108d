"""Verification of a recording: every operator re-executed by its recorded firings, every output compared by digest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.facts import machine_facts
from dataflow.runtime.execute import Watch, execute
from dataflow.runtime.plan import RunPlan
from dataflow.runtime.reexecute import Verification, recorded_firings
from dataflow.runtime.replay import ReplayError, plan_replay, recorded_graph


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """What verification came to.

    `stood_in` are the operators whose recorded streams were used instead; `facts` what differs between the machine that
    recorded and this one: (fact, then, now); `wall` is in seconds, `span` seconds of event time.
    """

    operators: tuple[Verification, ...]
    stood_in: tuple[str, ...]
    facts: tuple[tuple[str, str, str], ...]
    messages: int
    streams: int
    wall: float
    span: float

    @property
    def identical(self) -> bool:
        """True only when every recorded firing was repeated and every output was the same."""
        return all(v.verdict == "identical" for v in self.operators)

    @property
    def culprits(self) -> tuple[str, ...]:
        return tuple(v.operator for v in self.operators if v.verdict == "culprit")

    def as_json(self) -> dict[str, Any]:
        return {
            "identical": self.identical,
            "culprits": list(self.culprits),
            "messages": self.messages,
            "streams": self.streams,
            "wall_s": self.wall,
            "real_time_factor": self.span / self.wall if self.wall else None,
            "operators": [v.to_wire() | {"verdict": v.verdict} for v in self.operators],
            "stood_in": list(self.stood_in),
            "differing_facts": [{"fact": f, "recorded": a, "here": b} for f, a, b in self.facts],
        }


def verify(
    path: Path,
    *,
    graph: Graph | None = None,
    first: str | None = None,
    only: str | None = None,
    watch: Watch | None = None,
    **options: Any,
) -> VerifyReport:
    """Re-executes a recording by its firing records and compares.

    `first`: verify that operator and what follows from it; `only`: that one alone. What feeds them is then taken from
    the recording. Operators marked `external` always are. Further options are the fields of `RunPlan`.
    Raises `ReplayError` when the recording does not hold what is needed, `RunFailed` when an operator cannot run.
    """
    with Recording(path) as recording:
        played = graph or recorded_graph(recording)
        chosen = _chosen(played, first, only)
        unrecorded = [name for name in sorted(chosen) if next(recorded_firings(recording, name), None) is None]
        if unrecorded:
            raise ReplayError(
                f"{path}: operator {unrecorded[0]!r} left no firing records there; "
                "name the graph that made the recording with --graph, or record with --record"
            )
        feeding = {
            played.streams[s].node for name in chosen for taken in played.nodes[name].inputs.values() for s in taken
        } - chosen
        log = plan_replay(recording, played, replaced=feeding)
        facts = _differing_facts(recording.metadata)
    report = execute(RunPlan(played, log=log, verify=frozenset(chosen), **options), mode="verify", watch=watch)
    found = {v["operator"]: Verification.from_wire(v) for v in report.verifications}
    compared = [found[name] for name in played.nodes if name in found]
    span = 0.0 if report.first is None or report.last is None else (report.last - report.first) * 1e-9
    return VerifyReport(
        operators=tuple(compared),
        stood_in=tuple(name for name in played.nodes if name in feeding),
        facts=facts,
        messages=sum(v.outputs for v in compared),
        streams=sum(len(played.nodes[v.operator].outputs) for v in compared),
        wall=report.wall,
        span=span,
    )


def _chosen(graph: Graph, first: str | None, only: str | None) -> set[str]:
    """The operators to verify: all that are neither sources nor external, or those asked for."""
    able = {name for name, node in graph.nodes.items() if not node.source and not node.external}
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


def _differing_facts(metadata: Mapping[str, Mapping[str, str]]) -> tuple[tuple[str, str, str], ...]:
    """Facts of the machine, packages and threads that are not as when the recording was made."""
    here = machine_facts()
    return tuple(
        (f"{group} {name}", metadata[group].get(name, "–"), here[group].get(name, "–"))
        for group in sorted(here.keys() & metadata.keys())
        if group != "threads"
        for name in sorted(here[group].keys() | metadata[group].keys())
        if metadata[group].get(name) != here[group].get(name)
    )
