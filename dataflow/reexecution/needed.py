"""Reads what a re-execution needs that begins in the middle: each stream from its first needed message."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping

from dataflow.execution.recorded import RecordedRunner
from dataflow.graph.model import Graph
from dataflow.recording import Recorded, Recording
from dataflow.records.reading import FiringLog


def needed_messages(
    recording: Recording, streams: Iterable[str], starts: Mapping[str, int], begin: int | None, end: int | None
) -> Iterator[Recorded]:
    """Yields messages, merged by (stamp, stream): static streams first, the others from the stamp in `starts` on, or
    from `begin`, up to `end`. Static streams are whole, as are those of several incarnations, whose stamps may go back.
    """
    infos = {name: recording.streams[name] for name in sorted(streams)}
    yield from recording.messages([name for name, info in infos.items() if info.static])
    moving = [
        recording.messages([name], None if info.incarnations > 1 else starts.get(name, begin), end)
        for name, info in infos.items()
        if not info.static
    ]
    yield from heapq.merge(*moving, key=lambda item: (item.message.stamp, item.stream))


def first_needed(log: FiringLog, graph: Graph, runners: Iterable[RecordedRunner]) -> Mapping[str, int] | None:
    """By stream, the stamp of the first message that the runners need; None where that is not known: then all is read.
    Static streams are left out: they are read whatever is needed of others."""
    needed: dict[str, tuple[int, int]] = {}
    for runner in runners:
        for stream, place in runner.needs_from().items():
            if not graph.streams[stream].static:
                needed[stream] = min(place, needed.get(stream, place))
    stamps: dict[str, int] = {}
    for maker in {graph.streams[stream].node for stream in needed}:
        streams = list(graph.nodes[maker].outputs.values())
        for record in log.records(maker):
            if record.kind == "reset":
                return None  # stamps went back there
            for stream, emission in zip(streams, record.outputs, strict=False):
                if emission is not None and needed.get(stream) == (record.incarnation, emission.seq):
                    stamps[stream] = emission.stamp
    return stamps if stamps.keys() == needed.keys() else None
