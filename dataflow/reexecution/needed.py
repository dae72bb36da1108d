"""Reads what a re-execution needs that begins in the middle: each stream from its first needed message."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from dataflow.execution.recorded import RecordedRunner
from dataflow.graph.model import Graph
from dataflow.recording import Recorded, Recording
from dataflow.records.reading import FiringLog


class NeededStreams:
    """The streams of a recording (`PlayableStreams`), each from the stamp in `starts` on, or from `begin`.

    Static streams are given whole, and so are those of several incarnations, whose stamps may have gone back.
    """

    def __init__(self, recording: Recording, starts: Mapping[str, int], begin: int) -> None:
        self._recording, self._starts, self._begin = recording, starts, begin
        self.path, self.streams, self.metadata = recording.path, recording.streams, recording.metadata

    @property
    def torn(self) -> bool:
        """Returns whether the file has no proper end."""
        return self._recording.torn

    def messages(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Recorded]:
        """Messages up to the stamp `end`, merged by (stamp, stream); static streams first and whole."""
        names = sorted(self.streams if streams is None else streams)
        static = [name for name in names if self.streams[name].static]
        yield from self._recording.messages(static)
        moving = [self._recording.messages([s], self._from(s, start), end) for s in names if s not in static]
        yield from heapq.merge(*moving, key=lambda item: (item.message.stamp, item.stream))

    def stamps(self, stream: str, start: int | None = None, end: int | None = None) -> Iterator[int]:
        """The stamps of what `messages()` gives of one stream, in that order."""
        return self._recording.stamps(stream, self._from(stream, start), end)

    def opening(self) -> Mapping[str, Any] | None:
        """Another process opens all of the recording."""
        return self._recording.opening()

    def close(self) -> None:
        """Closes the recording."""
        self._recording.close()

    def _from(self, stream: str, start: int | None) -> int | None:
        if self.streams[stream].incarnations > 1:
            return start
        first = self._starts.get(stream, self._begin)
        return first if start is None else max(first, start)


def first_needed(log: FiringLog, graph: Graph, runners: Iterable[RecordedRunner]) -> Mapping[str, int] | None:
    """By stream, the stamp of the first message that the runners need; None where that is not known: then all is read.

    Static streams are left out: they are read whatever is needed of others.
    """
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
