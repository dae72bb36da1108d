"""A recording by A and by B in one viewer file: what is equal once, what differs as layers over each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from heapq import merge
from pathlib import Path

from dataflow.graph import Graph
from dataflow.graph.model import Node, Stream
from dataflow.messages import Message
from dataflow.recording import Recording
from dataflow.sweep.swap import ReplayedPair
from dataflow.view import Save, ViewerError, ViewerSink

PATIENCE = 30.0
"""Seconds without progress after which the file counts as stalled."""


def layered(
    graphs: tuple[Graph, Graph], different: frozenset[str]
) -> tuple[Graph, Mapping[str, str], Mapping[str, str]]:
    """Returns a graph in which every stream that differs is there twice, below `A/` and `B/`, to be drawn by; and by
    stream of A and of B the name that it has there."""
    names: list[dict[str, str]] = []
    for side, graph in zip("AB", graphs, strict=True):
        names.append({s: _below(side, graph.relative(s)) if s in different else s for s in graph.streams})
    nodes, streams, hidden = dict[str, Node](), dict[str, Stream](), set[str]()
    for side, graph, named in zip("AB", graphs, names, strict=True):
        for node in graph.nodes.values():
            doubled = any(s in different for s in node.outputs.values())
            name = f"{side}/{node.name}" if doubled else node.name
            inputs = {port: tuple(named[s] for s in taken) for port, taken in node.inputs.items()}
            outputs = {port: named[s] for port, s in node.outputs.items()}
            nodes[name] = replace(node, name=name, inputs=inputs, outputs=outputs)
            streams |= {named[s]: replace(graph.streams[s], name=named[s], node=name) for s in node.outputs.values()}
        hidden |= {named[s] for s in graph.view.hide if s in named}
    first = graphs[0]
    kept = {named.get(s, s) for named in names for s in first.view.keep}
    view = replace(first.view, hide=tuple(sorted(hidden)), keep=tuple(sorted(kept)))
    return replace(first, nodes=nodes, streams=streams, view=view), names[0], names[1]


def _below(side: str, stream: str) -> str:
    """The operator has the letter in its name, too: labels show the last two parts."""
    operator, _, port = stream.rpartition("/")
    return f"{side}/{operator} {side}/{port}"


def draw(both: ReplayedPair, file: Path) -> ViewerSink:
    """Draws it; returns the viewer, closed. Raises `ViewerError`, `RecordingError`."""
    with Recording(both.files[0]) as a, Recording(both.files[1]) as b:
        graph, first, second = layered(both.graphs, both.different)
        types: dict[str, type[Message]] = {s: graph.message_types(s)[0] for s in graph.streams}
        with ViewerSink(Save(file, at_end=True)) as sink:
            sink.open(types, graph)
            taken = merge(
                _messages(a, first, frozenset(a.streams)),
                _messages(b, second, both.different),
                key=lambda item: (item[1].stamp, item[0]),
            )
            for stream, message in taken:
                if not sink.log(stream, message, wait=PATIENCE) and sink.statistics().dropped:
                    raise ViewerError(f"{file} took nothing for {PATIENCE:g} s")
            if not sink.close(PATIENCE):
                raise ViewerError(f"{file} was not written whole within {PATIENCE:g} s")
    return sink


def _messages(recording: Recording, names: Mapping[str, str], streams: frozenset[str]) -> Iterator[tuple[str, Message]]:
    chosen = [s for s in recording.streams if s in streams and s in names]
    for item in recording.messages(chosen):
        yield names[item.stream], item.message
