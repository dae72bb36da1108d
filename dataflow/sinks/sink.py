"""A sink process: it takes whole streams losslessly, in arrival order, without aligning them.

The recorder is one, and so is the writer of a viewer file. What they have taken counts towards the flow control of
feeds, so neither can be outrun.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dataflow.execution.work import Work
from dataflow.graph.model import Graph
from dataflow.messages import Diagnostics
from dataflow.messages.base import Message
from dataflow.names import firings_key
from dataflow.process.awake_clock import AwakeClock
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.process.priority import let_others_begin
from dataflow.process.streams.inbox import Inbox
from dataflow.process.streams.inlet import Inlet
from dataflow.process.streams.losses import losses_of
from dataflow.recording import LogLine
from dataflow.records.firing import Batch, FiringRecord, FiringRecordError, consecutive, decode_batch, encode_batch
from dataflow.sync import FOREVER, NEVER
from dataflow.transport import Envelope, Kind
from dataflow.transport.envelope import MAGIC

IDLE_WAIT = 0.1
REPORT_EVERY = 0.01
ALIVE_EVERY = 1.0
"""Seconds between two reports of one that stores things, though it is no further with one of the streams."""
FLUSH_EVERY = 1.0
DRAIN_WITHIN = 5.0


@dataclass(frozen=True, slots=True)
class SinkConfig:
    """Configuration of a sink process, from its supervisor: `kind` is "record" or "view", `options` belong to the
    kind, `links_in` are the keys of each link from another process, `life` counts the processes in its place."""

    label: str
    kind: str
    graph: dict[str, Any]
    streams: list[str]
    firings: list[str]
    options: dict[str, Any]
    links_in: Sequence[Sequence[str]] = ()
    live: bool = False
    life: int = 1


class StreamSink:
    """Takes what a sink process is given; what a kind of sink has no use for, it passes over."""

    def message(self, stream: str, message: Message, seq: int, incarnation: int) -> None:
        """Takes a message of a stream."""
        raise NotImplementedError

    def firings(self, operator: str, records: Sequence[FiringRecord], payload: bytes) -> None:
        """Takes a batch of firing records, as it came and decoded."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """A stream has ended."""

    def event(self, name: str, stamp: int, data: Mapping[str, Any]) -> None:
        """Something happened to the run: an operator was restarted, a fault was planned."""

    def diagnostics(self, message: Diagnostics) -> None:
        """Takes how every operator fares."""

    def log(self, line: LogLine) -> None:
        """An operator has logged or printed something."""

    def summaries(self, found: Mapping[str, Mapping[str, Any]]) -> None:
        """Operators have ended, and this is what each sums up, as their finish records do."""

    def flush(self) -> None:
        """Hands everything to the operating system, about once a second."""

    def close(self, outcome: str) -> Mapping[str, Any]:
        """Completes the output; `outcome` is "complete" or the reason why the run ended. Returns what it wrote."""
        raise NotImplementedError


class SinkFailure(RuntimeError):
    """The sink could not store what it was given."""


class SinkProcess:
    """Takes streams until all have ended or the supervisor ends it."""

    def __init__(
        self, config: SinkConfig, channel: Channel, inbox: Inbox, make_sink: Callable[[SinkConfig, Graph], StreamSink]
    ) -> None:
        self.config, self.channel, self.inbox = config, channel, inbox
        self.graph = Graph.from_json(config.graph)
        self.make_sink = make_sink
        self.frontiers = dict.fromkeys(config.streams, NEVER)
        self._operator_of = {firings_key(self.graph.namespace, o): o for o in config.firings}
        self.firings_open = set(self._operator_of)
        """Keys on which an operator's last firing records have not come yet."""
        self._open = set(config.streams)
        """Streams whose end has not come yet."""
        self._begins: dict[str, int] = {}
        """The incarnations with which operators go on that were started again: ends of earlier ones end nothing."""
        self._expected = 0
        """Counts how often streams were said to begin anew: the process that makes them was started again."""
        self.sink: StreamSink | None = None
        static = [s for s in config.streams if self.graph.streams[s].static]
        losses = losses_of(config.label, channel, live=config.live)
        self.inlet = Inlet(
            channel, self._deliver, static=static, losses=losses, from_start=config.live and config.life == 1
        )
        self.batches = 0
        """Batches of firing records that were taken."""
        self.written = 0
        self._recorded: dict[str, tuple[int, int]] = {}  # operator → the record that follows those stored
        self._lacking: dict[str, set[tuple[int, int]]] = {}  # operator → records before it that did not come
        taken = [*(self.graph.streams[s].node for s in config.streams), *config.firings]
        self._taken = {name: NEVER for name in taken if self.graph.nodes[name].source}
        self._told: dict[str, int] = {}
        self._stored_told, self._told_at = 0, 0.0
        self._done = NEVER
        self._report_due = 0.0
        self._flush_due = 0.0
        self._work = Work()
        self._ended = False
        self._left = False
        self._outcome = "the supervisor is gone"

    def open(self) -> None:
        self.channel.send("joined")
        self.sink = self.make_sink(self.config, self.graph)
        self.channel.send("ready", first=None, steps=None)

    def run(self) -> None:
        assert self.sink is not None
        now, changed = time.monotonic(), True
        while not self._left:
            if self._take(max(0.0, self._report_due - now) if changed else IDLE_WAIT):
                changed = True
            now = time.monotonic()
            if now >= self._flush_due:
                self._flush_due = now + FLUSH_EVERY
                self.sink.flush()
            if changed and now >= self._report_due:
                changed = False
                self._report(now)

    def _take(self, timeout: float) -> bool:
        """Handles the next item; False when there is none in time."""
        try:
            item = self.inbox.get(timeout=timeout)
        except queue.Empty:
            return False
        self._handle(item)
        return True

    def _handle(self, item: tuple[Any, ...]) -> None:
        match item:
            case ("envelope", key, payload):
                with self._work:
                    self._receive(key, payload)
            case ("control", kind, fields):
                self._control(kind, fields)

    def _receive(self, key: str, payload: Any) -> None:
        if key not in self._operator_of or bytes(payload[: len(MAGIC)]) == MAGIC:
            self.inlet.take(key, payload)
            return
        try:
            batch = decode_batch(bytes(payload))
        except FiringRecordError as error:
            self.inlet.refuse_malformed(key, error)
            return
        if not batch.records or batch.operator != self._operator_of[key]:
            self.inlet.refuse(key, f"{len(batch.records)} firing records of {batch.operator!r}")
            return
        self.batches += 1
        if self._take_records(batch) and batch.incarnation >= self._begins.get(batch.operator, 0):
            self.firings_open.discard(key)

    def _deliver(self, key: str, envelope: Envelope) -> None:
        assert self.sink is not None
        if key not in self.frontiers:
            self.inlet.refuse(key, "an envelope")
            return
        match envelope.kind:
            case Kind.MESSAGE:
                assert envelope.message is not None
                self.sink.message(key, envelope.message, envelope.seq, envelope.incarnation)
                self.written += 1
                self._note_taken(self.graph.streams[key].node, envelope.stamp)
                self.frontiers[key] = max(self.frontiers[key], envelope.stamp)
            case Kind.FRONTIER:
                self.frontiers[key] = max(self.frontiers[key], envelope.stamp)
            case Kind.END:
                self.frontiers[key] = FOREVER
                made = self.graph.streams[key]
                if made.static or envelope.incarnation >= self._begins.get(made.node, 0):
                    self._open.discard(key)
                self.sink.end(key, None if envelope.stamp == NEVER else envelope.stamp, envelope.reason)

    def _take_records(self, batch: Batch) -> bool:
        """Stores a batch of firing records, those of it that are not stored yet; True for an operator's last batch.

        Records come twice when their operator's process has died, and when some were lost on their way: then that
        process sends what it has kept of them again, or, if it is dead, the supervisor what it has left.
        """
        assert self.sink is not None
        last = batch.records[-1]
        first = batch.records[0]
        begin = (-1, 0) if self.config.life == 1 else (first.incarnation, first.index)
        following = self._recorded.get(batch.operator, begin)
        lacking = self._lacking.setdefault(batch.operator, set())
        places = [(r.incarnation, r.index) for r in batch.records]
        due = following[1] if batch.incarnation == following[0] else 0
        if batch.incarnation >= following[0] and places[0][1] > due:
            lacking.update((batch.incarnation, index) for index in range(due, places[0][1]))
            self.channel.send("lacks", operator=batch.operator)
        fresh = [r for r, place in zip(batch.records, places, strict=True) if place >= following or place in lacking]
        lacking.difference_update(places)
        self._recorded[batch.operator] = max(following, (places[-1][0], places[-1][1] + 1))
        if len(fresh) == len(batch.records):
            self.sink.firings(batch.operator, batch.records, batch.data)
            return batch.last or last.kind == "finish"
        for part in consecutive(fresh):
            self.sink.firings(batch.operator, part, encode_batch(part, last=batch.last and part[-1] is last))
        return batch.last or last.kind == "finish"

    def _note_taken(self, operator: str, stamp: int) -> None:
        if operator in self._taken and stamp > 0:
            self._taken[operator] = stamp

    def _report(self, now: float) -> None:
        """Returns how far it is."""
        dynamic = [f for s, f in self.frontiers.items() if not self.graph.streams[s].static]
        self._done = min(dynamic, default=FOREVER)
        done = self._reached()
        self._report_due = now + REPORT_EVERY
        stored = self.written + self.batches
        if done != self._told or (stored != self._stored_told and now >= self._told_at + ALIVE_EVERY):
            self._told, self._stored_told, self._told_at = done, stored, now
            self.channel.send("progress", done=done, counts=self._counts())
        if not self._ended and not self._open and not self.firings_open:
            self._ended = True
            report = {"counts": self._counts(), "transport": self.inbox.counters(), "expected": self._expected}
            self.channel.send("ended", report=report)

    def _reached(self) -> dict[str, int]:
        """The stamp up to which all streams were taken, under its own name."""
        return {self.config.label: self._done}

    def _counts(self) -> dict[str, list[int]]:
        return {self.config.label: [0, self.written, 0, self._work.cpu_ns, self._done, self._work.wall_ns]}

    def _control(self, kind: str, fields: Mapping[str, Any]) -> None:
        match kind:
            case "poll":
                self._report(time.monotonic())  # what is owed comes first: idle means owing nothing
                self.channel.send(
                    "state",
                    round=fields["round"],
                    idle=self.inbox.empty(),
                    sent=0,
                    received=self.inlet.received + self.batches,
                    full=False,
                    waiting={},
                )
            case "records":
                assert self.sink is not None
                for data in fields["batches"]:
                    self._take_records(decode_batch(data))
            case "expect":
                self.inlet.restarted(fields["streams"])
                self._expect(fields["streams"], fields["times"], fields["begins"])
            case "event":
                assert self.sink is not None
                self.sink.event(fields["name"], fields["stamp"], fields["data"])
            case "diagnostics":
                assert self.sink is not None
                self.sink.diagnostics(_diagnostics(fields))
            case "logs":
                assert self.sink is not None
                for line in fields["lines"]:
                    self.sink.log(LogLine.from_json(line))
            case "leave":
                self._outcome = fields["outcome"]
                self._left = True
                self._drain()
                if self.sink is not None:
                    self.sink.summaries(fields.get("summaries", {}))
            case "ended_elsewhere":
                self._open.difference_update(fields["streams"])
                self.frontiers |= dict.fromkeys(self.frontiers.keys() & set(fields["streams"]), FOREVER)
            case "lost":
                self._drain()
                raise ChannelClosed("the supervisor is gone")

    def _expect(self, keys: Sequence[str], times: int, begins: Mapping[str, int]) -> None:
        """Waits for the ends of streams again, and for last firing records. Static streams end once.

        What the process before has said may still be on its way: `begins` holds the incarnations of the next one.
        """
        self._expected, self._ended = times, False
        self._begins.update(begins)
        self._told.clear()
        self._open.update(key for key in keys if key in self.frontiers and not self.graph.streams[key].static)
        self.firings_open.update(key for key in keys if key in self._operator_of)

    def _drain(self) -> None:
        """Takes what has arrived: all others have left, or it is unknown whether they have."""
        clock = AwakeClock()
        deadline = clock() + DRAIN_WITHIN
        while not self.inbox.empty() and clock() < deadline:
            item = self.inbox.get_nowait()
            if item[0] == "envelope":
                self._handle(item)

    def hand_over(self) -> None:
        """A sink keeps nothing that another process needs."""

    def close(self) -> Mapping[str, Any]:
        facts: Mapping[str, Any] = {}
        if self.sink is not None:
            facts = self.sink.close(self._outcome)
        return facts


class LiveSinkProcess(SinkProcess):
    """A sink of a live run, beside devices that do not wait: it gives way to operators."""

    def open(self) -> None:
        super().open()
        let_others_begin()

    def _reached(self) -> dict[str, int]:
        """Returns up to where it has taken what follows from each source; streams of operators that drop do not."""
        return dict(self._taken)


def _diagnostics(fields: Mapping[str, Any]) -> Diagnostics:
    pairs = [(k, name, str(value)) for k, values in enumerate(fields["values"]) for name, value in values.items()]
    return Diagnostics(
        stamp=fields["stamp"],
        names=tuple(fields["names"]),
        messages=tuple(fields["messages"]),
        keys=tuple(name for _, name, _ in pairs),
        values=tuple(value for _, _, value in pairs),
        levels=np.array(fields["levels"], np.uint8),
        owners=np.array([k for k, _, _ in pairs], np.int32) if pairs else None,
    )
