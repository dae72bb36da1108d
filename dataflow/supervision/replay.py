"""Plans a replay: recorded streams replace the sources that made them, everything else runs again."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from dataflow.execution.feeds.playable import PlayableStreams
from dataflow.graph.model import Graph
from dataflow.recording.streams.cutting import cut_of
from dataflow.reexecution.recorded_run import ReplayError, check_type, final_stamps
from dataflow.supervision.plan import LogPlan


def plan_replay(
    recording: PlayableStreams,
    graph: Graph,
    *,
    replaced: Collection[str] | None = None,
    resting: Collection[str] = (),
    start: float | None = None,
    end: float | None = None,
) -> LogPlan:
    """Returns which recorded streams stand in for which operators: the sources, or those that `replaced` names.

    What only these and the `resting` ones take may be missing: they do not run.
    `start`, `end`: seconds from the recording's first message, or from where it was cut: then it begins there, with the
    states that operators had. Raises `ReplayError`.
    """
    streams: list[str] = []
    nodes = graph.sources() if replaced is None else [graph.nodes[name] for name in sorted(replaced)]
    idle = {node.name for node in nodes} | {*resting}
    for node in nodes:
        outputs = tuple(node.outputs.values())
        recorded = [s for s in outputs if s in recording.streams]
        if not recorded:
            raise ReplayError(
                f"{recording.path}: no stream of {node.name!r} is in the recording "
                f"(looked for {', '.join(outputs)}; it holds {', '.join(recording.streams) or 'none'})"
            )
        takers = {s: [n.name for n, _ in graph.consumers(s) if n.name not in idle] for s in outputs}
        missing = [s for s in outputs if s not in recording.streams and takers[s]]
        if missing:
            raise ReplayError(
                f"{recording.path}: stream {missing[0]!r} of {node.name!r} was not recorded, "
                f"but {takers[missing[0]][0]!r} takes it; record it, or leave that operator out"
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
    part = cut_of(recording.metadata)
    if part is not None and part.start is not None:
        first, start = part.start, start or 0.0
    return LogPlan(
        Path(recording.path),
        tuple(sorted(streams)),
        finals=final_stamps(recording, streams),
        first=first,
        start=None if start is None else first + round(start * 1e9),
        end=None if end is None else first + round(end * 1e9),
        bag=recording.opening(),
    )
