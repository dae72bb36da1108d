"""The bus: one Zenoh session of one process, with exactly the operations that streams need.

Callbacks run on Zenoh's threads. They must only append to a queue: a callback that waits stalls every stream of the
process.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import zenoh

from dataflow.transport.codec import Buffer, DecodeError, Envelope, Kind, encode_head, encode_parts, parts_size
from dataflow.transport.keys import RUNTIME, alive_key, alive_name, shared_key, static_key, stream_of_static
from dataflow.transport.network import NetworkConfig
from dataflow.transport.shared import (
    SUPPORTED,
    THRESHOLD,
    Board,
    BoardReader,
    PoolReader,
    SharedMemoryError,
    SharedPool,
    is_reference,
    machine,
)

CLOSE_WITHIN = 20.0
MAPPED_WITHIN = 1.0

Receive = Callable[[Buffer], object]


class BusError(RuntimeError):
    """The network refused: says which operation, on which key, and why."""


@dataclass(slots=True)
class Counters:
    """What a bus has moved since it was opened."""

    sent_messages: int = 0
    sent_bytes: int = 0
    received_messages: int = 0
    received_bytes: int = 0
    shared_messages: int = 0
    """Of those sent, the ones that went through shared memory."""
    shared_bytes: int = 0
    shared_full: int = 0
    """Large messages that travelled whole because the pool had no room."""
    shared_unready: int = 0
    """Large messages that travelled whole because not all consumers could share memory (yet)."""
    unresolved: int = 0
    """References received whose memory could not be opened."""


class StreamPublisher:
    """Publishes one stream: in order, reliably; waits when a consumer's link is full."""

    def __init__(self, bus: Bus, stream: str, publisher: zenoh.Publisher, sharing: _Sharing | None) -> None:
        self.stream = stream
        self._bus = bus
        self._publisher = publisher
        self._sharing = sharing
        self._probes = 0

    def put(self, envelope: Envelope) -> int:
        """Publishes an envelope, through shared memory where all consumers can take it from there; returns its bytes.

        Raises `BusError` when the bus is closed.
        """
        parts = encode_parts(envelope)
        size = parts_size(parts)
        reference = None
        if self._sharing is not None and size >= THRESHOLD:
            reference = self._sharing.share(envelope, parts, size)
        self._put(b"".join(parts) if reference is None else reference, size)
        return size

    def put_bytes(self, payload: bytes) -> int:
        """Publishes bytes as they are: an encoded envelope, or, on the runtime's own keys, anything."""
        self._put(payload, len(payload))
        return len(payload)

    def probe(self, number: int | None = None) -> int:
        """Sends a numbered probe on the data key, for the start barrier; returns its number."""
        self._probes = self._probes + 1 if number is None else number
        self.put(Envelope(Kind.PROBE, self.stream, 0, self._probes, 0))
        return self._probes

    @property
    def shares(self) -> bool:
        """Whether large messages go through shared memory now: all consumers are known and on this machine."""
        return self._sharing is not None and self._sharing.ready

    def close(self) -> None:
        undeclare(self._publisher)
        if self._sharing is not None:
            self._sharing.close()

    def _put(self, payload: bytes, size: int) -> None:
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            raise BusError(f"publishing {size} bytes on {self.stream!r}: {error}") from error
        self._bus.count_sent(size)


class _Sharing:
    """The consumers of one stream that can read shared memory. A reference is sent only when that is all of them."""

    def __init__(self, bus: Bus, stream: str, consumers: int) -> None:
        self._bus = bus
        self._expected = consumers
        self._machine = machine()
        self._lock = threading.Lock()
        self._boards: dict[str, BoardReader] = {}
        self._all: tuple[BoardReader, ...] = ()
        self._watch = bus.session.liveliness().declare_subscriber(
            shared_key(stream, "*", "*", "*", "*"),
            zenoh.handlers.Callback(self._on_token, indirect=False),
            history=True,
        )

    @property
    def ready(self) -> bool:
        return len(self._all) == self._expected

    def share(self, envelope: Envelope, parts: list[Buffer], size: int) -> bytes | None:
        """The reference to send instead of the envelope; None when it must travel whole (counted)."""
        claims = self._all
        if len(claims) != self._expected:
            self._bus.counted.shared_unready += 1
            return None
        return self._bus.share(envelope, parts, size, claims)

    def close(self) -> None:
        undeclare(self._watch)

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        machine_name, pid, descriptor, _ = key.rsplit("/", 4)[1:]
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                gone = self._boards.pop(key, None)
                if gone is not None:
                    gone.lost = True
            elif machine_name == self._machine and pid.isdigit() and descriptor.isdigit():
                try:
                    self._boards[key] = BoardReader(int(pid), int(descriptor), key)
                except SharedMemoryError:  # it stays out: then the stream travels whole, counted as `shared_unready`
                    return
            self._all = tuple(self._boards.values())


