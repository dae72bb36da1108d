"""The bus: one Zenoh session of one process, for what comes from outside the run and goes there.

Callbacks run on Zenoh's threads. They must only append to a queue: a callback that waits stalls all of them.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, Self

import zenoh

from dataflow.transport.bounded import within
from dataflow.transport.keys import static_key, stream_of_static
from dataflow.transport.network import NetworkConfig
from dataflow.transport.publisher import BusError, Counters, StreamPublisher, reason, undeclare

CLOSE_WITHIN = 20.0


class Token:
    """A declaration that lasts until `close` (or the end of the bus)."""

    def __init__(self, declared: Any) -> None:
        self._declared = declared

    def close(self) -> None:
        undeclare(self._declared)


@contextlib.contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Handles a SIGINT that comes while the block runs after it (in the main thread; elsewhere none is handled)."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    came: list[FrameType | None] = []
    signal.signal(signal.SIGINT, lambda number, frame: came.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        before(signal.SIGINT, came[-1])


class Bus:
    """One process's place in the network. Thread-safe; close it (it is a context manager)."""

    def __init__(self, config: NetworkConfig | None = None) -> None:
        """Opens the session; peers that are not up yet are connected to later. Raises `BusError` when an endpoint
        cannot be listened on, `NetworkError` for settings Zenoh does not take."""
        self.config = config or NetworkConfig()
        try:
            self.session = zenoh.open(self.config.zenoh_config())
        except zenoh.ZError as error:
            listen, connect = (", ".join(places) for places in (self.config.listen, self.config.connect))
            what = f"listen on {listen}" if listen else f"connect to {connect}"
            raise BusError(f"cannot {what}: {reason(error)}") from error
        self.id = str(self.session.zid())
        self.counted = Counters()
        self._lock = threading.Lock()
        self._tokens: list[Token] = []
        self._declared: dict[str, zenoh.Queryable[None]] = {}
        self._static: dict[str, bytes] = {}
        self._closed = False

    # Streams

    def publisher(self, stream: str) -> StreamPublisher:
        """Declares a publisher of the key `stream`: reliable, blocking, in order."""
        publisher = self.session.declare_publisher(
            stream,
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=True,
        )
        return StreamPublisher(stream, publisher, self.counted, self.config.blocked)

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
                key, zenoh.handlers.Callback(self._answer_static(stream), indirect=False), complete=True
            )

    def statics(self) -> tuple[str, ...]:
        """Returns the static streams that this bus answers for."""
        with self._lock:
            return tuple(stream_of_static(key) for key in self._static)

    def _answer_static(self, stream: str) -> Callable[[zenoh.Query], None]:
        key = static_key(stream)

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(key, self._static[key])

        return answer

    def query_static(self, namespace: str, expression: str = "**", timeout: float = 2.0) -> dict[str, bytes]:
        """Returns the encoded messages of the static streams that match a stream key expression, by stream.

        Waits at most `timeout` seconds; a process that does not answer within it is left out. For tools: any
        connected process may have answered.
        """
        wanted = zenoh.KeyExpr.autocanonize(expression)
        replies = self.session.get(
            static_key(f"{namespace}/**"),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        samples = ((stream_of_static(str(r.ok.key_expr)), r.ok) for r in replies if r.ok is not None)
        return {stream: bytes(s.payload) for stream, s in samples if wanted.intersects(zenoh.KeyExpr(stream))}

    # Requests

    def serve(self, key: str, answer: Callable[[zenoh.Query], object]) -> Token:
        """Hands every request for `key` to `answer`, on Zenoh's thread; it (or what it passes it to) replies once."""
        return self._keep(
            Token(self.session.declare_queryable(key, zenoh.handlers.Callback(answer, indirect=False), complete=True))
        )

    def ask(self, key: str, payload: bytes = b"", timeout: float = 5.0) -> list[bytes]:
        """Returns the answers to a request; waits at most `timeout` seconds for all of them."""
        replies = self.session.get(
            key,
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        return [bytes(reply.ok.payload) for reply in replies if reply.ok is not None]

    def peers(self) -> tuple[str, ...]:
        """Returns the ids of the buses that this one is connected to now."""
        return tuple(sorted(str(z) for z in (*self.session.info.peers_zid(), *self.session.info.routers_zid())))

    def counters(self) -> dict[str, int]:
        """Returns what was moved so far, by the names of `counters.NAMES`."""
        return self.counted.as_dict()

    # End

    def close(self) -> None:
        """Leaves the network: every declaration ends with it. Takes at most a few seconds; further calls do nothing.

        Ctrl-C takes effect afterwards: a thread of Zenoh's that outlives the interpreter aborts the process. Raises
        `BusError` when Zenoh does not come to an end in `CLOSE_WITHIN` seconds.
        """
        with _interrupts_deferred():
            self._close()

    def _close(self) -> None:
        with self._lock:
            if self._closed:
                return
            self._closed = True
        if not within(CLOSE_WITHIN, self.session.close, "bus close"):
            raise BusError(f"Zenoh did not close within {CLOSE_WITHIN:g} s")
        for token in self._tokens:
            token.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
