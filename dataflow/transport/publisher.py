"""Publishes a stream to subscribers outside the run: in order, reliably."""

from __future__ import annotations

import re
import sys
import time
from typing import Any

import zenoh

from dataflow.transport.bounded import within
from dataflow.transport.counters import Counters


class BusError(RuntimeError):
    """The network refused an operation; the message names it, the key and the reason."""


def reason(error: zenoh.ZError) -> str:
    """Returns Zenoh's reason without the places in its code, of which users know nothing."""
    return _IN_ITS_CODE.sub("", str(error)).strip()


_IN_ITS_CODE = re.compile(r"\s*\bat \S+\.rs:\d+\.?")
UNDECLARE_WITHIN = 10.0
"""Seconds: Zenoh waits for callbacks that are under way, and for links that take nothing."""


def undeclare(declared: Any) -> None:
    """Ends a Zenoh declaration; one that ended already (with its session) is left alone.

    Raises `BusError` for one that does not end in `UNDECLARE_WITHIN` seconds.
    """
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
