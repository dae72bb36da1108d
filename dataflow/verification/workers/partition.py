"""Divides the operators to be verified among workers, so that the slowest is through as early as can be."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dataflow.graph.model import Graph
from dataflow.graph.reach import with_makers
from dataflow.records.reading import FiringLog
from dataflow.verification.record_totals import GraphRecordTotals
from dataflow.verification.workers import slices
from dataflow.verification.workers.slices import Slice

PER_FIRING_NS = 50_000
"""Work that the runtime adds to each firing, roughly."""
START_NS = 1_000_000_000
"""Work of starting a worker, roughly."""


@dataclass(frozen=True, slots=True)
class Job:
    """The work of one worker: operators to re-execute, and recorded streams to compare with their records.

    Of the operators in `slices` it makes only those calls.
    """

    operators: tuple[str, ...]
    checks: tuple[str, ...] = ()
    slices: Mapping[str, Slice] = field(default_factory=dict)

    def request(self) -> dict[str, Any]:
        """Returns its part of the request to a worker, as plain values."""
        slices = {name: (cut.begin, cut.end) for name, cut in self.slices.items()}
        return {"checks": list(self.checks), "slices": slices}


def planned(
    graph: Graph,
    log: FiringLog,
    books: GraphRecordTotals,
    operators: Collection[str],
    *,
    held: Collection[str],
    jobs: int | None = None,
    cores: int = 1,
    divide: bool = False,
) -> list[Job]:
    """Plans the parts of a verification, for `jobs` workers or as many as pay on these cores.

    `held` are the streams that the recording can feed operators with; `divide` lets several workers make the calls of
    one operator.
    """
    work = {n: books.of(n).duration + PER_FIRING_NS * books.of(n).records for n in operators}
    jobs = jobs or jobs_for(work, cores)
    whole = units(graph, held, operators)
    looped = {n.name for n in graph.nodes.values() if not n.taken.intersection(n.outputs.values()).issubset(held)}
    alone = {name: work[name] for name in whole if divide and jobs > 1 and name not in looped}
    divided = {name: (work[name], whole.pop(name)) for name in slices.divisible(graph, books, alone)}
    level = sum(work.values()) // jobs if divided else 0
    parts = [set(part) for part in balanced(list(whole.values()), work, jobs, level)]
    if divided:
        parts += [set() for _ in range(jobs - len(parts))]
    cuts: list[dict[str, Slice]] = [{} for _ in parts]
    poured = slices.shares(
        [sum(work[name] for name in part) for part in parts],
        {name: sum(work[maker] for maker in unit - {name}) for name, (_, unit) in divided.items()},
        {name: ns for name, (ns, _) in divided.items()},
    )
    for name, of in poured.items():
        each = slices.cut(log.ordered(graph.nodes[name]), [ns for _, ns in of], PER_FIRING_NS)
        for (part, _), one in zip(of, each, strict=False):
            parts[part] |= divided[name][1]
            if len(each) > 1:
                cuts[part][name] = one
    return [
        Job(tuple(name for name in graph.nodes if name in part), slices=cut)
        for part, cut in zip(parts, cuts, strict=True)
        if part
    ]


def units(graph: Graph, held: Collection[str], operators: Collection[str]) -> dict[str, frozenset[str]]:
    """By each operator that no other of them needs: it, and those that make what it takes and is not `held`.

    Each unit can be fed from a recording that holds the streams in `held`. An operator that several need is in each of
    their units: to repeat it twice costs its time, to repeat it once would cost that they can be repeated side by side.
    """
    needs = {
        name: frozenset(with_makers(held, graph, {name}).intersection(operators))
        for name in graph.nodes
        if name in operators
    }
    for_others = {maker for name, needed in needs.items() for maker in needed - {name}}
    found = {name: needed for name, needed in needs.items() if name not in for_others}
    for name, needed in needs.items():
        if not any(name in unit for unit in found.values()):
            found[name] = needed  # feed only one another
    return found


def jobs_for(work: Mapping[str, int], cores: int) -> int:
    """As many workers as there are cores, but none that would take longer to start than to work. Work is in ns."""
    return min(cores, 1 + sum(work.values()) // START_NS)


def balanced(
    units: Sequence[frozenset[str]], work: Mapping[str, int], jobs: int, level: int = 0
) -> list[frozenset[str]]:
    """At most `jobs` parts of whole units: the heaviest unit first, to the part that is then the least heavy.

    What a part repeats anyway costs it nothing more; what another one repeats already costs it double. Up to a `level`
    to which other work fills the parts, a unit goes where it adds least.
    """
    parts: list[set[str]] = [set() for _ in range(min(jobs, len(units)))]

    def load(part: Collection[str]) -> int:
        return sum(work[name] for name in part)

    def cost(part: set[str], unit: frozenset[str], placed: frozenset[str]) -> tuple[bool, int, int, bool]:
        then = load(part | unit)
        above = then > level
        return above, then + load(placed - part) if above else then - load(part), then, bool(part)

    for unit in sorted(units, key=lambda unit: (-load(unit), sorted(unit))):
        placed = unit & frozenset[str]().union(*parts)
        min(parts, key=lambda part: cost(part, unit, placed)).update(unit)
    return [frozenset(part) for part in parts if part]


def with_checks(graph: Graph, parts: Sequence[Job], checks: Collection[str]) -> list[Job]:
    """Each stream to check goes to a part that reads it anyway, else to the one that makes it, else to the first."""
    taken = [{stream for name in part.operators for stream in graph.nodes[name].taken} for part in parts]
    chosen: list[list[str]] = [[] for _ in parts]
    for stream in sorted(checks):
        readers = [k for k, streams in enumerate(taken) if stream in streams]
        makers = [k for k, part in enumerate(parts) if graph.streams[stream].node in part.operators]
        chosen[(readers or makers or [0])[0]].append(stream)
    return [replace(part, checks=tuple(streams)) for part, streams in zip(parts, chosen, strict=True)]
