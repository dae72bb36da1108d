"""The warning where networks that were trained in simulation alone take what sensors measured."""

from __future__ import annotations

import logging
from collections.abc import Collection

from dataflow.execution.feeds.playable import PlayableStreams
from dataflow.graph.model import Graph, Node, OperatorImportError
from dataflow.graph.problems import GraphError
from dataflow.reexecution.recorded_run import ReplayError, graph_as_recorded, resolved_graph


def warn_of_gap(graph: Graph, played: PlayableStreams | None = None) -> None:
    """Logs one warning that names all operators whose networks know simulations alone and that take measured data.

    `played`: the recording that replaces the sources of `graph`. Its streams are simulated where the sources of the
    graph that made it were; those of a bag are measured.
    """
    given: Collection[str] | None = None
    if played is not None:
        maker = _maker(played)
        given = played.streams if maker is None else measured(maker)
    found = measured(graph, given)
    names = [
        node.name
        for node in graph.nodes.values()
        if _takes(node, found) and node.operator.trained_in_simulation(node.params)
    ]
    if names:
        logging.getLogger("dataflow").warning(
            "trained in simulation alone, and here on measured data: %s; expect wrong results, or name networks that "
            "were trained on such data",
            ", ".join(names),
        )


def measured(graph: Graph, given: Collection[str] | None = None) -> set[str]:
    """Returns the streams that follow from what sensors measured, not from simulations alone.

    `given`: the measured streams of a recording that replaces the sources; None where the sources themselves run.
    """
    found: set[str] = set()
    for node in graph.nodes.values():
        made = set(node.outputs.values())
        if not node.source:
            real = _takes(node, found)
        elif given is None:
            real = not _simulated(node)
        else:
            real = not made.isdisjoint(given)
        if real:
            found |= made
    return found


def _maker(played: PlayableStreams) -> Graph | None:
    """Returns the graph that made a recording; None for a bag, or where the graph cannot be loaded here."""
    try:
        return resolved_graph(played) or graph_as_recorded(played)  # the first recordings hold the graph's files alone
    except (ReplayError, GraphError):
        return None


def _takes(node: Node, streams: set[str]) -> bool:
    return any(not streams.isdisjoint(taken) for taken in node.inputs.values())


def _simulated(node: Node) -> bool:
    """Returns whether the class of a source is marked so; a recording may name one that cannot be imported here."""
    try:
        return bool(getattr(node.operator, "simulated", False))
    except OperatorImportError:
        return False
