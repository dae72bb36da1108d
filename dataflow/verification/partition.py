"""Divides the operators to be verified among workers, so that the slowest is through as early as can be."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from dataflow.graph.model import Graph

PER_FIRING_NS = 50_000
"""Work that the runtime adds to each firing, roughly."""
START_NS = 1_000_000_000
"""Work of starting a worker, roughly."""


@dataclass(frozen=True, slots=True)
class Part:
    """The work of one worker: operators to re-execute, and recorded streams to compare with their records."""

    operators: tuple[str, ...]
    checks: tuple[str, ...] = ()


def units(graph: Graph, held: Collection[str], operators: Collection[str]) -> list[frozenset[str]]:
    """For each operator that no other of them needs: it, and those that make what it takes and is not `held`.

    Each unit can be fed from a recording that holds the streams in `held`. An operator that several need is in each of
    their units: to repeat it twice costs its time, to repeat it once would cost that they can be repeated side by side.
    """
    needs = {name: _needed(graph, held, operators, name) for name in operators}
    for_others = {maker for name, needed in needs.items() for maker in needed - {name}}
    alone = [name for name in graph.nodes if name in needs and name not in for_others]
    found = [needs[name] for name in alone]
    covered = frozenset[str]().union(*found)
    loops = [needs[name] for name in graph.nodes if name in needs and name not in covered]  # feed only one another
    return found + list(dict.fromkeys(loops))


def _needed(graph: Graph, held: Collection[str], operators: Collection[str], name: str) -> frozenset[str]:
    """The operator, and those of `operators` that make its inputs as far as these are not `held`, theirs, and so on."""
    needed, left = {name}, [name]
    while left:
        for stream in {s for taken in graph.nodes[left.pop()].inputs.values() for s in taken}:
            maker = graph.streams[stream].node
            if stream not in held and maker in operators and maker not in needed:
                needed.add(maker)
                left.append(maker)
    return frozenset(needed)


def jobs_for(work: Mapping[str, int], cores: int) -> int:
    """As many workers as there are cores, but none that would take longer to start than to work. Work is in ns."""
    return min(cores, 1 + sum(work.values()) // START_NS)


def balanced(units: Sequence[frozenset[str]], work: Mapping[str, int], jobs: int) -> list[frozenset[str]]:
    """At most `jobs` parts of whole units: the heaviest unit first, to the part that is then the least heavy.

    What a part repeats anyway costs it nothing more; what another one repeats already costs it double.
    """
    parts: list[set[str]] = [set() for _ in range(min(jobs, len(units)))]

    def load(part: Collection[str]) -> int:
        return sum(work[name] for name in part)

    for unit in sorted(units, key=lambda unit: (-load(unit), sorted(unit))):
        placed = unit & frozenset[str]().union(*parts)
        min(parts, key=lambda part: (load(part | unit) + load(placed - part), bool(part))).update(unit)
    return [frozenset(part) for part in parts if part]


def with_checks(graph: Graph, parts: Sequence[Collection[str]], checks: Collection[str]) -> list[Part]:
    """Each stream to check goes to a part that reads it anyway, else to the one that makes it, else to the first."""
    taken = [{s for name in part for given in graph.nodes[name].inputs.values() for s in given} for part in parts]
    chosen: list[list[str]] = [[] for _ in parts]
    for stream in sorted(checks):
        readers = [k for k, streams in enumerate(taken) if stream in streams]
        makers = [k for k, part in enumerate(parts) if graph.streams[stream].node in part]
        chosen[(readers or makers or [0])[0]].append(stream)
    return [
        Part(tuple(name for name in graph.nodes if name in part), tuple(streams))
        for part, streams in zip(parts, chosen, strict=True)
    ]
