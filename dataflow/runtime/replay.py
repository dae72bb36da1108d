"""Plans a replay: recorded streams replace the sources that made them, everything else runs again."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from pathlib import Path

from dataflow.graph import load_bundle
from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.runtime.plan import LogPlan
from dataflow.runtime.recorder import ENDS

GRAPH = "dataflow:graph"


class ReplayError(ValueError):
    """A recording that cannot drive a graph: says which stream is missing and what would help."""


def recorded_graph(recording: Recording) -> Graph:
    """The graph that made a recording. Raises `ReplayError` when it does not hold one."""
    bundle = recording.metadata.get(GRAPH, {}).get("bundle")
    if bundle is None:
        raise ReplayError(f"{recording.path} does not hold the graph that made it: name one with --graph")
    return load_bundle(bundle)


def graph_metadata(graph: Graph) -> dict[str, dict[str, str]]:
    """What a recording must hold so that its graph can be loaded again."""
    return {GRAPH: {"name": graph.name, "bundle": graph.bundle(), "text": graph.text}}


def plan_replay(
    recording: Recording,
    graph: Graph,
    *,
    replaced: Collection[str] | None = None,
    start: float | None = None,
    end: float | None = None,
) -> LogPlan:
    """Which recorded streams stand in for which operators: the sources, or those that `replaced` names.

    `start`, `end`: seconds from the recording's first message. Raises `ReplayError`.
    """
    streams: list[str] = []
    for node in graph.sources() if replaced is None else [graph.nodes[name] for name in sorted(replaced)]:
        outputs = tuple(node.outputs.values())
        recorded = [s for s in outputs if s in recording.streams]
        if not recorded:
            raise ReplayError(
                f"{recording.path}: no stream of {node.name!r} is in the recording "
                f"(looked for {', '.join(outputs)}; it holds {', '.join(recording.streams) or 'none'})"
            )
        missing = [s for s in outputs if s not in recording.streams and graph.consumers(s)]
        if missing:
            raise ReplayError(
                f"{recording.path}: stream {missing[0]!r} of {node.name!r} was not recorded, "
                f"but {graph.consumers(missing[0])[0][0].name!r} takes it; record it, or leave that operator out"
            )
        for stream in recorded:
            check_type(recording, graph, stream)
        streams += recorded
    if not streams:
        raise ReplayError(
            f"nothing of {recording.path} can be played into graph {graph.name!r}: it has no sources, or what is to "
            "run takes nothing from them; name another graph with --graph"
        )
    first = min((i.first for s in streams if (i := recording.streams[s]).first is not None and not i.static), default=0)
    return LogPlan(
        Path(recording.path),
        tuple(sorted(streams)),
        finals=final_stamps(recording, streams),
        start=None if start is None else first + round(start * 1e9),
        end=None if end is None else first + round(end * 1e9),
    )


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
