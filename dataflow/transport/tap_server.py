"""A process's side of taps: copies of what it publishes, within each tap's window."""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Self

import msgpack
import zenoh

from dataflow.transport.bus import Bus
from dataflow.transport.codec import encode
from dataflow.transport.envelope import Envelope
from dataflow.transport.keys import runtime_key, statics_key, tap_key
from dataflow.transport.publisher import undeclare
from dataflow.transport.taps import ATTACHMENT, TapWindow, process_bytes, read_acknowledgement, read_spec

SYNC_EVERY = 0.5
SPEC_WITHIN = 10.0
CLOSE_WITHIN = 2.0
MAX_TAPS = 64
ENVELOPE_OVERHEAD = 512


class _Copy:
    """A published message on its way to the taps; encoded at most once, when the first tap has credit for it."""

    __slots__ = ("_envelope", "_payload", "size")

    def __init__(self, envelope: Envelope) -> None:
        self._envelope: Envelope | None = envelope
        self._payload = b""
        self.size = ENVELOPE_OVERHEAD + (envelope.message.nbytes() if envelope.message is not None else 0)

    def payload(self) -> bytes:
        if self._envelope is not None:
            self._payload, self._envelope = encode(self._envelope), None
        return self._payload


@dataclass(slots=True)
class _Tap:
    """State of one tap at a process. Counts are cumulative."""

    id: str
    expressions: tuple[zenoh.KeyExpr, ...]
    window: TapWindow
    epoch: int
    sent_messages: int = 0
    sent_bytes: int = 0
    acked_messages: int = 0
    acked_bytes: int = 0
    skipped: int = 0
    quiet_since: float = field(default_factory=time.monotonic)
    under_way: dict[str, tuple[int, _Copy]] = field(default_factory=dict)
    """The newest copy sent of each stream, with its number, until it is acknowledged."""
    pending: dict[str, deque[_Copy]] = field(default_factory=dict)
    pending_count: int = 0
    matches: dict[str, bool] = field(default_factory=dict)

    def wants(self, stream: str) -> bool:
        found = self.matches.get(stream)
        if found is None:
            key = zenoh.KeyExpr(stream)
            found = self.matches[stream] = any(e.intersects(key) for e in self.expressions)
        return found

    def offer(self, stream: str, copy: _Copy) -> None:
        """Queues `copy`; beyond the credit, the oldest queued message of the same stream is skipped."""
        queue = self.pending.setdefault(stream, deque())
        queue.append(copy)
        self.pending_count += 1
        if len(queue) > 1 and self.pending_count > self.window.messages - (self.sent_messages - self.acked_messages):
            queue.popleft()
            self.pending_count -= 1
            self.skipped += 1

    def next(self) -> tuple[str, _Copy] | None:
        """The next copy that fits the window, the streams in turn; None while nothing does."""
        outstanding = self.sent_bytes - self.acked_bytes
        if self.sent_messages - self.acked_messages >= self.window.messages:
            return None
        for stream, queue in self.pending.items():
            if queue and (outstanding == 0 or outstanding + queue[0].size <= self.window.bytes):
                copy = queue.popleft()
                self.pending_count -= 1
                self.pending[stream] = self.pending.pop(stream)  # to the end: its turn is over
                self.sent_messages += 1
                self.sent_bytes += copy.size
                self.under_way[stream] = self.sent_messages, copy
                return stream, copy
        return None

    def acknowledge(self, messages: int, nbytes: int, lost: frozenset[int]) -> int:
        """Takes a cumulative acknowledgement; returns how many copies were `lost` that were believed to be sent.

        The newest of each stream is queued again when it was lost; the other lost copies count as skipped. An
        acknowledgement of what was never sent, or one that is older than the last, changes nothing.
        """
        if not self.acked_messages <= messages <= self.sent_messages:
            return 0
        if not self.acked_bytes <= nbytes <= self.sent_bytes:
            return 0
        lost = frozenset(number for number in lost if self.acked_messages < number <= messages)
        self.acked_messages, self.acked_bytes = messages, nbytes
        self.quiet_since = time.monotonic()
        self.skipped += len(lost)
        for stream, (number, copy) in list(self.under_way.items()):
            if number > messages:
                continue
            del self.under_way[stream]
            if number in lost and not self.pending.get(stream):
                self.pending.setdefault(stream, deque()).append(copy)
                self.pending_count += 1
                self.skipped -= 1
        return len(lost)

    def attachment(self, process: bytes) -> bytes:
        return ATTACHMENT.pack(process, self.epoch, self.sent_messages, self.sent_bytes, self.skipped)


