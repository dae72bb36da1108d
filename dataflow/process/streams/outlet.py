"""The outlet takes what the operators of a process make: messages, frontiers and firing records."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dataflow.messages.base import Message
from dataflow.names import firings_key
from dataflow.process.awake_clock import AwakeClock
from dataflow.process.channel import Channel
from dataflow.process.config import ResumeState
from dataflow.process.streams.recent import RecentFirings
from dataflow.process.streams.stream_order import Place
from dataflow.records.black_box import BlackBox
from dataflow.records.firing import FiringRecord, consecutive, encode_batch
from dataflow.sync import NEVER, Entry
from dataflow.transport import (
    Bus,
    Envelope,
    Fanout,
    Kind,
    Outgoing,
    OutsidePublisher,
    StreamPublisher,
    TapServer,
    encode,
    encode_parts,
)
from dataflow.transport.codec import parts_size

_MESSAGE = Kind.MESSAGE
BATCH_RECORDS = 64
BATCH_SECONDS = 0.25
PUSH_WITHIN = 2.0


class Consumer(Protocol):
    """Takes streams by reference."""

    def push(self, stream: str, entry: Entry) -> None:
        """Takes a message."""

    def advance(self, stream: str, frontier: int) -> None:
        """Takes a frontier."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """Takes the end of the stream."""


@dataclass(frozen=True, slots=True)
class Network:
    """Holds what an outlet publishes through besides its links: the bus, its taps, and a publisher for each stream."""

    bus: Bus
    taps: TapServer
    outside: OutsidePublisher
    publishers: Mapping[str, StreamPublisher]


class Outlet:
    """The emitter of all operators of a process: to local aligners by reference, to other processes and taps as
    envelopes.

    `fanout`: the links to the others. `box`: what keeps the latest firing records should this process die. `firings`:
    whether a recorder takes the firing records. `incarnations`: by stream, the ones that begin above 0. `left`: by
    stream, the place of the message that the process before this one would have made next: who lacks messages before
    it has lost them.
    """

    def __init__(
        self,
        channel: Channel,
        consumers: Mapping[str, Sequence[Consumer]],
        *,
        fanout: Fanout,
        namespace: str,
        static: frozenset[str],
        box: BlackBox | None,
        firings: bool,
        incarnations: Mapping[str, int],
        left: Mapping[str, Place],
    ) -> None:
        self.sent = 0
        self.recent = RecentFirings()
        self._channel, self._consumers, self._namespace, self._static = channel, consumers, namespace, static
        self._box, self._firings = box, firings
        self._network: Network | None = None
        self._fanout = fanout
        self._once: dict[str, list[Envelope]] = {}
        """The messages of static streams: a consumer that was started again gets it again."""
        self._held: list[tuple[str, Envelope | bytes, bool]] | None = []
        self._next: dict[str, Place] = {stream: (incarnation, 0) for stream, incarnation in incarnations.items()}
        self._left = left
        self._publishers: Mapping[str, StreamPublisher] = {}
        self._logs: dict[str, list[FiringRecord]] = {}
        self._unnoted: FiringRecord | None = None
        """The last record, where it is kept and not yet in its batch."""
        self._flushed = time.monotonic()

    def open(self, network: Network) -> None:
        """Begins to publish static streams to late joiners, and copies to taps; the rest waits for `release`."""
        self._network, self._publishers = network, network.publishers

    def release(self) -> None:
        """Sends what was emitted before the consumers were known to listen (static streams, `setup()` records)."""
        held, self._held = self._held or [], None
        for stream, place in self._left.items():
            self._say_left(stream, place)
        for key, said, droppable in held:
            if isinstance(said, Envelope):
                self._send(key, said, droppable=droppable)
            else:
                self._send_bytes(key, said)

    def _say_left(self, stream: str, place: Place) -> None:
        """Announces how far an ended incarnation of a stream got: messages that a subscriber lacks are lost."""
        if stream not in self._static:
            self._send(stream, Envelope(Kind.FRONTIER, stream, *place, NEVER), droppable=False)

    def probe(self) -> None:
        """Sends a probe on every key that another process takes."""
        for stream, takers in self._fanout.takers.items():
            parts = encode_parts(Envelope(Kind.PROBE, stream, 0, 0, 0))
            for link, channel in takers:
                if not link.waiting:
                    link.send(channel, parts, parts_size(parts))

    def push(self) -> None:
        """Sends what has waited for room, as far as there is some, and static messages to restarted processes."""
        if self._fanout.quiet():
            return
        for keys, link in self._fanout.joined():
            if self._held is None:
                self._say_again(keys, link)
        self._fanout.flush()

    def _say_again(self, keys: Sequence[str], link: Outgoing) -> None:
        for number, key in enumerate(keys):
            for envelope in self._once.get(key, ()):
                parts = encode_parts(envelope)
                link.send(number, parts, parts_size(parts), droppable=False)
                self.sent += 1

    def push_all(self) -> None:
        """Waits (bounded) until everything has room: before this process leaves. Reports what is lost."""
        clock = AwakeClock()
        deadline = clock() + PUSH_WITHIN
        while not self._fanout.flush():
            if clock() >= deadline:
                text = f"what this process sent last is lost: another took too little of it for {PUSH_WITHIN:g} s"
                print(text, file=sys.stderr)
                return
            time.sleep(0.001)

    def consumer_gone(self, number: int, life: int) -> None:
        """The process at the other end of a link has died (`Outgoing.take_leave`)."""
        self._fanout.take_leave(number, life)

    def counters(self) -> dict[str, int]:
        """Returns what was sent to other processes (`Fanout.counters`)."""
        return self._fanout.counters()

    def room(self, nbytes: int) -> npt.NDArray[np.uint8] | None:
        """Returns memory for a large array that may be sent from where it lies (`Fanout.room`); on any thread."""
        return self._fanout.room(nbytes)

    def close(self) -> None:
        """Lets go of the memory that other processes read."""
        self._fanout.close()

    def _listened(self, stream: str) -> StreamPublisher | None:
        """Returns the publisher of a stream that has subscribers outside the run."""
        publisher = self._publishers.get(stream)
        return publisher if publisher is not None and publisher.matched else None

    def _send(self, stream: str, envelope: Envelope, *, droppable: bool = True) -> None:
        """Sends to every process that takes a stream, and over the network if it has subscribers there."""
        if self._held is not None:
            self._held.append((stream, envelope, droppable))
            return
        listened = self._listened(stream)
        if listened is None and stream not in self._fanout.takers:
            return
        parts = encode_parts(envelope)
        if listened is not None and self._network is not None:
            self._network.outside.put(listened, b"".join(parts))
        self.sent += self._fanout.send(stream, parts, envelope, droppable=droppable)

    def _send_records(self, operator: str, batch: bytes) -> None:
        """Sends firing records, to the recorder and to subscribers from outside."""
        self._send_bytes(firings_key(self._namespace, operator), batch)

    def _send_bytes(self, key: str, batch: bytes) -> None:
        if self._held is not None:
            self._held.append((key, batch, False))
            return
        listened = self._listened(key)
        if listened is not None and self._network is not None:
            self._network.outside.put(listened, batch)
        self.sent += self._fanout.send(key, [batch], droppable=False)

    def message(self, stream: str, entry: Entry) -> None:
        """Most messages go to other processes of the run and nowhere else: that way is the short one."""
        for consumer in self._consumers.get(stream, ()):
            consumer.push(stream, entry)
        before = self._next.get(stream)
        if before is not None and before[0] != entry.incarnation:
            self._say_left(stream, before)
        self._next[stream] = entry.incarnation, entry.seq + 1
        network, publisher = self._network, self._publishers.get(stream)
        tapped = network is not None and network.taps.active
        plain = not tapped and self._held is None and (publisher is None or not publisher.matched)
        if plain and stream not in self._fanout.takers and stream not in self._static:
            return
        message: Message = entry.value
        envelope = Envelope(_MESSAGE, stream, entry.incarnation, entry.seq, entry.stamp, message, "", time.time_ns())
        if plain and stream not in self._static:
            self.sent += self._fanout.send(stream, encode_parts(envelope), envelope)
            self._note_last()
            return
        if stream in self._static:
            self._once[stream] = [envelope]
            if network is not None:
                network.bus.declare_static(stream, encode(envelope))
        if stream in self._static or self._is_taken(stream):
            self._send(stream, envelope, droppable=stream not in self._static)
        if network is not None and tapped:
            network.taps.offer(stream, envelope)

    def _is_taken(self, stream: str) -> bool:
        """Returns whether a stream has consumers outside this process; before `release` there may still be some."""
        return self._held is not None or stream in self._fanout.takers or self._listened(stream) is not None

    def frontier(self, stream: str, frontier: int) -> None:
        for consumer in self._consumers.get(stream, ()):
            consumer.advance(stream, frontier)
        if self._is_taken(stream):
            self._send(stream, self._envelope(Kind.FRONTIER, stream, frontier))

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        for consumer in self._consumers.get(stream, ()):
            consumer.end(stream, final_stamp, reason)
        if stream in self._static:
            over = self._envelope(Kind.END, stream, NEVER, reason)
            self._once.setdefault(stream, []).append(over)
            self._send(stream, over, droppable=False)
            return
        self._channel.send("stream_ended", stream=stream, reason=reason)
        over = self._envelope(Kind.END, stream, NEVER if final_stamp is None else final_stamp, reason)
        self._send(stream, over, droppable=False)

    def _envelope(self, kind: Kind, stream: str, stamp: int, reason: str = "") -> Envelope:
        incarnation, seq = self._next.get(stream, (0, 0))
        return Envelope(kind, stream, incarnation, seq, stamp, reason=reason)

    def record(self, record: FiringRecord) -> None:
        """Keeps a record where it survives this process, ahead of the messages of its firing. Other work on
        the record of a firing follows its first message, which need not wait for that."""
        if self._unnoted is not None:
            self._note_last()
        if self._box is not None:
            self._box.keep(record)
        self._unnoted = record
        if record.kind not in ("fire", "tick"):
            self._note_last()

    def _note_last(self) -> None:
        """Gives the last record to the recorder's batch, and to requests for latencies."""
        record, self._unnoted = self._unnoted, None
        if record is None:
            return
        if self._box is not None:
            self._box.note(record)
        self.recent.add(record)
        if self._firings:
            log = self._logs.setdefault(record.operator, [])
            if log and log[-1].incarnation != record.incarnation:
                self.flush(record.operator)
            log.append(record)
            if len(log) >= BATCH_RECORDS or record.kind == "finish":
                self.flush(record.operator, last=record.kind == "finish")

    def flush(self, operator: str, *, last: bool = False) -> None:
        self._note_last()
        log = self._logs.get(operator)
        if log:
            self._send_records(operator, encode_batch(log, last=last))
            log.clear()

    def flush_due(self) -> None:
        """Sends the batches that have waited long enough."""
        if self._unnoted is not None:
            self._note_last()
        if time.monotonic() - self._flushed >= BATCH_SECONDS:
            self.flush_all()

    def flush_all(self) -> None:
        self._flushed = time.monotonic()
        self._note_last()
        for operator in self._logs:
            self.flush(operator)

    def send_again(self, operator: str) -> None:
        """Sends what is kept of an operator's firing records: the recorder lacks some, and leaves out what it has."""
        if self._box is None or not self._firings:
            return
        for part in consecutive(self._box.kept(operator)):
            for first in range(0, len(part), BATCH_RECORDS):
                self._send_records(operator, encode_batch(part[first : first + BATCH_RECORDS]))

    def put_raw(self, stream: str, payload: bytes) -> None:
        """Publishes bytes that are no envelope: a planned fault."""
        if self._network is not None:
            self._network.bus.session.put(stream, payload)


def incarnations_of(resumed: Mapping[str, ResumeState], outputs: Mapping[str, Mapping[str, str]]) -> dict[str, int]:
    """The incarnations that streams begin with, by stream; `outputs`: by operator, its ports and their streams."""
    return {stream: before.incarnation for operator, before in resumed.items() for stream in outputs[operator].values()}


def left_by(resumed: Mapping[str, ResumeState], outputs: Mapping[str, Mapping[str, str]]) -> dict[str, Place]:
    """The places that streams had reached in the process before this one, by stream (`outputs` as above)."""
    return {
        outputs[operator][port]: (incarnation, number)
        for operator, before in resumed.items()
        for port, (incarnation, number) in before.places.items()
    }
