"""Where the operators of a host put what they make: messages, frontiers and firing records."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from dataflow.messages.base import Message
from dataflow.names import firings_key
from dataflow.records.firing import FiringRecord, encode_batch
from dataflow.sync import NEVER, Entry
from dataflow.transport import Envelope, Kind, encode

if TYPE_CHECKING:
    from dataflow.process.host import Host

BATCH_RECORDS = 64
BATCH_SECONDS = 0.25


class Outlet:
    """The emitter of all operators of a host: to local aligners by reference, to other hosts and taps as envelopes."""

    def __init__(self, host: Host) -> None:
        self.host = host
        self.sent = 0
        self._held: list[tuple[str, Envelope | bytes]] | None = []
        self._logs: dict[str, list[FiringRecord]] = {}
        self._flushed = time.monotonic()

    def release(self) -> None:
        """Sends what was emitted before the consumers were known to listen (static streams, `setup()` records)."""
        held, self._held = self._held or [], None
        for stream, envelope in held:
            self._send(stream, envelope)

    def _send(self, stream: str, envelope: Envelope | bytes) -> None:
        publisher = self.host.remote.get(stream)
        if publisher is None:
            return
        if self._held is not None:
            self._held.append((stream, envelope))
            return
        self.sent += self.host.config.publish[stream]
        if isinstance(envelope, bytes):
            publisher.put_bytes(envelope)
        else:
            publisher.put(envelope)

    def message(self, stream: str, entry: Entry) -> None:
        for runner in self.host.consumers.get(stream, ()):
            runner.push(stream, entry)
        message: Message = entry.value
        envelope = Envelope(
            Kind.MESSAGE, stream, entry.incarnation, entry.seq, entry.stamp, message, wall=time.time_ns()
        )
        if stream in self.host.static:
            self.host.bus.declare_static(stream, encode(envelope))
        self._send(stream, envelope)
        if self.host.taps.active:
            self.host.taps.offer(stream, envelope)

    def frontier(self, stream: str, frontier: int) -> None:
        for runner in self.host.consumers.get(stream, ()):
            runner.advance(stream, frontier)
        if stream in self.host.remote:
            self._send(stream, Envelope(Kind.FRONTIER, stream, 0, 0, frontier))

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        for runner in self.host.consumers.get(stream, ()):
            runner.end(stream, final_stamp, reason)
        if self.host.config.live and stream not in self.host.static:
            self.host.channel.send("stream_ended", stream=stream, reason=reason)
        final = NEVER if final_stamp is None else final_stamp
        self._send(stream, Envelope(Kind.END, stream, 0, 0, final, reason=reason))

    def record(self, record: FiringRecord) -> None:
        if self.host.config.live:  # ahead of its messages, to where it survives this process
            self.host.channel.send("record", operator=record.operator, data=encode_batch([record]))
        if self.host.config.firings:
            log = self._logs.setdefault(record.operator, [])
            if log and log[-1].incarnation != record.incarnation:
                self.flush(record.operator)
            log.append(record)
            if len(log) >= BATCH_RECORDS or record.kind == "finish":
                self.flush(record.operator, last=record.kind == "finish")

    def flush(self, operator: str, *, last: bool = False) -> None:
        log = self._logs.get(operator)
        if log:
            self._send(firings_key(self.host.graph.namespace, operator), encode_batch(log, last=last))
            log.clear()

    def flush_due(self) -> None:
        """Sends the batches that have waited long enough."""
        if time.monotonic() - self._flushed >= BATCH_SECONDS:
            self.flush_all()

    def flush_all(self) -> None:
        self._flushed = time.monotonic()
        for operator in self._logs:
            self.flush(operator)
