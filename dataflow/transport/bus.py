"""The bus: one Zenoh session of one process, with exactly the operations that streams need.

Callbacks run on Zenoh's threads. They must only append to a queue: a callback that waits stalls every stream of the
process.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import zenoh

from dataflow.transport.codec import Buffer, Envelope, Kind, encode_parts
from dataflow.transport.keys import alive_key, runtime_key, static_key, stream_of
from dataflow.transport.network import NetworkConfig

CLOSE_WITHIN = 5.0

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
    rejected: int = 0
    """Samples that were not accepted: deletions, or references to shared memory that do not resolve."""


class StreamPublisher:
    """Publishes one stream: in order, reliably; waits when a consumer's link is full."""

    def __init__(self, bus: Bus, stream: str, publisher: zenoh.Publisher) -> None:
        self.stream = stream
        self._bus = bus
        self._publisher = publisher
        self._probes = 0

    def put(self, envelope: Envelope) -> int:
        """Publishes an envelope; returns its bytes."""
        return self.put_bytes(b"".join(encode_parts(envelope)))

    def put_bytes(self, payload: bytes) -> int:
        """Publishes bytes as they are: an encoded envelope, or, on the runtime's own keys, anything."""
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            raise BusError(f"publishing {len(payload)} bytes on {self.stream!r}: {error}") from error
        self._bus.count_sent(len(payload))
        return len(payload)

    def probe(self, number: int | None = None) -> int:
        """Sends a numbered probe on the data key, for the start barrier; returns its number."""
        self._probes = self._probes + 1 if number is None else number
        self.put(Envelope(Kind.PROBE, self.stream, 0, self._probes, 0))
        return self._probes

    def close(self) -> None:
        undeclare(self._publisher)


def undeclare(declared: Any) -> None:
    """Ends a Zenoh declaration; one that ended already (with its session) is left alone."""
    try:
        declared.undeclare()
    except zenoh.ZError as error:
        if "closed" not in str(error).lower() and "undeclared" not in str(error).lower():
            raise BusError(f"undeclaring {declared}: {error}") from error


class Token:
    """A declaration that lasts until `close` (or the end of the bus)."""

    def __init__(self, declared: Any) -> None:
        self._declared = declared

    def close(self) -> None:
        undeclare(self._declared)

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
        self._counters = Counters()
        self._lock = threading.Lock()
        self._declared: dict[str, zenoh.Queryable[None]] = {}
        self._static: dict[str, bytes] = {}
        self._closed = False

    # Streams

    def publisher(self, stream: str) -> StreamPublisher:
        """A publisher of the key `stream`: reliable, blocking, in order."""
        return StreamPublisher(
            self,
            stream,
            self.session.declare_publisher(
                stream,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                express=True,
            ),
        )

    def subscribe(self, key: str, receive: Receive) -> Token:
        """Calls `receive(payload)` for everything published on a key (or key expression), in each publisher's order.

        `payload` is read-only and stays valid for as long as anything refers to it; `decode` makes views of it. Runs on
        Zenoh's thread: only append to a queue.
        """

        def on_sample(sample: zenoh.Sample) -> None:
            payload = bytes(sample.payload)
            self._count_received(len(payload))
            receive(payload)

        return Token(self.session.declare_subscriber(key, zenoh.handlers.Callback(on_sample, indirect=False)))

    def subscribe_keys(self, key: str, receive: Callable[[str, bytes], object]) -> Token:
        """As `subscribe`, for key expressions of the runtime's own: calls `receive(key, payload)`."""

        def on_sample(sample: zenoh.Sample) -> None:
            receive(str(sample.key_expr), bytes(sample.payload))

        return Token(self.session.declare_subscriber(key, zenoh.handlers.Callback(on_sample, indirect=False)))

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
            runtime_key(namespace, "static", "**"),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        found: dict[str, bytes] = {}
        for reply in replies:
            sample = reply.ok
            if sample is None:
                continue
            stream = stream_of(str(sample.key_expr))
            if wanted.intersects(zenoh.KeyExpr(stream)):
                found[stream] = bytes(sample.payload)
        return found

    # Presence

    def alive(self, namespace: str, name: str) -> Token:
        """Declares the presence of an operator (or host, or supervisor) until the token or the bus is closed."""
        return Token(self.session.liveliness().declare_token(alive_key(namespace, name)))

    def watch_liveliness(self, namespace: str, changed: Callable[[str, bool], object]) -> Token:
        """Calls `changed(name, alive)` for those present already, and on every change. Runs on Zenoh's thread."""

        def on_sample(sample: zenoh.Sample) -> None:
            changed(str(sample.key_expr).rpartition("/")[2], sample.kind == zenoh.SampleKind.PUT)

        return Token(
            self.session.liveliness().declare_subscriber(
                alive_key(namespace, "*"), zenoh.handlers.Callback(on_sample, indirect=False), history=True
            )
        )

    def peers(self) -> tuple[str, ...]:
        """The ids of the buses that this one is connected to now."""
        return tuple(sorted(str(z) for z in self.session.info.peers_zid()))

    # Accounts

    def counters(self) -> dict[str, int]:
        """What was moved so far: messages and bytes sent and received."""
        counted = self._counters
        return {name: getattr(counted, name) for name in counted.__slots__}

    def count_sent(self, nbytes: int) -> None:
        self._counters.sent_messages += 1
        self._counters.sent_bytes += nbytes

    def _count_received(self, nbytes: int) -> None:
        self._counters.received_messages += 1
        self._counters.received_bytes += nbytes

    # End

    def close(self) -> None:
        """Leaves the network: every declaration ends with it. Takes at most a few seconds; further calls do nothing.

        Raises `BusError` when Zenoh does not come to an end in `CLOSE_WITHIN` seconds.
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
        closer = threading.Thread(target=self.session.close, name="bus close", daemon=True)
        closer.start()
        closer.join(CLOSE_WITHIN)
        if closer.is_alive():
            raise BusError(f"Zenoh did not close within {CLOSE_WITHIN:g} s")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
