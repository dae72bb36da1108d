"""A recorder from outside of a running graph: a plain subscriber, which takes what it is given and counts what it
missed.

It does not see the operators' calls, so its files hold no firing records.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from dataflow.client.attach import network_of, reached, types_of
from dataflow.graph.model import Graph
from dataflow.messages.base import Message, MessageError
from dataflow.recording import RecordingWriter
from dataflow.recording.layout import ENDS
from dataflow.recording.mcap.packing import Compression
from dataflow.recording.parts import OWNER_ONLY, WHOLE, Splitting, part_path, parts_of
from dataflow.transport import Bus, Envelope, Kind
from dataflow.transport.codec import TypeOf, decode
from dataflow.transport.envelope import DecodeError
from dataflow.transport.publisher import undeclare
from dataflow.transport.registry import RunningGraph
from dataflow.video.group import Groups

WAITING_BYTES = 512 * 2**20
"""Of messages that wait to be written: beyond it the oldest are let go, and counted as missed."""
FLUSH_EVERY = 1.0


@dataclass(slots=True)
class Tally:
    """Counts what was recorded so far: files, messages by stream, and by stream what was missed since the first one."""

    files: list[str] = field(default_factory=list)
    messages: dict[str, int] = field(default_factory=dict)
    missed: dict[str, int] = field(default_factory=dict)
    refused: int = 0
    """Envelopes that could not be read, or contradicted their stream."""
    bytes: int = 0

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "files": self.files,
            "messages": self.messages,
            "missed": self.missed,
            "refused": self.refused,
            "bytes": self.bytes,
        }


class AttachedRecorder:
    """Writes envelopes of a graph's streams into one file, or into one after the other. A context manager.

    `metadata` goes into each file. Static messages are written at the beginning of each, and the packets of video since
    the last key frame. Gaps are known from
    the numbers of messages, which have no gaps.
    """

    def __init__(
        self,
        path: Path,
        graph: Graph,
        streams: Sequence[str],
        *,
        metadata: Mapping[str, Mapping[str, str]],
        splitting: Splitting = WHOLE,
        compression: Compression = "zstd",
        overwrite: bool = False,
        mode: int = OWNER_ONLY,
        types: TypeOf | None = None,
    ) -> None:
        self._path, self._graph, self._streams = path, graph, frozenset(streams)
        self._metadata, self._splitting, self._overwrite = metadata, splitting, overwrite
        self._compression: Compression = compression
        self._mode = mode
        if overwrite and splitting.splits:
            for old in parts_of(path):
                old.unlink()
        self._types = types or types_of(graph)
        self._statics: dict[str, Envelope] = {}
        self._added: set[str] = set()
        self._due: dict[str, tuple[int, int]] = {}
        self._groups = Groups[Envelope]()
        self._stamps: dict[str, int] = {}
        self._ends: dict[str, dict[str, Any]] = {}
        self._first: int | None = None
        self._saved = self._front = 0
        self.tally = Tally()
        self._writer = self._open()

    @property
    def ended(self) -> bool:
        """Returns whether every stream has ended."""
        moving = {s for s in self._streams if not self._graph.streams[s].static}
        return bool(moving) and moving <= self._ends.keys()

    def take(self, payload: bytes) -> None:
        """Takes one encoded envelope. Raises `RecordingError` when the disk refuses."""
        try:
            envelope = decode(payload, types=self._types)
        except (DecodeError, MessageError):
            self.tally.refused += 1
            return
        if envelope.stream not in self._streams:
            return
        if envelope.kind is Kind.END:
            final = None if envelope.stamp < 0 else envelope.stamp
            self._ends[envelope.stream] = {"final": final, "reason": envelope.reason}
        elif envelope.kind is Kind.MESSAGE and envelope.message is not None:
            self._message(envelope, envelope.message)

    def flush(self) -> None:
        """Hands everything to the operating system: it survives the death of this process."""
        self._writer.flush()

    def close(self) -> Tally:
        """Completes the last file. Idempotent."""
        self._finish()
        return self.tally

    def __enter__(self) -> AttachedRecorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _message(self, envelope: Envelope, message: Message) -> None:
        stream, place = envelope.stream, (envelope.incarnation, envelope.seq)
        static = self._graph.streams[stream].static
        due = self._due.get(stream)
        if static:
            if stream in self._statics:
                return
            self._statics[stream] = envelope
        elif due is not None and (place < due or (place[0] == due[0] and message.stamp <= self._stamps[stream])):
            self.tally.refused += 1
            return
        self._groups.begin(stream, message, envelope.incarnation)
        if not static and self._split_due(message.stamp):
            self._finish()
            self._writer = self._open()
            for known in (*self._statics.values(), *(packet for _, packet in self._groups)):
                if known.message is not None:
                    self._write(known, known.message)
            self._front = self._writer.given_bytes
        if due is not None and not static:
            missed = place[1] - (due[1] if place[0] == due[0] else 0)
            if missed:
                self.tally.missed[stream] = self.tally.missed.get(stream, 0) + missed
        self._due[stream], self._stamps[stream] = (place[0], place[1] + 1), message.stamp
        if self._first is None and not static:
            self._first = message.stamp
        self._write(envelope, message)
        self._groups.add(stream, message, envelope)
        self.tally.messages[stream] = self.tally.messages.get(stream, 0) + 1
        self.tally.bytes = self._saved + self._writer.saved_bytes

    def _write(self, envelope: Envelope, message: Message) -> None:
        stream = envelope.stream
        if stream not in self._added:
            made = self._graph.streams[stream]
            extra = {"operator": made.node, "port": made.port}
            self._writer.add_stream(stream, type(message), static=made.static, extra=extra)
            self._added.add(stream)
        self._writer.write(stream, message, seq=envelope.seq, incarnation=envelope.incarnation)

    def _split_due(self, stamp: int) -> bool:
        if self._first is None:
            return False
        return self._splitting.due(self._writer.saved_bytes, stamp - self._first, self._front)

    def _open(self) -> RecordingWriter:
        path = self._path
        if self._splitting.splits:
            path = part_path(path, len(self.tally.files))
        writer = RecordingWriter(
            path,
            metadata=self._metadata,
            namespace=self._graph.namespace,
            compression=self._compression,
            overwrite=self._overwrite,
            mode=self._mode,
        )
        self.tally.files.append(str(path))
        self._added, self._first = set(), None
        return writer

    def _finish(self) -> None:
        if self._writer.closed:
            return
        if self._ends:
            self._writer.add_metadata(ENDS, {stream: json.dumps(end) for stream, end in self._ends.items()})
        try:
            self._writer.close()
        finally:
            self._saved += self._writer.saved_bytes
            self.tally.bytes = self._saved


class Subscription:
    """Envelopes of some streams as they come, in the order of each stream; those that wait too long are let go."""

    def __init__(self, most: int = WAITING_BYTES) -> None:
        self._most = most
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._arrived = threading.Condition()

    def put(self, payload: bytes) -> None:
        """Takes an envelope; on any thread."""
        with self._arrived:
            self._waiting.append(payload)
            self._bytes += len(payload)
            while self._bytes > self._most and len(self._waiting) > 1:
                self._bytes -= len(self._waiting.popleft())
            self._arrived.notify()

    def take(self, timeout: float) -> bytes | None:
        """The next one; None when none comes in time."""
        with self._arrived:
            if not self._waiting and not self._arrived.wait(timeout):
                return None
            if not self._waiting:
                return None
            payload = self._waiting.popleft()
            self._bytes -= len(payload)
            return payload


@contextmanager
def subscribed(found: RunningGraph, streams: Sequence[str]) -> Iterator[Subscription]:
    """A subscription to streams of a running graph, the static ones first."""
    with Bus(network_of(found)) as bus:
        subscription = Subscription()
        callback: Any = zenoh.handlers.Callback(lambda sample: subscription.put(bytes(sample.payload)), indirect=False)
        declared = [bus.session.declare_subscriber(stream, callback) for stream in streams]
        reached(bus, found)
        for stream, payload in sorted(bus.query_static(found.namespace, timeout=1.0).items()):
            if stream in streams:
                subscription.put(payload)
        try:
            yield subscription
        finally:
            for subscriber in declared:
                undeclare(subscriber)


def record(
    subscription: Subscription, recorder: AttachedRecorder, *, goes_on: Iterator[bool], idle: float = 0.1
) -> None:
    """Writes what comes until `goes_on` returns False; then what still waits. Raises `RecordingError`."""
    due = time.monotonic() + FLUSH_EVERY
    for on in goes_on:
        payload = subscription.take(idle if on else 0.0)
        if payload is not None:
            recorder.take(payload)
        if time.monotonic() >= due:
            recorder.flush()
            due = time.monotonic() + FLUSH_EVERY
        if recorder.ended:
            break
    while (payload := subscription.take(0.0)) is not None:
        recorder.take(payload)
