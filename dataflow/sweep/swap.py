"""Finds the operator that brings a change of a figure: A's graph is replayed with the outputs of one as B made them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dataflow.api.local import LocalRun
from dataflow.api.runs import replay
from dataflow.graph import Graph
from dataflow.graph.reach import upstream
from dataflow.recording import Recording
from dataflow.supervision.replay import plan_replay
from dataflow.sweep.plan import SweepError
from dataflow.sweep.work import numbers


@dataclass(frozen=True, slots=True)
class OperatorShare:
    """An operator's part in the change of a figure, over the recordings that were replayed.

    `change`: mean of the figure less A's, with this operator's outputs as B made them and all others A's. `share`: that
    by the mean of B - A; NaN where A and B have the same.
    """

    operator: str
    change: float
    share: float


@dataclass(frozen=True, slots=True)
class ReplayedPair:
    """One recording replayed by A's graph and by B's, with every stream recorded: `files`.

    `different`: streams whose digests differ, or that only one of them has.
    """

    graphs: tuple[Graph, Graph]
    files: tuple[Path, Path]
    figures: tuple[Mapping[str, float], Mapping[str, float]]
    different: frozenset[str]

    def swapped(self, operator: str) -> Mapping[str, float]:
        """Returns the figures of A's graph with the outputs of one operator as B made them. Raises `ReplayError`,
        `RunFailed`."""
        graph = self.graphs[0]
        with Recording(self.files[1]) as opened:
            given = {node.name for node in graph.sources() if any(s in opened.streams for s in node.outputs.values())}
            log = plan_replay(opened, graph, replaced=given | {operator})
        return _named(LocalRun(graph, log=log).execute().summaries)


def both(recording: Path, graphs: tuple[Graph, Graph], maps: Sequence[str], folder: Path) -> ReplayedPair:
    """Replays a recording, or a bag, by two graphs in this process; records all streams in `folder`.

    Raises `ReplayError`, `RunFailed`, `MappingError`.
    """
    files, found, digests = [], [], []
    topics = dict(word.split("=", 1) for word in maps)
    for side, graph in zip("ab", graphs, strict=True):
        whole = replace(graph, record=replace(graph.record, streams=tuple(sorted(graph.streams)), thin=False))
        files.append(folder / f"{side}.mcap")
        made = replay(recording, graph=whole, record=files[-1], overwrite=True, maps=topics or None)
        found.append(_named(made.summaries))
        digests.append(made.digests())
    a, b = digests
    different = frozenset(stream for stream in a.keys() | b.keys() if a.get(stream) != b.get(stream))
    return ReplayedPair(graphs, (files[0], files[1]), (found[0], found[1]), different)


def between(graphs: tuple[Graph, Graph], different: Iterable[str], figure: str) -> list[str]:
    """Returns those of the operators whose streams differ that the operator of a figure ("operator: name") depends on,
    and that both graphs have with the same outputs, in their order. Raises `SweepError` where there are none."""
    first, second = graphs
    there = [
        name
        for name in different
        if name in first.nodes
        and name in second.nodes
        and not first.nodes[name].source
        and first.nodes[name].outputs
        and first.nodes[name].outputs == second.nodes[name].outputs
    ]
    judge = figure.partition(":")[0]
    above = upstream(first, [judge]) - {judge} if judge in first.nodes else set()
    if not (found := [name for name in there if name in above]):
        raise SweepError(f"{figure}: no operator in front of {judge} has other outputs in B, so none can be swapped")
    return found


def parts(one: ReplayedPair, operators: Sequence[str], figure: str) -> Mapping[str, float]:
    """Returns the figure less A's: by operator, with its outputs as B made them, and "" for B itself. Raises as
    `ReplayedPair.swapped` does."""
    a, b = (found.get(figure, math.nan) for found in one.figures)
    return {"": b - a} | {name: one.swapped(name).get(figure, math.nan) - a for name in operators}


def shares(found: Sequence[Mapping[str, float]]) -> list[OperatorShare]:
    """Returns the mean part of each operator in what `parts` found in recordings."""
    means = {name: sum(one[name] for one in found) / len(found) for name in found[0]}
    whole = means.pop("")
    return [OperatorShare(name, change, change / whole if whole else math.nan) for name, change in means.items()]


def _named(summaries: Mapping[str, Mapping[str, object]]) -> dict[str, float]:
    return {f"{o}: {name}": value for o, summary in summaries.items() for name, value in numbers(summary).items()}
