"""The run that a recording holds: its graph, its streams' types, how they ended."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace

from dataflow.graph import load_bundle
from dataflow.graph.model import Graph, Network
from dataflow.recording import Recording
from dataflow.recording.layout import ENDS, GRAPH


class ReplayError(ValueError):
    """A recording that cannot drive a graph: says which stream is missing and what would help."""


def recorded_graph(recording: Recording) -> Graph:
    """Returns the graph that made a recording, without its network: a recording opens no port and calls nobody.

    Raises `ReplayError` when the recording does not hold a graph.
    """
    return isolated(graph_as_recorded(recording))


def isolated(graph: Graph) -> Graph:
    """Returns a graph whose processes can only be reached from this machine, whatever its `network:` section says."""
    return replace(graph, network=Network(shared_memory=graph.network.shared_memory))


def graph_as_recorded(recording: Recording) -> Graph:
    """Returns the graph that made a recording, as it is. Raises `ReplayError` when it does not hold one."""
    bundle = recording.metadata.get(GRAPH, {}).get("bundle")
    if bundle is None:
        raise ReplayError(f"{recording.path} does not hold the graph that made it: name one with --graph")
    return load_bundle(bundle)


def graph_metadata(graph: Graph) -> dict[str, dict[str, str]]:
    """What a recording must hold so that its graph can be loaded again."""
    return {GRAPH: {"name": graph.name, "bundle": graph.bundle(), "text": graph.text}}


def check_type(recording: Recording, graph: Graph, stream: str) -> None:
    """Raises `ReplayError` unless a recorded stream holds what the graph's stream of that name carries."""
    info = recording.streams[stream]
    wanted = graph.streams[stream].types
    if info.message_type is None or info.message_type.SCHEMA not in wanted:
        raise ReplayError(
            f"{recording.path}: stream {stream!r} holds {info.schema}, "
            f"the graph's {graph.streams[stream].node!r} emits {' | '.join(wanted)}"
        )


def final_stamps(recording: Recording, streams: Iterable[str]) -> dict[str, int]:
    """The stamps that streams ended with in the recorded run, where the recording says so."""
    ends = recording.metadata.get(ENDS, {})
    known = {s: json.loads(ends[s]) for s in streams if s in ends}
    return {s: end["final"] for s, end in known.items() if end["final"] is not None}
