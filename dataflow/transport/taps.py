"""Taps: lossy, credit-limited copies of streams for viewers and tools, which can therefore never slow a producer.

A tap names the streams it wants and a window. A host sends it copies only while what it has not yet acknowledged fits
the window; beyond that the newest message of each stream waits, and older ones are skipped and counted. Copies are
encoded and sent by a thread of their own. The protocol is specified in `docs/wire-format.md`.
"""

from __future__ import annotations

import itertools
import secrets
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Final, Self

import msgpack
import zenoh

from dataflow.messages.base import message_type
from dataflow.transport.bus import Bus, undeclare
from dataflow.transport.codec import DEFAULT_LIMITS, Envelope, Head, Limits, TypeOf, decode, decode_head, encode
from dataflow.transport.keys import runtime_key, stream_of_tap, tap_key

SYNC_EVERY = 0.5
SPEC_WITHIN = 10.0
CLOSE_WITHIN = 2.0
MAX_TAPS = 64
MAX_EXPRESSIONS = 64
MAX_WINDOW_MESSAGES = 1 << 16
MAX_WINDOW_BYTES = 1 << 30
MAX_HOSTS = 1024
SPEC_BYTES = 1 << 16
ENVELOPE_OVERHEAD = 512

ATTACHMENT: Final = struct.Struct("<16sIQQQ")  # host, epoch, messages, bytes, skipped
ACKNOWLEDGEMENT: Final = struct.Struct("<IQQ")  # epoch, messages, bytes


@dataclass(frozen=True, slots=True)
class TapWindow:
    """How much may be under way from one host to a tap, unacknowledged. It bounds the tap's memory."""

    messages: int = 64
    bytes: int = 16 << 20

    def __post_init__(self) -> None:
        if not (1 <= self.messages <= MAX_WINDOW_MESSAGES and 1 <= self.bytes <= MAX_WINDOW_BYTES):
            raise ValueError(
                f"tap window of {self.messages} messages and {self.bytes} bytes: "
                f"expected 1 to {MAX_WINDOW_MESSAGES} messages and 1 to {MAX_WINDOW_BYTES} bytes"
            )


class _Copy:
    """A published message on its way to the taps; encoded at most once, when the first tap has credit for it."""

    __slots__ = ("_envelope", "_payload", "size")

    def __init__(self, item: Envelope | bytes) -> None:
        if isinstance(item, Envelope):
            self._envelope: Envelope | None = item
            self._payload = b""
            self.size = ENVELOPE_OVERHEAD + (item.message.nbytes() if item.message is not None else 0)
        else:
            self._envelope, self._payload, self.size = None, item, len(item)

    def payload(self) -> bytes:
        if self._envelope is not None:
            self._payload, self._envelope = encode(self._envelope), None
        return self._payload


@dataclass(slots=True)
class _Tap:
    """What a host knows of one tap. Counts are cumulative."""

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
                return stream, copy
        return None

    def acknowledge(self, messages: int, nbytes: int) -> None:
        """Takes a cumulative acknowledgement; one that was never sent, or is older than the last, changes nothing."""
        if self.acked_messages <= messages <= self.sent_messages and self.acked_bytes <= nbytes <= self.sent_bytes:
            self.acked_messages, self.acked_bytes = messages, nbytes
            self.quiet_since = time.monotonic()

    def attachment(self, host: bytes) -> bytes:
        return ATTACHMENT.pack(host, self.epoch, self.sent_messages, self.sent_bytes, self.skipped)


