"""Verification of a recording: every operator re-executed by its recorded firings, every output compared by digest."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from dataflow.firing.threads import environment
from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.facts import machine_facts
from dataflow.records.comparison import Verification
from dataflow.reexecution.recorded import recorded_firings
from dataflow.reexecution.recorded_run import ReplayError, graph_as_recorded, isolated
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.replay import plan_replay
from dataflow.supervision.report import OperatorCounts, RunFailed
from dataflow.supervision.run import Watch, execute
from dataflow.verification.compare import OutputComparison, compare_outputs
from dataflow.verification.later_start import verify_from
from dataflow.verification.ledger import read_ledger

Verdict = Literal["identical", "within tolerance", "culprit", "downstream", "unverifiable"]


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """What verification came to.

    `stood_in` are the operators whose recorded streams were used instead; `facts` what differs between the machine that
    recorded and this one: (fact, then, now); `wall` is in seconds, `span` seconds of event time.
    `comparisons` hold, for culprits (with a `tolerance`: for all that differ), how their messages compare with the
    recorded ones. `digests` are (messages, stream digest) of what was made here, by stream; `outputs` the streams of
    each operator, `producers` those that it takes from. `start`: seconds into the recording, where it began there.
    `torn`: the recording has no proper end, so what is verified is what had been stored.
    `work` tells how long each operator worked.
    """

    operators: tuple[Verification, ...]
    stood_in: tuple[str, ...]
    facts: tuple[tuple[str, str, str], ...]
    messages: int
    streams: int
    wall: float
    span: float
    tolerance: float | None = None
    comparisons: Mapping[str, OutputComparison] = field(default_factory=dict)
    digests: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    outputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    producers: Mapping[str, frozenset[str]] = field(default_factory=dict)
    start: float | None = None
    torn: bool = False
    network_ignored: bool = False
    """The graph inside the recording has a `network:` section, which was not obeyed."""
    work: Mapping[str, OperatorCounts] = field(default_factory=dict)

    @property
    def identical(self) -> bool:
        """True only when every firing of the run was repeated and every output was the same, bit for bit."""
        return not self.cut and all(v.verdict == "identical" for v in self.operators)

    @property
    def cut(self) -> bool:
        """The recording ends before its run did: what it was verified up to is all that can be said of it."""
        return any(v.cut for v in self.operators)

    @property
    def within_tolerance(self) -> bool:
        """Every operator is identical or, given the recorded inputs, stays within the tolerance."""
        return all(self.verdict(v) in ("identical", "within tolerance") for v in self.operators)

    @property
    def culprits(self) -> tuple[str, ...]:
        return tuple(v.operator for v in self.operators if self.verdict(v) == "culprit")

    def verdict(self, verification: Verification) -> Verdict:
        """The verdict on an operator: its own, or what the tolerance makes of it."""
        compared = self.comparisons.get(verification.operator)
        if self.tolerance is None or verification.first is None or compared is None or compared.note:
            return verification.verdict
        return "within tolerance" if compared.tolerated else "culprit" if compared.own else "downstream"

    def repeats(self, operator: str) -> bool | None:
        """Whether an operator that differs did so twice alike; None where it was not run twice."""
        compared = self.comparisons.get(operator)
        first = next((v.first for v in self.operators if v.operator == operator), None)
        verdict = next((v.verdict for v in self.operators if v.operator == operator), None)
        if compared is None or compared.note or first is None or verdict != "culprit":
            return None
        return (compared.index, compared.got) == (first.index, first.got)

    def as_json(self) -> dict[str, Any]:
        operators = []
        for v in self.operators:
            compared = self.comparisons.get(v.operator)
            operators.append(
                v.to_wire()
                | {"verdict": self.verdict(v), "repeats": self.repeats(v.operator)}
                | {"comparison": None if compared is None else compared.as_json()}
            )
        return {
            "identical": self.identical,
            "tolerance": self.tolerance,
            "within_tolerance": None if self.tolerance is None else self.within_tolerance,
            "culprits": list(self.culprits),
            "start_s": self.start,
            "torn": self.torn,
            "cut": self.cut,
            "messages": self.messages,
            "streams": self.streams,
            "wall_s": self.wall,
            "real_time_factor": self.span / self.wall if self.wall else None,
            "operators": operators,
            "stood_in": list(self.stood_in),
            "differing_facts": [{"fact": f, "recorded": a, "here": b} for f, a, b in self.facts],
        }


def verify(
    path: Path,
    *,
    graph: Graph | None = None,
    first: str | None = None,
    only: str | None = None,
    tolerance: float | None = None,
    start: float | None = None,
    network: bool = False,
    watch: Watch | None = None,
    **options: Any,
) -> VerifyReport:
    """Re-executes a recording by its firing records and compares.

    `first`: verify that operator and what follows from it; `only`: that one alone. What feeds them is then taken from
    the recording, or verified as well where it was not recorded. Operators marked `external` always are taken from it.
    Operators that differ are run once more, alone and given the recorded inputs, and their messages compared field by
    field: the culprits as far as the first difference, with a `tolerance` (absolute, in the unit of each floating-point
    field) all of them to the end.
    `start` (seconds from the first message) begins in the middle, from recorded states where there are any; see
    `later_start.verify_from`. `network`: obey the `network:` section of the graph inside the recording, which is left
    alone otherwise. Further options are the fields of `RunPlan`.
    Raises `ReplayError` when the recording does not hold what is needed, `RunFailed` when an operator cannot run.
    """
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise ReplayError(f"tolerance {tolerance}: expected a finite number, 0 or more")
    with Recording(path) as recording:
        recorded = graph or graph_as_recorded(recording)
        played = recorded if graph or network else isolated(recorded)
        chosen = _with_makers(recording, played, _chosen(played, first, only))
        require_records(recording, sorted(chosen))
        require_ports(recording, played, sorted(chosen))
        ledger = read_ledger(recording, played, sorted(chosen))
        feeding = {
            played.streams[s].node for name in chosen for taken in played.nodes[name].inputs.values() for s in taken
        } - chosen
        log = None if start is not None else plan_replay(recording, played, replaced=feeding)
        facts = _differing_facts(recording.metadata, played)
        begin, last = _span(recording, start)
        torn = recording.torn
    if start is not None:
        results, wall = verify_from(path, played, chosen, begin)
        for result in results:
            ledger.enter(result)
        return VerifyReport(
            operators=tuple(results),
            stood_in=tuple(name for name in played.nodes if name not in chosen or name in feeding),
            facts=facts,
            messages=sum(v.outputs for v in results),
            streams=sum(len(played.nodes[v.operator].outputs) for v in results),
            wall=wall,
            span=(last - begin) * 1e-9,
            start=start,
            torn=torn,
            network_ignored=played.network != recorded.network,
        )
    report = execute(RunPlan(played, log=log, verify=frozenset(chosen), **options), mode="verify", watch=watch)
    found = {v["operator"]: Verification.from_wire(v) for v in report.verifications}
    compared = [found[name] for name in played.nodes if name in found]
    for verification in compared:
        ledger.enter(verification)
    span = 0.0 if report.first is None or report.last is None else (report.last - report.first) * 1e-9
    differing = [v.operator for v in compared if v.first and (tolerance is not None or v.verdict == "culprit")]
    return VerifyReport(
        operators=tuple(compared),
        stood_in=tuple(name for name in played.nodes if name in feeding),
        facts=facts,
        messages=sum(v.outputs for v in compared),
        streams=sum(len(played.nodes[v.operator].outputs) for v in compared),
        wall=report.wall,
        span=span,
        tolerance=tolerance,
        comparisons=_compare(path, played, differing, tolerance),
        digests=report.streams,
        network_ignored=played.network != recorded.network,
        work={v.operator: report.operators[v.operator] for v in compared},
        torn=torn,
        outputs={v.operator: tuple(played.nodes[v.operator].outputs.values()) for v in compared},
        producers={
            v.operator: frozenset(
                played.streams[s].node for taken in played.nodes[v.operator].inputs.values() for s in taken
            )
            for v in compared
        },
    )


def _span(recording: Recording, start: float | None) -> tuple[int, int]:
    """The stamp `start` seconds after the first message of the recording, and its last stamp."""
    spans = [s for s in recording.streams.values() if s.first is not None and not s.static and "/@/" not in s.name]
    first = min((s.first for s in spans if s.first is not None), default=0)
    last = max((s.last for s in spans if s.last is not None), default=0)
    begin = first + round((start or 0.0) * 1e9)
    if not first <= begin <= last:
        raise ReplayError(f"--start {start:g}: the recording is {(last - first) * 1e-9:.3g} s long")
    return begin, last


def require_records(recording: Recording, operators: Iterable[str]) -> None:
    """Raises `ReplayError` for the first operator without firing records."""
    for name in operators:
        if next(recorded_firings(recording, name), None) is None:
            raise ReplayError(
                f"{recording.path}: operator {name!r} left no firing records there; "
                "name the graph that made the recording with --graph, or record with --record"
            )


def require_ports(recording: Recording, graph: Graph, operators: Iterable[str]) -> None:
    """Raises `ReplayError` for the first operator whose outputs are not those it was recorded with."""
    for name in operators:
        node = graph.nodes[name]
        record = next((r for r in recorded_firings(recording, name) if r.outcome == "ok" and r.outputs), None)
        if record is not None and len(record.outputs) != len(node.outputs):
            raise ReplayError(
                f"{recording.path}: operator {name!r} was recorded with {len(record.outputs)} output ports and has "
                f"{len(node.outputs)} now ({', '.join(node.outputs)}), so its firings cannot be compared: verify with "
                f"the operator as it was, or record anew"
            )


def _compare(
    path: Path, graph: Graph, operators: Collection[str], tolerance: float | None
) -> Mapping[str, OutputComparison]:
    """The messages of operators that differ against the recorded ones; what prevents that is said in their `note`."""
    if not operators:
        return {}
    try:
        return compare_outputs(path, graph, operators, tolerance=tolerance)
    except RunFailed as failure:
        return {name: OutputComparison(name, note=f"not compared field by field: {failure}") for name in operators}


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


def _with_makers(recording: Recording, graph: Graph, chosen: set[str]) -> set[str]:
    """The operators with those that make what they take, as far as it was not recorded."""
    wanted, left = set(chosen), list(chosen)
    while left:
        for stream in {s for taken in graph.nodes[left.pop()].inputs.values() for s in taken}:
            maker = graph.nodes[graph.streams[stream].node]
            if stream not in recording.streams and not (maker.source or maker.external or maker.name in wanted):
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