class TapServer:
    """The process's side: keeps the taps of its namespace and sends them copies of what the process publishes. `active`
    is False while there is no tap: publishers look at it before they call `offer`."""

    def __init__(self, bus: Bus, namespace: str) -> None:
        self.active = False
        self._bus = bus
        self._namespace = namespace
        self._process = process_bytes(bus.id)
        self._taps: dict[str, _Tap] = {}
        self._epochs = itertools.count(1)
        self._wake = threading.Condition()
        self._closed = False
        self._worker: threading.Thread | None = None
        self._sent = self._skipped_before = self.malformed = 0
        session = bus.session
        self._statics = bus.serve(statics_key(namespace, bus.id), self._answer_statics)
        self._acks = session.declare_subscriber(
            runtime_key(namespace, "ack", bus.id, "*"), zenoh.handlers.Callback(self._on_ack, indirect=False)
        )
        self._tokens = session.liveliness().declare_subscriber(
            runtime_key(namespace, "taps", "*"), zenoh.handlers.Callback(self._on_token, indirect=False), history=True
        )

    def offer(self, stream: str, envelope: Envelope) -> None:
        """Makes a published message available to the taps. Never waits."""
        if not self.active:
            return
        copy: _Copy | None = None
        with self._wake:
            for tap in self._taps.values():
                if tap.wants(stream):
                    copy = copy or _Copy(envelope)
                    tap.offer(stream, copy)
            if copy is not None:
                self._wake.notify()

    def counters(self) -> dict[str, int]:
        """Taps now, and copies sent (those known to be lost not counted) and skipped since the start."""
        with self._wake:
            skipped = self._skipped_before + sum(t.skipped for t in self._taps.values())
            return {"taps": len(self._taps), "sent": self._sent, "skipped": skipped, "malformed": self.malformed}

    def close(self) -> None:
        """Ends all taps, in bounded time (`undeclare`, `CLOSE_WITHIN`); further calls do nothing."""
        with self._wake:
            if self._closed:
                return
            self._closed, self.active = True, False
            self._taps.clear()
            self._wake.notify_all()
        undeclare(self._tokens)
        undeclare(self._acks)
        self._statics.close()
        if self._worker is not None:
            self._worker.join(CLOSE_WITHIN)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Zenoh's threads

    def _answer_statics(self, query: zenoh.Query) -> None:
        with query:
            query.reply(statics_key(self._namespace, self._bus.id), msgpack.packb(self._bus.statics()))

    def _on_token(self, sample: zenoh.Sample) -> None:
        tap_id = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.DELETE:
            with self._wake:
                self._drop(tap_id)
            return

        def on_reply(reply: zenoh.Reply) -> None:
            self._on_spec(tap_id, reply)

        self._bus.session.get(
            runtime_key(self._namespace, "taps", tap_id),
            zenoh.handlers.Callback(on_reply, indirect=False),
            timeout=SPEC_WITHIN,
        )

    def _on_spec(self, tap_id: str, reply: zenoh.Reply) -> None:
        sample = reply.ok
        if sample is None:
            return
        try:
            expressions, window = read_spec(bytes(sample.payload))
        except ValueError:
            self.malformed += 1
            return
        with self._wake:
            if self._closed or (tap_id not in self._taps and len(self._taps) >= MAX_TAPS):
                return
            self._drop(tap_id)
            self._taps[tap_id] = _Tap(tap_id, expressions, window, next(self._epochs))
            self.active = True
            if self._worker is None:
                self._worker = threading.Thread(target=self._work, name="taps", daemon=True)
                self._worker.start()

    def _on_ack(self, sample: zenoh.Sample) -> None:
        tap_id = str(sample.key_expr).rpartition("/")[2]
        with self._wake:
            tap = self._taps.get(tap_id)
            if tap is None:
                return
            try:
                epoch, messages, nbytes, lost = read_acknowledgement(bytes(sample.payload), tap.window.messages)
            except ValueError:
                self.malformed += 1
                return
            if tap.epoch == epoch:
                self._sent -= tap.acknowledge(messages, nbytes, lost)
                self._wake.notify()

    def _drop(self, tap_id: str) -> None:
        tap = self._taps.pop(tap_id, None)
        if tap is not None:
            self._skipped_before += tap.skipped + tap.pending_count
        self.active = bool(self._taps)

    # The taps' own thread

    def _work(self) -> None:
        while True:
            with self._wake:
                if self._closed:
                    return
                due = self._due()
                if not due:
                    self._wake.wait(SYNC_EVERY)
                    continue
            for key, copy, attachment in due:
                self._put(key, copy.payload() if copy is not None else b"", attachment)

    def _due(self) -> list[tuple[str, _Copy | None, bytes]]:
        """One copy for each tap that has credit; a sync for each that has acknowledged nothing for a while."""
        due: list[tuple[str, _Copy | None, bytes]] = []
        now = time.monotonic()
        for tap in self._taps.values():
            found = tap.next()
            if found is not None:
                stream, copy = found
                due.append((tap_key(self._namespace, tap.id, stream), copy, tap.attachment(self._process)))
                self._sent += 1
            elif tap.sent_messages > tap.acked_messages and now - tap.quiet_since >= SYNC_EVERY:
                tap.quiet_since = now
                due.append((runtime_key(self._namespace, "tap", tap.id), None, tap.attachment(self._process)))
        return due

    def _put(self, key: str, payload: bytes, attachment: bytes) -> None:
        try:
            self._bus.session.put(
                key,
                payload,
                attachment=attachment,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW,
            )
        except zenoh.ZError:  # the session is closing under us: no receiver is left
            with self._wake:
                for tap_id in list(self._taps):
                    self._drop(tap_id)
