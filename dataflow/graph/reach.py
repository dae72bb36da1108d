"""Operators that are in front of others or behind them, in the graph."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Set

from dataflow.graph.model import Graph


def upstream(graph: Graph, names: Iterable[str]) -> set[str]:
    """Returns the operators on which some depend, directly or not; one of these itself only where it is in a loop."""
    return reached(names, lambda name: _makers(graph, graph.nodes[name].taken))


def downstream(graph: Graph, names: Iterable[str]) -> set[str]:
    """Returns the operators that depend on some, directly or not; one of these itself only where it is in a loop."""
    takers: dict[str, set[str]] = {name: set() for name in graph.nodes}
    for edge in graph.edges():
        takers[edge.producer].add(edge.consumer)
    return reached(names, takers.__getitem__)


def with_makers(held: Collection[str], graph: Graph, chosen: Collection[str]) -> set[str]:
    """Returns operators with those that make what they take, as far as it is not `held` (streams) in a recording."""

    def more(name: str) -> set[str]:
        made = _makers(graph, graph.nodes[name].taken.difference(held))
        return {maker for maker in made if not (graph.nodes[maker].source or graph.nodes[maker].external)}

    return {*chosen} | reached(chosen, more)


def _makers(graph: Graph, streams: Iterable[str]) -> set[str]:
    return {graph.streams[stream].node for stream in streams}


def reached(names: Iterable[str], more: Callable[[str], Set[str]]) -> set[str]:
    """Returns what `more` leads to from some names on; one of these itself only where something leads back to it."""
    found, left = set[str](), list(names)
    while left:
        new = more(left.pop()) - found
        found |= new
        left += new
    return found
