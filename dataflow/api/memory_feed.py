"""Messages that a program hands in, in place of a graph's sources."""

from __future__ import annotations

import time
from collections.abc import Mapping

from dataflow.execution.log import FiringLog
from dataflow.execution.ports import Emitter
from dataflow.graph.model import Graph
from dataflow.graph.problems import did_you_mean
from dataflow.messages.base import Message
from dataflow.records.firing import Emission
from dataflow.sync import NEVER, Entry


class MemoryFeed:
    """The streams of a graph's sources, one step after the other; what it gives is recorded as a source's would be."""

    def __init__(self, graph: Graph, static: Mapping[str, Message], emitter: Emitter) -> None:
        """`static` maps static streams, with or without the namespace, to their messages. Raises `ValueError` where
        one is missing or too many, and `TypeError` for a message of another type."""
        self._graph, self._emitter = graph, emitter
        made = {name: stream for name, stream in graph.streams.items() if graph.nodes[stream.node].source}
        self.streams = {name for name, stream in made.items() if not stream.static}
        statics = {name for name, stream in made.items() if stream.static}
        self._static = {self._named(name, message, statics): message for name, message in static.items()}
        if missing := sorted(name for name in statics - self._static.keys() if graph.consumers(name)):
            raise ValueError(f"no message for the static stream {graph.relative(missing[0])!r}")
        self._logs = {node.name: FiringLog(node.name, emitter) for node in graph.sources()}
        self._numbers = dict.fromkeys(self.streams, 0)
        self.last = NEVER

    def setup(self) -> None:
        """Gives the static streams."""
        emitted = {}
        for stream, message in self._static.items():
            digest = message.digest()
            self._emitter.message(stream, Entry(message.stamp, message, 0, 0, digest, stream))
            emitted[stream] = Emission(0, message.stamp, digest)
            self._emitter.end(stream, None, "static")
        for name, log in self._logs.items():
            outputs = tuple(emitted.get(stream) for stream in self._graph.nodes[name].outputs.values())
            log.add("setup", NEVER + 1, time.time_ns(), outputs=outputs, detail={"handed": True})

    def check(self, messages: Mapping[str, Message], stamp: int) -> dict[str, Message]:
        """The messages by full names of their streams. Raises `ValueError` and `TypeError` as `Session.put` does."""
        if stamp <= self.last:
            raise ValueError(f"stamp {stamp} comes after {self.last}: stamps must increase")
        named = {self._named(name, message, self.streams): message for name, message in messages.items()}
        for stream, message in named.items():
            if message.stamp != stamp:
                raise ValueError(f"{self._graph.relative(stream)} has stamp {message.stamp}, the step {stamp}")
        return named

    def _named(self, name: str, message: Message, streams: set[str]) -> str:
        stream = name if name in streams else f"{self._graph.namespace}/{name}"
        if stream not in streams:
            known = [self._graph.relative(other) for other in streams]
            raise ValueError(f"no stream {name!r} of a source: {did_you_mean(name, known, 'there are')}")
        types = self._graph.message_types(stream)
        if not isinstance(message, types):
            wanted = " or ".join(each.__name__ for each in types)
            raise TypeError(f"{name} takes {wanted}, not {type(message).__name__}")
        return stream

    def admit(self, messages: Mapping[str, Message], stamp: int) -> None:
        """Gives checked messages, and promises that nothing more comes up to their stamp."""
        emitted = {}
        started = time.time_ns()
        self.last = stamp
        for stream, message in messages.items():
            number, digest = self._numbers[stream], message.digest()
            self._numbers[stream] += 1
            emitted[stream] = Emission(number, stamp, digest)
            self._emitter.message(stream, Entry(stamp, message, number, 0, digest, stream))
        for name, log in self._logs.items():
            outputs = tuple(emitted.get(stream) for stream in self._graph.nodes[name].outputs.values())
            if any(outputs):
                log.add("fire", stamp, started, outputs=outputs)
        for stream in sorted(self.streams - emitted.keys()):
            self._emitter.frontier(stream, stamp)

    def finish(self) -> None:
        """Ends the streams."""
        for stream in sorted(self.streams):
            self._emitter.end(stream, None if self.last == NEVER else self.last, "end of session")
        for name, log in self._logs.items():
            ports = self._graph.nodes[name].outputs
            log.add("finish", self.last, time.time_ns(), outputs=(None,) * len(ports))