class TapServer:
    """The host's side: knows the taps of its namespace and sends them copies of what the host publishes.

    `active` is False while there is no tap: publishers look at it before they call `offer`.
    """

    def __init__(self, bus: Bus, namespace: str) -> None:
        self.active = False
        self._bus = bus
        self._namespace = namespace
        self._host = _host_bytes(bus.id)
        self._taps: dict[str, _Tap] = {}
        self._epochs = itertools.count(1)
        self._wake = threading.Condition()
        self._closed = False
        self._worker: threading.Thread | None = None
        self._sent = self._skipped_before = self.malformed = 0
        session = bus.session
        self._acks = session.declare_subscriber(
            runtime_key(namespace, "ack", bus.id, "*"), zenoh.handlers.Callback(self._on_ack, indirect=False)
        )
        self._tokens = session.liveliness().declare_subscriber(
            runtime_key(namespace, "taps", "*"), zenoh.handlers.Callback(self._on_token, indirect=False), history=True
        )

    def offer(self, stream: str, item: Envelope | bytes) -> None:
        """Makes a published message (its envelope, or its encoded bytes) available to the taps. Never waits."""
        if not self.active:
            return
        copy: _Copy | None = None
        with self._wake:
            for tap in self._taps.values():
                if tap.wants(stream):
                    copy = copy or _Copy(item)
                    tap.offer(stream, copy)
            if copy is not None:
                self._wake.notify()

    def counters(self) -> dict[str, int]:
        """Taps now, and copies sent and skipped since the start."""
        with self._wake:
            skipped = self._skipped_before + sum(t.skipped for t in self._taps.values())
            return {"taps": len(self._taps), "sent": self._sent, "skipped": skipped, "malformed": self.malformed}

    def close(self) -> None:
        """Ends all taps. Takes at most `CLOSE_WITHIN` seconds; further calls do nothing."""
        with self._wake:
            if self._closed:
                return
            self._closed, self.active = True, False
            self._taps.clear()
            self._wake.notify_all()
        undeclare(self._tokens)
        undeclare(self._acks)
        if self._worker is not None:
            self._worker.join(CLOSE_WITHIN)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Zenoh's threads

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
            expressions, window = _read_spec(bytes(sample.payload))
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
        try:
            epoch, messages, nbytes = ACKNOWLEDGEMENT.unpack(bytes(sample.payload))
        except struct.error:
            self.malformed += 1
            return
        with self._wake:
            tap = self._taps.get(tap_id)
            if tap is not None and tap.epoch == epoch:
                tap.acknowledge(messages, nbytes)
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
                due.append((tap_key(self._namespace, tap.id, stream), copy, tap.attachment(self._host)))
                self._sent += 1
            elif tap.sent_messages > tap.acked_messages and now - tap.quiet_since >= SYNC_EVERY:
                tap.quiet_since = now
                due.append((runtime_key(self._namespace, "tap", tap.id), None, tap.attachment(self._host)))
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
        except zenoh.ZError:  # the session is closing under us: there is nobody left to send to
            with self._wake:
                for tap_id in list(self._taps):
                    self._drop(tap_id)


@dataclass(frozen=True, slots=True)
class TapMessage:
    """A copy of what a host published: the stream and the encoded envelope. `types`: the class of a schema name."""

    stream: str
    payload: bytes
    types: TypeOf = message_type

    def head(self, limits: Limits = DEFAULT_LIMITS) -> Head:
        """The envelope's head alone; raises `DecodeError`."""
        return decode_head(self.payload, limits)

    def decode(self, limits: Limits = DEFAULT_LIMITS) -> Envelope:
        """The envelope; raises `DecodeError`."""
        return decode(self.payload, limits, self.types)


@dataclass(slots=True)
class _Origin:
    """What a tap knows of one host: its counts as received, as taken, and as acknowledged."""

    epoch: int = 0
    received: tuple[int, int] = (0, 0)
    taken: tuple[int, int] = (0, 0)
    acked: tuple[int, int] = (0, 0)
    skipped: int = 0