def undeclare(declared: Any) -> None:
    """Ends a Zenoh declaration; one that ended already (with its session) is left alone."""
    try:
        declared.undeclare()
    except zenoh.ZError as error:
        if "closed" not in str(error).lower() and "undeclared" not in str(error).lower():
            raise BusError(f"undeclaring {declared}: {error}") from error


class Token:
    """A declaration that lasts until `close` (or the end of the bus)."""

    def __init__(self, *declared: Any, board: Board | None = None) -> None:
        self._declared = declared
        self._board = board

    def close(self) -> None:
        for declared in self._declared:
            undeclare(declared)
        if self._board is not None:
            self._board.close()
            self._board = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Bus:
    """One process's place in the network. Thread-safe; close it (it is a context manager)."""

    def __init__(self, config: NetworkConfig | None = None) -> None:
        """Opens the session; peers that are not up yet are connected to later.

        Raises `BusError` when an endpoint cannot be listened on, `NetworkError` for settings Zenoh does not take.
        """
        self.config = config or NetworkConfig()
        try:
            self.session = zenoh.open(self.config.zenoh_config())
        except zenoh.ZError as error:
            raise BusError(f"cannot listen on {', '.join(self.config.listen) or 'nothing'}: {error}") from error
        self.id = str(self.session.zid())
        self.counted = Counters()
        self._lock = threading.Lock()
        self._pool: SharedPool | None = None
        self._pools = PoolReader()
        self._shares = self.config.shared_memory and SUPPORTED
        self._tokens: list[Token] = []
        self._declared: dict[str, zenoh.Queryable[None]] = {}
        self._static: dict[str, bytes] = {}
        self._closed = False

    # Streams

    def publisher(self, stream: str, *, consumers: int = 0) -> StreamPublisher:
        """A publisher of the key `stream`: reliable, blocking, in order.

        `consumers` is the number of subscriptions to the stream (`subscribe` calls) in all other hosts, if known: when
        all of them are on this machine, large messages go through shared memory. 0: nothing is shared.
        """
        publisher = self.session.declare_publisher(
            stream,
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=True,
        )
        sharing = _Sharing(self, stream, consumers) if consumers and self._can_share(stream) else None
        return StreamPublisher(self, stream, publisher, sharing)

    def subscribe(self, key: str, receive: Receive) -> Token:
        """Calls `receive(payload)` for everything published on a key (or key expression), in each publisher's order.

        `payload` is read-only and stays valid for as long as anything refers to it; `decode` makes views of it, which
        may lie in the publisher's shared memory. Runs on Zenoh's thread: only append to a queue.
        """
        board, declared = self._offer_sharing(key)

        def on_sample(sample: zenoh.Sample) -> None:
            received = bytes(sample.payload)
            payload = self._resolve(received, board) if board is not None and is_reference(received) else received
            self.counted.received_messages += 1
            self.counted.received_bytes += len(payload)
            receive(payload)

        subscriber = self.session.declare_subscriber(key, zenoh.handlers.Callback(on_sample, indirect=False))
        return self._keep(Token(subscriber, *declared, board=board))

    def _offer_sharing(self, key: str) -> tuple[Board | None, tuple[Any, ...]]:
        """Tells the stream's publisher, before it can see the subscription, that we can read shared memory."""
        if not self._can_share(key):
            return None, ()
        board = Board()
        name = shared_key(key, machine(), str(os.getpid()), str(board.descriptor), self.id)
        return board, (self.session.liveliness().declare_token(name),)

    def _can_share(self, key: str) -> bool:
        """Shared memory is for single streams: neither key expressions nor the runtime's own keys."""
        return self._shares and "*" not in key and key.count("/") >= 2 and f"/{RUNTIME}/" not in key

    def _resolve(self, payload: bytes, board: Board) -> Buffer:
        """The envelope that a reference stands for; the reference itself, which `decode` refuses, when it is lost."""
        try:
            return self._pools.resolve(payload, board)
        except (SharedMemoryError, DecodeError):
            self.counted.unresolved += 1
            return payload

    def share(
        self, envelope: Envelope, parts: list[Buffer], size: int, claims: tuple[BoardReader, ...]
    ) -> bytes | None:
        """Writes an envelope to the pool for `claims`; the reference to it, or None when there is no room (counted)."""
        with self._lock:
            if self._pool is None:
                self._pool = SharedPool(self.config.pool_bytes)
            block = self._pool.write(parts, size, claims)
            if block is None:
                self.counted.shared_full += 1
                return None
            self.counted.shared_messages += 1
            self.counted.shared_bytes += size
            return self._pool.reference(encode_head(envelope), block, size)

    def subscribe_keys(self, key: str, receive: Callable[[str, bytes], object]) -> Token:
        """As `subscribe`, for key expressions of the runtime's own: calls `receive(key, payload)`."""

        def on_sample(sample: zenoh.Sample) -> None:
            receive(str(sample.key_expr), bytes(sample.payload))

        return self._keep(
            Token(self.session.declare_subscriber(key, zenoh.handlers.Callback(on_sample, indirect=False)))
        )

    def _keep(self, token: Token) -> Token:
        """A declaration lasts until it is closed, also when the caller does not keep its token."""
        with self._lock:
            self._tokens.append(token)
        return token

    # Static streams

    def declare_static(self, stream: str, envelope: bytes) -> None:
        """Answers late joiners of a static stream with `envelope` (its encoded message). A later call replaces it."""
        key = static_key(stream)
        with self._lock:
            self._static[key] = envelope
            if key in self._declared:
                return
            self._declared[key] = self.session.declare_queryable(
                key, zenoh.handlers.Callback(self._answer_static(key), indirect=False), complete=True
            )

    def _answer_static(self, key: str) -> Callable[[zenoh.Query], None]:
        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(key, self._static[key])

        return answer

    def query_static(self, namespace: str, expression: str = "**", timeout: float = 2.0) -> dict[str, bytes]:
        """The encoded messages of the static streams that match `expression` (a stream key expression), by stream.

        Waits at most `timeout` seconds; a host that does not answer within it is left out.
        """
        wanted = zenoh.KeyExpr.autocanonize(expression)
        replies = self.session.get(
            static_key(f"{namespace}/**"),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        found: dict[str, bytes] = {}
        for reply in replies:
            sample = reply.ok
            if sample is None:
                continue
            stream = stream_of_static(str(sample.key_expr))
            if wanted.intersects(zenoh.KeyExpr(stream)):
                found[stream] = bytes(sample.payload)
        return found

    # Requests

    def serve(self, key: str, answer: Callable[[zenoh.Query], object]) -> Token:
        """Hands every request for `key` to `answer`, on Zenoh's thread; it (or who it hands it on to) replies once."""
        return self._keep(
            Token(self.session.declare_queryable(key, zenoh.handlers.Callback(answer, indirect=False), complete=True))
        )

    def ask(self, key: str, payload: bytes = b"", timeout: float = 5.0) -> list[bytes]:
        """The answers to a request; waits at most `timeout` seconds for all of them."""
        replies = self.session.get(
            key,
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        return [bytes(reply.ok.payload) for reply in replies if reply.ok is not None]

    # Presence

    def alive(self, namespace: str, name: str) -> Token:
        """Declares the presence of an operator (or host, or supervisor) until the token or the bus is closed."""
        return self._keep(Token(self.session.liveliness().declare_token(alive_key(namespace, name))))

    def watch_liveliness(self, namespace: str, changed: Callable[[str, bool], object]) -> Token:
        """Calls `changed(name, alive)` for those present already, and on every change. Runs on Zenoh's thread."""

        def on_sample(sample: zenoh.Sample) -> None:
            changed(alive_name(namespace, str(sample.key_expr)), sample.kind == zenoh.SampleKind.PUT)

        return self._keep(
            Token(
                self.session.liveliness().declare_subscriber(
                    alive_key(namespace, "**"), zenoh.handlers.Callback(on_sample, indirect=False), history=True
                )
            )
        )

    def peers(self) -> tuple[str, ...]:
        """The ids of the buses that this one is connected to now."""
        return tuple(sorted(str(z) for z in self.session.info.peers_zid()))

    # Accounts

    def counters(self) -> dict[str, int]:
        """What was moved so far, by the names of `Counters`."""
        return {name: getattr(self.counted, name) for name in Counters.__slots__}

    def count_sent(self, nbytes: int) -> None:
        self.counted.sent_messages += 1
        self.counted.sent_bytes += nbytes

    # End

    def close(self) -> None:
        """Leaves the network: every declaration ends with it. Takes at most a few seconds; further calls do nothing.

        Raises `BusError` when Zenoh does not come to an end in `CLOSE_WITHIN` seconds.
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._wait_until_mapped()
        closer = threading.Thread(target=self.session.close, name="bus close", daemon=True)
        closer.start()
        closer.join(CLOSE_WITHIN)
        if closer.is_alive():
            raise BusError(f"Zenoh did not close within {CLOSE_WITHIN:g} s")
        for token in self._tokens:
            token.close()
        if self._pool is not None:
            self._pool.close()

    def _wait_until_mapped(self) -> None:
        """Gives consumers that were just sent their first reference the time to map the pool before it goes."""
        if self._pool is None:
            return
        base, end = self._pool.base, time.monotonic() + MAPPED_WITHIN
        waiting = self._pool.consumers()
        while waiting and time.monotonic() < end:
            waiting = {c for c in waiting if not c.mapped(base)}
            if waiting:
                time.sleep(0.002)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
