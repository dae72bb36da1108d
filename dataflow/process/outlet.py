"""Where the operators of a process put what they make: messages, frontiers and firing records."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from dataflow.messages.base import Message
from dataflow.names import firings_key
from dataflow.process.channel import Channel
from dataflow.process.recent import RecentFirings
from dataflow.records.black_box import BlackBox
from dataflow.records.firing import FiringRecord, consecutive, encode_batch
from dataflow.sync import NEVER, Entry
from dataflow.transport import Bus, Envelope, Kind, StreamPublisher, TapServer, encode

BATCH_RECORDS = 64
BATCH_SECONDS = 0.25


class Consumer(Protocol):
    """Takes streams by reference."""

    def push(self, stream: str, entry: Entry) -> None:
        """Takes a message."""

    def advance(self, stream: str, frontier: int) -> None:
        """Takes a frontier."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """Takes the end of the stream."""


@dataclass(frozen=True, slots=True)
class Links:
    """What an outlet publishes through: the bus, its taps, a publisher for each stream that other processes take, and
    how many of them do."""

    bus: Bus
    taps: TapServer
    publishers: Mapping[str, StreamPublisher]
    takers: Mapping[str, int]


class Outlet:
    """The emitter of all operators of a process: to local aligners by reference, to other processes and taps as
    envelopes.

    `live`: the supervisor is told that a stream has ended. `box`: what keeps the latest firing records should this
    process die. `firings`: whether a recorder takes the firing records. `incarnations`: by stream, the ones that begin
    above 0.
    """

    def __init__(
        self,
        channel: Channel,
        consumers: Callable[[str], Iterable[Consumer]],
        *,
        namespace: str,
        static: frozenset[str],
        live: bool,
        box: BlackBox | None,
        firings: bool,
        incarnations: Mapping[str, int],
    ) -> None:
        self.sent = 0
        self.recent = RecentFirings()
        self._channel, self._consumers, self._namespace, self._static = channel, consumers, namespace, static
        self._live, self._box, self._firings = live, box, firings
        self._links: Links | None = None
        self._held: list[tuple[str, Envelope | bytes]] | None = []
        self._next = {stream: (incarnation, 0) for stream, incarnation in incarnations.items()}
        self._logs: dict[str, list[FiringRecord]] = {}
        self._flushed = time.monotonic()

    def open(self, links: Links) -> None:
        """Begins to publish static streams to late joiners, and copies to taps; the rest waits for `release`."""
        self._links = links

    def release(self) -> None:
        """Sends what was emitted before the consumers were known to listen (static streams, `setup()` records)."""
        held, self._held = self._held or [], None
        for stream, envelope in held:
            self._send(stream, envelope)

    def probe(self) -> None:
        """Sends a probe on every key that another process takes."""
        for publisher in self._publishers.values():
            publisher.probe()

    @property
    def _publishers(self) -> Mapping[str, StreamPublisher]:
        return {} if self._links is None else self._links.publishers

    def _send(self, stream: str, envelope: Envelope | bytes) -> None:
        publisher = self._publishers.get(stream)
        if publisher is None:
            return
        if self._held is not None:
            self._held.append((stream, envelope))
            return
        assert self._links is not None
        self.sent += self._links.takers[stream]
        if isinstance(envelope, bytes):
            publisher.put_bytes(envelope)
        else:
            publisher.put(envelope)

    def message(self, stream: str, entry: Entry) -> None:
        for consumer in self._consumers(stream):
            consumer.push(stream, entry)
        links = self._links
        if links is None or not (stream in links.publishers or links.taps.active or stream in self._static):
            return  # nobody takes it outside this process
        message: Message = entry.value
        envelope = Envelope(
            Kind.MESSAGE, stream, entry.incarnation, entry.seq, entry.stamp, message, wall=time.time_ns()
        )
        if stream in self._static:
            links.bus.declare_static(stream, encode(envelope))
        begun = entry.incarnation != self._next.get(stream, (0, 0))[0]
        self._next[stream] = entry.incarnation, entry.seq + 1
        self._send(stream, envelope)
        if begun and stream in self._publishers:  # by this a taker knows that the new incarnation is the stream's own
            self._send(stream, self._envelope(Kind.FRONTIER, stream, entry.stamp))
        if links.taps.active:
            links.taps.offer(stream, envelope)

    def frontier(self, stream: str, frontier: int) -> None:
        for consumer in self._consumers(stream):
            consumer.advance(stream, frontier)
        if stream in self._publishers:
            self._send(stream, self._envelope(Kind.FRONTIER, stream, frontier))

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        for consumer in self._consumers(stream):
            consumer.end(stream, final_stamp, reason)
        if stream in self._static:
            self._send(stream, self._envelope(Kind.END, stream, NEVER, reason))
            return
        if self._live:
            self._channel.send("stream_ended", stream=stream, reason=reason)
        if final_stamp is not None:  # by this a taker that has lost the last messages believes the end
            self._send(stream, self._envelope(Kind.FRONTIER, stream, final_stamp))
        self._send(stream, self._envelope(Kind.END, stream, NEVER if final_stamp is None else final_stamp, reason))

    def _envelope(self, kind: Kind, stream: str, stamp: int, reason: str = "") -> Envelope:
        incarnation, seq = self._next.get(stream, (0, 0))
        return Envelope(kind, stream, incarnation, seq, stamp, reason=reason)

    def record(self, record: FiringRecord) -> None:
        self.recent.add(record)
        if self._box is not None:  # ahead of its messages, to where it survives this process
            self._box.add(record)
        if self._firings:
            log = self._logs.setdefault(record.operator, [])
            if log and log[-1].incarnation != record.incarnation:
                self.flush(record.operator)
            log.append(record)
            if len(log) >= BATCH_RECORDS or record.kind == "finish":
                self.flush(record.operator, last=record.kind == "finish")

    def flush(self, operator: str, *, last: bool = False) -> None:
        log = self._logs.get(operator)
        if log:
            self._send(firings_key(self._namespace, operator), encode_batch(log, last=last))
            log.clear()

    def flush_due(self) -> None:
        """Sends the batches that have waited long enough."""
        if time.monotonic() - self._flushed >= BATCH_SECONDS:
            self.flush_all()

    def flush_all(self) -> None:
        self._flushed = time.monotonic()
        for operator in self._logs:
            self.flush(operator)

    def send_again(self, operator: str) -> None:
        """Sends what is kept of an operator's firing records: the recorder lacks some, and leaves out what it has."""
        if self._box is None or not self._firings:
            return
        for part in consecutive(self._box.kept(operator)):
            for first in range(0, len(part), BATCH_RECORDS):
                self._send(firings_key(self._namespace, operator), encode_batch(part[first : first + BATCH_RECORDS]))

    def put_raw(self, stream: str, payload: bytes) -> None:
        """Publishes bytes that are no envelope: a planned fault."""
        if self._links is not None:
            self._links.bus.session.put(stream, payload)


def incarnations_of(resumed: Mapping[str, Any], outputs: Mapping[str, Mapping[str, str]]) -> dict[str, int]:
    """The incarnations that streams begin with, by stream; `outputs`: by operator, its ports and their streams."""
    return {
        stream: int(fields["incarnation"])
        for operator, fields in resumed.items()
        for stream in outputs.get(operator, {}).values()
    }
