"""A graph in this process that a program feeds message by message."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from dataflow.api.graphs import GraphLike, resolved
from dataflow.api.local import Emitting, Recorder, config_of
from dataflow.api.runs import metadata_of
from dataflow.arguments import checked, require
from dataflow.execution.calls import summary_of
from dataflow.execution.driver import Driver
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.log import FiringLog
from dataflow.execution.ports import Emitter
from dataflow.execution.threads import limited_threads
from dataflow.graph.model import Graph
from dataflow.graph.problems import did_you_mean
from dataflow.messages.base import Message
from dataflow.process.build import build
from dataflow.records.firing import Emission
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.sim_to_real import warn_of_gap
from dataflow.sync import NEVER, Entry

Made = dict[str, tuple[Message, ...]]
"""Messages of a step by stream, without the namespace."""


class Session:
    """Executes a graph in this process, on this thread, with messages that the program hands in.

        with dataflow.Session("graph.yaml", static={"camera/info": info}, outputs=["detector/*"]) as session:
            made = session.put(image.stamp, {"camera/image": image})

    What is handed in takes the place of all sources, which are not made. `put` returns when everything that follows
    from the step has been computed; the messages are those of a run, digest by digest. Results that must wait for what
    comes later (joins with a tolerance, ports with a lag) come with the step that decides them.
    """

    @checked
    def __init__(
        self,
        graph: GraphLike,
        *,
        static: Mapping[str, Message] | None = None,
        outputs: Iterable[str] | None = None,
        settings: Mapping[str, Any] | None = None,
        record: str | Path | None = None,
        overwrite: bool = False,
    ) -> None:
        """`static`: the message of each static stream of the sources; `outputs`: streams that `put` returns, by name
        without the namespace or exported name (all, unless given); `settings`: as for `dataflow.run`.

        Raises `GraphError`, `ValueError` for streams that are not there, and `RunFailed` where an operator cannot be
        set up.
        """
        self.graph = resolved(graph, settings)
        warn_of_gap(self.graph)
        self._names = self._chosen(outputs)
        self._made: dict[str, list[Message]] = {}
        self._driver = Driver()
        self._emitter = _Collecting(self._driver, self._names, self._made)
        self._feed = MemoryFeed(self.graph, static or {}, self._emitter)
        self._closed = False
        self._outcome = "failed: it did not end in order"
        self._open = ExitStack()
        if record is not None:
            file = Path(record)
            file.parent.mkdir(parents=True, exist_ok=True)
            options = {"metadata": metadata_of(self.graph, "run"), "overwrite": overwrite}
            self._emitter.recorder = Recorder(file, self.graph, set(self.graph.streams), options)
            self._open.callback(lambda: self._emitter.recorder and self._emitter.recorder.close(self._outcome))
        self._open.callback(self._close_operators)
        self._open.enter_context(limited_threads(self.graph.threads))
        try:
            build(self._driver, self.graph, config_of(self.graph, None, sources=False), self._emitter)
            self._driver.set_up()
            self._feed.setup()
        except BaseException as error:
            self._fail(error)
            raise

    def _chosen(self, outputs: Iterable[str] | None) -> dict[str, str]:
        """Stream → name under which it is returned."""
        space = self.graph.namespace
        aliases = {alias.removeprefix(f"{space}/"): stream for alias, stream in self.graph.aliases.items()}
        own = {self.graph.relative(stream): stream for stream in self.graph.streams}
        if outputs is None:
            return {stream: name for name, stream in own.items()}
        chosen = {}
        for name in outputs:
            stream = aliases.get(name) or own.get(name)
            if stream is None:
                raise ValueError(f"no stream {name!r} in graph {self.graph.name}")
            chosen[stream] = name
        return chosen

    def put(self, stamp: int, messages: Mapping[str, Message]) -> Made:
        """Hands in the messages of one stamp, by stream, and returns what the graph makes of them.

        A step without messages advances time. Raises `ValueError` for a stamp that does not come after
        the last one and for streams that are not the sources', `TypeError` for messages of another type, and
        `RunFailed` with the operator that failed, after which the session is closed.
        """
        if stamp.__class__ is not int or not isinstance(messages, Mapping):  # each message is checked by its stream
            require("Session.put", [("stamp", stamp, int), ("messages", messages, Mapping[str, Message])])
        if self._closed:
            raise ValueError("the session is closed")
        named = self._feed.check(messages, stamp)
        try:
            self._feed.admit(named, stamp)
            self._work()
        except BaseException as error:
            self._fail(error)
            raise
        return self._taken()

    def close(self) -> Made:
        """Ends the streams and closes the operators; returns what they make at their end."""
        if self._closed:
            return {}
        try:
            self._feed.finish()
            self._work()
        except BaseException as error:
            self._fail(error)
            raise
        self._outcome, self._closed = "complete", True
        self._open.close()
        return self._taken()

    def summaries(self) -> dict[str, Mapping[str, Any]]:
        """Returns what the operators sum up, by operator."""
        return {r.node.name: s for r in self._driver.operators if (s := summary_of(r.operator, r.node.name))}

    def _work(self) -> None:
        """Runs what is decided, until nothing is left of it."""
        try:
            while self._driver.turn():
                pass
        except OperatorFailure as failure:
            raise RunFailed(str(failure), failure.traceback, failure.operator) from failure

    def _taken(self) -> Made:
        made = {name: tuple(messages) for name, messages in self._made.items()}
        self._made.clear()
        return made

    def _fail(self, error: BaseException) -> None:
        self._closed = True
        self._outcome = f"failed: {(str(error) or type(error).__name__).splitlines()[0]}"
        try:
            self._open.close()
        except OperatorFailure as failure:  # of close(), after the first cause
            error.add_note(str(failure))

    def _close_operators(self) -> None:
        if failures := self._driver.close():
            raise failures[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if error is not None and not self._closed:
            self._fail(error)
        self.close()


class _Collecting(Emitting):
    """Also keeps the messages of chosen streams."""

    def __init__(self, driver: Driver, names: Mapping[str, str], made: dict[str, list[Message]]) -> None:
        super().__init__(driver)
        self._names, self._kept = names, made

    def message(self, stream: str, entry: Entry) -> None:
        super().message(stream, entry)
        name = self._names.get(stream)
        if name is not None:
            self._kept.setdefault(name, []).append(entry.value)


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