class TapClient:
    """The tool's side: receives copies of the streams that match `expressions` (stream key expressions).

    The latest static messages that match come first. What is not taken is not acknowledged, so at most `window` waits
    here for each host, however slow the tool is.
    """

    def __init__(
        self,
        bus: Bus,
        namespace: str,
        expressions: Sequence[str] = ("**",),
        window: TapWindow | None = None,
        *,
        statics_within: float = 1.0,
        types: TypeOf = message_type,
    ) -> None:
        """Raises `ValueError` for an expression that is none. Waits at most `statics_within` s for the statics.

        `types` gives the class of a schema name, which messages are decoded as.
        """
        self._types = types
        self.window = window or TapWindow()
        self.id = secrets.token_hex(8)
        try:
            self._expressions = tuple(zenoh.KeyExpr.autocanonize(e) for e in expressions)
        except zenoh.ZError as error:
            raise ValueError(f"tap expressions {list(expressions)}: {error}") from None
        if not 1 <= len(self._expressions) <= MAX_EXPRESSIONS:
            raise ValueError(f"a tap takes 1 to {MAX_EXPRESSIONS} expressions, got {len(self._expressions)}")
        self._bus, self._namespace = bus, namespace
        self._queue: deque[tuple[str, bytes, bytes, tuple[int, int], int]] = deque()
        self._arrived = threading.Condition()
        self._origins: dict[bytes, _Origin] = {}
        self.refused = 0
        """Samples beyond the window or without the protocol's attachment."""
        self._closed = False
        statics = bus.query_static(namespace, timeout=statics_within)
        self._statics = deque(
            TapMessage(stream, payload, types) for stream, payload in sorted(statics.items()) if self._wants(stream)
        )
        session = bus.session
        self._subscriber = session.declare_subscriber(
            runtime_key(namespace, "tap", self.id, "**"), zenoh.handlers.Callback(self._on_sample, indirect=False)
        )
        key = runtime_key(namespace, "taps", self.id)
        self._spec = session.declare_queryable(key, zenoh.handlers.Callback(self._answer(key), indirect=False))
        self._token = session.liveliness().declare_token(key)

    @property
    def skipped(self) -> int:
        """Messages that the hosts left out, as far as they have said."""
        with self._arrived:
            return sum(o.skipped for o in self._origins.values())

    def take(self, timeout: float = 0.0) -> TapMessage | None:
        """The next message; None when none came within `timeout` seconds. Taking is what acknowledges."""
        if self._statics:
            return self._statics.popleft()
        end = time.monotonic() + timeout
        while True:
            with self._arrived:
                while not self._queue:
                    left = end - time.monotonic()
                    if left <= 0 or self._closed:
                        return None
                    self._arrived.wait(left)
                stream, payload, host, counts, epoch = self._queue.popleft()
                acks = self._taken(host, counts, epoch)
            for key, ack in acks:
                self._bus.session.put(key, ack, congestion_control=zenoh.CongestionControl.DROP, express=True)
            if stream:
                return TapMessage(stream, payload, self._types)

    def close(self) -> None:
        """Ends the tap; further calls do nothing."""
        with self._arrived:
            if self._closed:
                return
            self._closed = True
            self._queue.clear()
            self._arrived.notify_all()
        for declared in (self._token, self._spec, self._subscriber):
            undeclare(declared)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _wants(self, stream: str) -> bool:
        key = zenoh.KeyExpr(stream)
        return any(e.intersects(key) for e in self._expressions)

    def _answer(self, key: str) -> Callable[[zenoh.Query], None]:
        spec = msgpack.packb(
            {
                "expressions": [str(e) for e in self._expressions],
                "messages": self.window.messages,
                "bytes": self.window.bytes,
            }
        )

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(key, spec)

        return answer

    def _on_sample(self, sample: zenoh.Sample) -> None:
        attached = sample.attachment
        try:
            host, epoch, messages, nbytes, skipped = ATTACHMENT.unpack(bytes(attached) if attached is not None else b"")
        except struct.error:
            self.refused += 1
            return
        key = str(sample.key_expr)
        payload = bytes(sample.payload)
        with self._arrived:
            if host not in self._origins and len(self._origins) >= MAX_HOSTS:
                self.refused += 1
                return
            origin = self._origins.setdefault(host, _Origin())
            if epoch != origin.epoch:
                origin.epoch, origin.received, origin.taken, origin.acked = epoch, (0, 0), (0, 0), (0, 0)
            if payload and not self._fits(origin, messages, nbytes):
                self.refused += 1
                return
            origin.received, origin.skipped = (messages, nbytes), skipped
            stream = stream_of_tap(self._namespace, self.id, key) if payload else ""
            self._queue.append((stream, payload, host, (messages, nbytes), epoch))
            self._arrived.notify()

    def _fits(self, origin: _Origin, messages: int, nbytes: int) -> bool:
        """Whether a host keeps to the window: a single message may exceed it in bytes."""
        if messages - origin.acked[0] > self.window.messages:
            return False
        return nbytes - origin.acked[1] <= self.window.bytes or messages - origin.acked[0] == 1

    def _taken(self, host: bytes, counts: tuple[int, int], epoch: int) -> list[tuple[str, bytes]]:
        """Notes that a message was taken; returns the acknowledgements that are due (key, payload)."""
        origin = self._origins[host]
        if origin.epoch == epoch:
            origin.taken = counts
        due = []
        for other, state in self._origins.items():
            messages, nbytes = state.taken[0] - state.acked[0], state.taken[1] - state.acked[1]
            sync = counts == state.acked and other == host
            enough = messages * 4 >= self.window.messages or nbytes * 4 >= self.window.bytes
            if sync or (messages and (enough or not self._queue)):
                state.acked = state.taken
                key = runtime_key(self._namespace, "ack", _host_text(other), self.id)
                due.append((key, ACKNOWLEDGEMENT.pack(state.epoch, *state.taken)))
        return due


def _read_spec(data: bytes) -> tuple[tuple[zenoh.KeyExpr, ...], TapWindow]:
    """The expressions and the window that a tap asks for; raises `ValueError`."""
    if len(data) > SPEC_BYTES:
        raise ValueError(f"tap request of {len(data)} bytes, at most {SPEC_BYTES}")
    try:
        spec: Any = msgpack.unpackb(data, raw=False, max_array_len=MAX_EXPRESSIONS, max_map_len=8, max_ext_len=0)
        expressions = tuple(zenoh.KeyExpr(str(e)) for e in spec["expressions"])
        return expressions, TapWindow(int(spec["messages"]), int(spec["bytes"]))
    except Exception as error:  # msgpack, Zenoh and the wrong types raise a dozen kinds
        raise ValueError(f"tap request: {error}") from None


def _host_bytes(bus_id: str) -> bytes:
    """A bus id (hexadecimal, up to 16 bytes) as 16 bytes."""
    return bytes.fromhex(bus_id.zfill(32))


def _host_text(host: bytes) -> str:
    return host.hex().lstrip("0")
