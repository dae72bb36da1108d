"""The bus: one Zenoh session of one process, with exactly the operations that streams need.

Callbacks run on Zenoh's threads. They must only append to a queue: a callback that waits stalls every stream of the
process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType, TracebackType
from typing import Any, Self

import zenoh

from dataflow.transport.codec import encode_head
from dataflow.transport.counters import Counters
from dataflow.transport.envelope import Buffer, DecodeError, Envelope
from dataflow.transport.keys import RUNTIME, shared_key, static_key, stream_of_static
from dataflow.transport.network import NetworkConfig
from dataflow.transport.pool import BoardReader, SharedPool
from dataflow.transport.publisher import BusError, Sharing, StreamPublisher, undeclare
from dataflow.transport.seal import Seal
from dataflow.transport.shared import SUPPORTED, Board, PoolReader, SharedMemoryError, is_reference, machine

CLOSE_WITHIN = 20.0
MAPPED_WITHIN = 1.0

Receive = Callable[[Buffer], object]


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
        self._told: set[str] = set()
        self._closed = False

    # Streams

    def publisher(self, stream: str, *, consumers: int = 0) -> StreamPublisher:
        """Declares a publisher of the key `stream`: reliable, blocking, in order.

        `consumers` is the number of subscriptions to the stream (`subscribe` calls) in other processes, if known: when
        all of them are on this machine, large messages go through shared memory. 0: nothing is shared.
        """
        publisher = self.session.declare_publisher(
            stream,
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=True,
        )
        sharing = None
        if consumers and self._can_share(stream):
            sharing = Sharing(self.session, stream, consumers, self.counted, self._share)
        seal = Seal(self.config.secret, stream)
        return StreamPublisher(stream, publisher, seal, self.counted, sharing, self.config.blocked)

    def subscribe(self, stream: str, receive: Receive) -> Token:
        """Calls `receive(payload)` for all that processes of this run publish on a key, in each publisher's order.

        What others publish there is dropped and counted as `foreign`, before anything in it is looked at. `payload` is
        read-only and stays valid for as long as anything refers to it; `decode` makes views of it, which may lie in
        the publisher's shared memory. Runs on Zenoh's thread: only append to a queue.
        """
        board, declared = self._offer_sharing(stream)
        seal = Seal(self.config.secret, stream)

        def on_sample(sample: zenoh.Sample) -> None:
            received = bytes(sample.payload)
            attached = sample.attachment
            if attached is None or not seal.fits(received, bytes(attached)):
                self._drop_foreign(stream)
                return
            payload = self._resolve(received, board) if board is not None and is_reference(received) else received
            self.counted.moved("received", len(payload))
            receive(payload)

        subscriber = self.session.declare_subscriber(stream, zenoh.handlers.Callback(on_sample, indirect=False))
        return self._keep(Token(subscriber, *declared, board=board))

    def _drop_foreign(self, stream: str) -> None:
        self.counted.add("foreign")
        with self._lock:
            told = stream in self._told
            self._told.add(stream)
        if not told:
            print(
                f"dropped a message on {stream!r} that no process of this run published (and count those that follow)",
                file=sys.stderr,
            )

    def _offer_sharing(self, stream: str) -> tuple[Board | None, tuple[Any, ...]]:
        """Tells the stream's publisher, before it can see the subscription, that we can read shared memory."""
        if not self._can_share(stream):
            return None, ()
        board = Board()
        name = shared_key(stream, machine(), str(os.getpid()), str(board.descriptor), self.id)
        return board, (self.session.liveliness().declare_token(name),)

    def _can_share(self, stream: str) -> bool:
        """Shared memory is for streams, not for the runtime's own keys."""
        return self._shares and stream.count("/") >= 2 and f"/{RUNTIME}/" not in stream

    def _resolve(self, payload: bytes, board: Board) -> Buffer:
        """Returns the envelope that a reference stands for; the reference, which `decode` refuses, when it is lost."""
        try:
            return self._pools.resolve(payload, board)
        except (SharedMemoryError, DecodeError):
            self.counted.add("unresolved")
            return payload

    def _share(
        self, envelope: Envelope, parts: list[Buffer], size: int, claims: tuple[BoardReader, ...]
    ) -> bytes | None:
        """Puts an envelope into the pool for `claims`; returns its reference, or None without room (counted)."""
        with self._lock:
            if self._pool is None:
                self._pool = SharedPool(self.config.pool_bytes)
            block = self._pool.write(parts, size, claims)
            if block is None:
                self.counted.add("shared_full")
                return None
            self.counted.moved("shared", size)
            return self._pool.reference(encode_head(envelope), block, size)

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
        key, seal = static_key(stream), Seal(self.config.secret, stream)

        def answer(query: zenoh.Query) -> None:
            with query:
                envelope = self._static[key]
                query.reply(key, envelope, attachment=seal.of(envelope))

        return answer

    def query_static(self, namespace: str, expression: str = "**", timeout: float = 2.0) -> dict[str, bytes]:
        """Returns the encoded messages of the static streams that match a stream key expression, by stream.

        Waits at most `timeout` seconds; a process that does not answer within it is left out. For tools: whoever is
        connected may have answered. Processes of the run use `fetch_statics`.
        """
        wanted = zenoh.KeyExpr.autocanonize(expression)
        return {
            stream: payload
            for stream, payload, _ in self._static_replies(namespace, timeout)
            if wanted.intersects(zenoh.KeyExpr(stream))
        }

    def fetch_statics(self, namespace: str, timeout: float = 2.0) -> dict[str, bytes]:
        """Returns the encoded messages of the static streams that processes of this run hold, by stream."""
        found = {}
        for stream, payload, seal in self._static_replies(namespace, timeout):
            if Seal(self.config.secret, stream).fits(payload, seal):
                found[stream] = payload
            else:
                self._drop_foreign(stream)
        return found

    def _static_replies(self, namespace: str, timeout: float) -> Iterator[tuple[str, bytes, bytes]]:
        """Yields stream, message and seal of each answer."""
        replies = self.session.get(
            static_key(f"{namespace}/**"),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        for reply in replies:
            sample = reply.ok
            if sample is not None:
                attached = sample.attachment
                seal = b"" if attached is None else bytes(attached)
                yield stream_of_static(str(sample.key_expr)), bytes(sample.payload), seal

    # Requests

    def serve(self, key: str, answer: Callable[[zenoh.Query], object]) -> Token:
        """Hands every request for `key` to `answer`, on Zenoh's thread; it (or who it hands it on to) replies once."""
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
        return tuple(sorted(str(z) for z in self.session.info.peers_zid()))

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
