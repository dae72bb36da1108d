"""A tool's side of taps: what the processes of a graph send it, and the acknowledgements."""

from __future__ import annotations

import secrets
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Self

import msgpack
import zenoh

from dataflow.messages.base import message_type
from dataflow.transport.bus import Bus
from dataflow.transport.codec import TypeOf, decode, decode_head
from dataflow.transport.envelope import DEFAULT_LIMITS, Envelope, Head, Limits
from dataflow.transport.keys import runtime_key, statics_key, stream_of_tap
from dataflow.transport.publisher import undeclare
from dataflow.transport.taps import ATTACHMENT, MAX_EXPRESSIONS, TapWindow, process_text, write_acknowledgement

MAX_PROCESSES = 1024


@dataclass(frozen=True, slots=True)
class TapMessage:
    """A copy of what a process published: the stream and the encoded envelope. `types`: the class of a schema name."""

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
    """State of one process at a tap: its counts as received, as taken, and as acknowledged."""

    epoch: int = 0
    received: tuple[int, int] = (0, 0)
    taken: tuple[int, int] = (0, 0)
    acked: tuple[int, int] = (0, 0)
    lost: deque[int] = field(default_factory=deque)
    skipped: int = 0

    def receive(self, counts: tuple[int, int], skipped: int, window: int, *, sync: bool) -> None:
        """Notes the counts of a sample, and which messages before it never came, as far as a window back. The process
        sends nothing beyond a window that was not acknowledged, so an older loss has been reported."""
        messages = counts[0]
        end = messages + 1 if sync else messages
        while self.lost and self.lost[0] < end - window:
            self.lost.popleft()
        self.lost.extend(range(max(self.received[0] + 1, end - window), end))
        self.received, self.skipped = counts, skipped

    def acknowledgement(self) -> bytes:
        """Acknowledges what was taken, with the numbers of those that were lost before it."""
        self.acked = self.taken
        return write_acknowledgement(self.epoch, *self.taken, [n for n in self.lost if n <= self.taken[0]])


class TapClient:
    """The tool's side: receives copies of the streams that match `expressions` (stream key expressions).

    The latest static messages that match come first. Messages are acknowledged when taken, so at most `window` waits
    here for each process, however slow the tool is.
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
        """Raises `ValueError` for an expression that is none. Waits at most `statics_within` s for the statics. `types`
        gives the class of a schema name, which messages are decoded as."""
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
        """Messages that the processes left out, as far as they have said."""
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
                stream, payload, process, counts, epoch = self._queue.popleft()
                acks = self._taken(process, counts, epoch)
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

    def __exit__(self, *_: object) -> None:
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
            process, epoch, messages, nbytes, skipped = ATTACHMENT.unpack(
                bytes(attached) if attached is not None else b""
            )
        except struct.error:
            self.refused += 1
            return
        key = str(sample.key_expr)
        payload = bytes(sample.payload)
        with self._arrived:
            if process not in self._origins and len(self._origins) >= MAX_PROCESSES:
                self.refused += 1
                return
            origin = self._origins.setdefault(process, _Origin())
            if epoch != origin.epoch:
                origin = self._origins[process] = _Origin(epoch)
            if payload and not self._fits(origin, messages, nbytes):
                self.refused += 1
                return
            origin.receive((messages, nbytes), skipped, self.window.messages, sync=not payload)
            stream = stream_of_tap(self._namespace, self.id, key) if payload else ""
            self._queue.append((stream, payload, process, (messages, nbytes), epoch))
            self._arrived.notify()

    def _fits(self, origin: _Origin, messages: int, nbytes: int) -> bool:
        """Returns whether a process keeps to the window: a single message may exceed it in bytes."""
        if messages - origin.acked[0] > self.window.messages:
            return False
        return nbytes - origin.acked[1] <= self.window.bytes or messages - origin.acked[0] == 1

    def _taken(self, process: bytes, counts: tuple[int, int], epoch: int) -> list[tuple[str, bytes]]:
        """Notes that a message was taken; returns the acknowledgements that are due (key, payload)."""
        origin = self._origins[process]
        if origin.epoch == epoch:
            origin.taken = counts
        due = []
        for other, state in self._origins.items():
            messages, nbytes = state.taken[0] - state.acked[0], state.taken[1] - state.acked[1]
            sync = counts == state.acked and other == process
            enough = messages * 4 >= self.window.messages or nbytes * 4 >= self.window.bytes
            if sync or (messages and (enough or not self._queue)):
                key = runtime_key(self._namespace, "ack", process_text(other), self.id)
                due.append((key, state.acknowledgement()))
        return due


def held_statics(bus: Bus, namespace: str, timeout: float) -> list[set[str]]:
    """Returns the static streams that each process of a graph holds now, of those that answer within `timeout` s."""
    answers = bus.ask(statics_key(namespace, "*"), timeout=timeout)
    return [set(msgpack.unpackb(answer, raw=False)) for answer in answers]
