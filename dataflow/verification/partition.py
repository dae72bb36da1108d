"""Divides the operators to be verified among workers, so that each has about as much work."""

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


def units(graph: Graph, recorded: Collection[str], operators: Collection[str]) -> list[tuple[str, ...]]:
    """The operators in the smallest groups that can be fed from a recording, each in graph order.

    An operator whose input was not recorded belongs with the one that makes it again.
    """
    group = {name: {name} for name in operators}
    for name in operators:
        for stream in {s for taken in graph.nodes[name].inputs.values() for s in taken}:
            maker = graph.streams[stream].node
            if stream not in recorded and maker in group and group[maker] is not group[name]:
                group[name] |= group[maker]
                for other in group[maker]:
                    group[other] = group[name]
    found = {id(members): members for members in group.values()}
    return [tuple(name for name in graph.nodes if name in members) for members in found.values()]


def jobs_for(work: Mapping[str, int], cores: int) -> int:
    """As many workers as there are cores, but none that would take longer to start than to work. Work is in ns."""
    return min(cores, 1 + sum(work.values()) // START_NS)


def balanced(groups: Sequence[tuple[str, ...]], work: Mapping[str, int], jobs: int) -> list[tuple[str, ...]]:
    """At most `jobs` parts of whole groups, none empty: the heaviest group first, to the part with the least work."""
    parts: list[list[str]] = [[] for _ in range(min(jobs, len(groups)))]
    loads = [0] * len(parts)
    for members in sorted(groups, key=lambda g: (-sum(work[name] for name in g), g)):
        lightest = loads.index(min(loads))
        parts[lightest] += members
        loads[lightest] += sum(work[name] for name in members)
    return [tuple(part) for part in parts]


def with_checks(graph: Graph, parts: Sequence[tuple[str, ...]], checks: Collection[str]) -> list[Part]:
    """Each stream to check goes to a part that reads it anyway, else to the one that makes it, else to the first."""
    taken = [{s for name in part for given in graph.nodes[name].inputs.values() for s in given} for part in parts]
    chosen: list[list[str]] = [[] for _ in parts]
    for stream in sorted(checks):
        readers = [k for k, streams in enumerate(taken) if stream in streams]
        makers = [k for k, part in enumerate(parts) if graph.streams[stream].node in part]
        chosen[(readers or makers or [0])[0]].append(stream)
    return [Part(part, tuple(streams)) for part, streams in zip(parts, chosen, strict=True)]
