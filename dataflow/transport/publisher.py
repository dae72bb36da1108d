"""Publishes one stream: reliably, in order, sealed, and through shared memory where all its consumers can read that."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from dataflow.transport.codec import encode_parts, parts_size
from dataflow.transport.counters import Counters
from dataflow.transport.envelope import Buffer, Envelope, Kind
from dataflow.transport.keys import shared_key
from dataflow.transport.pool import BoardReader
from dataflow.transport.seal import Seal
from dataflow.transport.shared import THRESHOLD, SharedMemoryError, machine

Share = Callable[[Envelope, list[Buffer], int, tuple[BoardReader, ...]], bytes | None]
"""Puts an envelope of so many bytes into shared memory for its consumers; its reference, or None without room."""


class BusError(RuntimeError):
    """The network refused: says which operation, on which key, and why."""


def undeclare(declared: Any) -> None:
    """Ends a Zenoh declaration; one that ended already (with its session) is left alone."""
    try:
        declared.undeclare()
    except zenoh.ZError as error:
        if "closed" not in str(error).lower() and "undeclared" not in str(error).lower():
            raise BusError(f"undeclaring {declared}: {error}") from error


class StreamPublisher:
    """Publishes one stream: in order, reliably; waits when a consumer's link is full."""

    def __init__(
        self,
        stream: str,
        publisher: zenoh.Publisher,
        seal: Seal,
        counted: Counters,
        sharing: Sharing | None,
        blocked: float,
    ) -> None:
        self.stream = stream
        self._publisher = publisher
        self._seal = seal
        self._counted = counted
        self._sharing = sharing
        self._blocked = blocked
        self._probes = 0
        self.matched = False
        """Whether anybody subscribes to the key."""
        self._matching = publisher.declare_matching_listener(zenoh.handlers.Callback(self._on_matching, indirect=False))
        status: Any = publisher.matching_status  # Zenoh's stubs call it a bool
        self.matched = bool(status.matching)

    def _on_matching(self, status: zenoh.MatchingStatus) -> None:
        self.matched = bool(status.matching)

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
        """Returns whether large messages go through shared memory now: all consumers are known and on this machine."""
        return self._sharing is not None and self._sharing.ready

    def close(self) -> None:
        undeclare(self._publisher)
        if self._sharing is not None:
            self._sharing.close()

    def _put(self, payload: bytes, size: int) -> None:
        begun = time.monotonic()
        try:
            self._publisher.put(payload, attachment=self._seal.of(payload))
        except zenoh.ZError as error:
            raise BusError(f"publishing {size} bytes on {self.stream!r}: {error}") from error
        if (waited := time.monotonic() - begun) >= self._blocked:
            self._counted.add("stalled")
            print(
                f"publishing on {self.stream!r} waited {waited:.1f} s for a subscriber that takes nothing: its link "
                "was closed, and what it misses is a gap in the numbers that it gets next",
                file=sys.stderr,
            )
        self._counted.moved("sent", size)


class Sharing:
    """The consumers of one stream that can read shared memory. A reference is sent only when that is all of them."""

    def __init__(self, session: zenoh.Session, stream: str, consumers: int, counted: Counters, share: Share) -> None:
        self._share = share
        self._counted = counted
        self._expected = consumers
        self._machine = machine()
        self._lock = threading.Lock()
        self._boards: dict[str, BoardReader] = {}
        self._all: tuple[BoardReader, ...] = ()
        self._watch = session.liveliness().declare_subscriber(
            shared_key(stream, "*", "*", "*", "*"),
            zenoh.handlers.Callback(self._on_token, indirect=False),
            history=True,
        )

    @property
    def ready(self) -> bool:
        return len(self._all) == self._expected

    def share(self, envelope: Envelope, parts: list[Buffer], size: int) -> bytes | None:
        """Returns the reference to send instead of the envelope; None when it must travel whole (counted)."""
        claims = self._all
        if len(claims) != self._expected:
            self._counted.add("shared_unready")
            return None
        return self._share(envelope, parts, size, claims)

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
