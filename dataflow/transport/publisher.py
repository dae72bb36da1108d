"""Publishes a stream to subscribers outside the run: in order, reliably."""

from __future__ import annotations

import re
import sys
import threading
import time
from typing import Any, Final

import zenoh

from dataflow.transport.bounded import within

NAMES: Final = (
    "published_messages",
    "published_bytes",
    "unpublished",  # not published because subscribers were too slow
    "stalled",  # publications that waited until the link of a subscriber that took nothing was closed
)


class Counters:
    """Counts what a process has published so far. Thread-safe: its main thread and its publisher both add to it."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(NAMES, 0)
        self._lock = threading.Lock()

    def add(self, name: str, number: int = 1) -> None:
        """Adds to one count."""
        with self._lock:
            self._counts[name] += number

    def published(self, nbytes: int) -> None:
        """Counts one message of `nbytes`."""
        with self._lock:
            self._counts["published_messages"] += 1
            self._counts["published_bytes"] += nbytes

    def as_dict(self) -> dict[str, int]:
        """Returns the counts by name."""
        with self._lock:
            return dict(self._counts)


class BusError(RuntimeError):
    """The network refused an operation; the message names it, the key and the reason."""


def reason(error: zenoh.ZError) -> str:
    """Returns Zenoh's reason without the places in its code, of which users know nothing."""
    return _IN_ITS_CODE.sub("", str(error)).strip()


_IN_ITS_CODE = re.compile(r"\s*\bat \S+\.rs:\d+\.?")
UNDECLARE_WITHIN = 10.0
"""Seconds: Zenoh waits for callbacks that are under way, and for links that take nothing."""


def undeclare(declared: Any) -> None:
    """Ends a Zenoh declaration; one that ended already (with its session) is left alone. Raises `BusError` for one that
    does not end in `UNDECLARE_WITHIN` seconds."""
    try:
        if not within(UNDECLARE_WITHIN, declared.undeclare, "undeclare"):
            raise BusError(f"{declared} did not end within {UNDECLARE_WITHIN:g} s")
    except zenoh.ZError as error:
        if "closed" not in str(error).lower() and "undeclared" not in str(error).lower():
            raise BusError(f"undeclaring {declared}: {error}") from error


class StreamPublisher:
    """Publishes one stream; waits when a subscriber's link is full."""

    def __init__(self, stream: str, publisher: zenoh.Publisher, counted: Counters, blocked: float) -> None:
        self.stream = stream
        self._publisher = publisher
        self._counted = counted
        self._blocked = blocked
        self.matched = False
        """True while the key has a subscriber."""
        self._matching = publisher.declare_matching_listener(zenoh.handlers.Callback(self._on_matching, indirect=False))
        status: Any = publisher.matching_status  # Zenoh's stubs call it a bool
        self.matched = bool(status.matching)

    def _on_matching(self, status: zenoh.MatchingStatus) -> None:
        self.matched = bool(status.matching)

    def put(self, payload: bytes) -> None:
        """Publishes an encoded envelope, or, on the runtime's own keys, anything. Raises `BusError` on a closed bus."""
        begun = time.monotonic()
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            raise BusError(f"publishing {len(payload)} bytes on {self.stream!r}: {error}") from error
        if (waited := time.monotonic() - begun) >= self._blocked:
            self._counted.add("stalled")
            print(
                f"publishing on {self.stream!r} waited {waited:.1f} s for a subscriber that takes nothing: its link "
                "was closed, and what it misses is a gap in the numbers that it gets next",
                file=sys.stderr,
            )
        self._counted.published(len(payload))

    def close(self) -> None:
        undeclare(self._publisher)
