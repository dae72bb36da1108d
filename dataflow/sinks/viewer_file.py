"""The sink that saves what a running graph shows as a viewer file, losslessly."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dataflow.graph.model import Graph
from dataflow.messages import Alarm
from dataflow.messages.base import Message
from dataflow.names import logs_key
from dataflow.recording import LogLine
from dataflow.sinks.sink import SinkFailure, StreamSink
from dataflow.view import Save, ViewerSink, as_alarm

PATIENCE = 30.0


class ViewerFileSink(StreamSink):
    """Draws every message of the shown streams into one file."""

    def __init__(self, path: str, graph: Graph, streams: list[str]) -> None:
        self.path = Path(path)
        self.viewer = ViewerSink(Save(self.path, at_end=True))
        self._logs, self._clock = logs_key(graph.namespace), 0
        self.viewer.open({**{s: graph.message_types(s)[0] for s in streams}, self._logs: Alarm}, graph)

    def message(self, stream: str, message: Message, seq: int, incarnation: int) -> None:
        self._clock = max(self._clock, message.stamp)
        dropped = self.viewer.statistics().dropped
        self.viewer.log(stream, message, wait=PATIENCE)
        if self.viewer.statistics().dropped > dropped:
            raise SinkFailure(f"{self.path} took nothing for {PATIENCE:g} s")

    def log(self, line: LogLine) -> None:
        self.viewer.log(self._logs, as_alarm(line, self._clock), wait=PATIENCE)

    def summaries(self, found: Mapping[str, Mapping[str, Any]]) -> None:
        """Shows the scores among them."""
        self.viewer.scores(found)

    def close(self, outcome: str) -> Mapping[str, Any]:
        self.viewer.close(timeout=PATIENCE)
        drawn = self.viewer.statistics()
        size = self.path.stat().st_size
        return {"path": str(self.path), "messages": drawn.drawn, "failed": drawn.failed, "bytes": size}
