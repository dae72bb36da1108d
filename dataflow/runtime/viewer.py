"""Viewer output of a running graph: a sink that saves a viewer file, and a tap that follows a live graph."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dataflow.graph.model import Graph
from dataflow.messages.base import Message
from dataflow.runtime.sink import stream_types
from dataflow.view import ViewerSink


class ViewerFileSink:
    """Saves the streams as a viewer file, losslessly."""

    def __init__(self, path: str, graph: Graph, streams: list[str]) -> None:
        self.path = Path(path)
        self.viewer = ViewerSink.save(self.path)
        self.viewer.open({s: stream_types(graph, s)[0] for s in streams}, graph)
        self.messages = 0

    def message(self, stream: str, message: Message, seq: int, incarnation: int) -> None:
        self.messages += 1
        self.viewer.log(stream, message)

    def firings(self, operator: str, stamp: int, payload: bytes) -> None:
        """Firing records are not shown."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """A stream that ends stays as it is."""

    def flush(self) -> None:
        """The viewer's own writer flushes."""

    def close(self, outcome: str) -> Mapping[str, Any]:
        self.viewer.close()
        return {"path": str(self.path), "messages": self.messages, "bytes": self.path.stat().st_size}
