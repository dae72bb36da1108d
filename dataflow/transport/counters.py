"""Counts of what a bus has moved."""

from __future__ import annotations

import threading
from typing import Final

NAMES: Final = (
    "sent_messages",
    "sent_bytes",
    "received_messages",
    "received_bytes",
    "shared_messages",  # of those sent, the ones that went through shared memory
    "shared_bytes",
    "shared_full",  # large messages that travelled whole because the pool had no room
    "shared_unready",  # large messages that travelled whole because not all consumers could share memory (yet)
    "unresolved",  # references received whose memory could not be opened
    "stalled",  # publications that waited until the link of a subscriber that took nothing was closed
    "foreign",  # publications dropped because they do not come from a process of this run
)


class Counters:
    """Counts what a bus has moved since it was opened. Thread-safe: publishers and Zenoh's threads all add to it."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(NAMES, 0)
        self._lock = threading.Lock()

    def add(self, name: str, number: int = 1) -> None:
        """Adds to one count."""
        with self._lock:
            self._counts[name] += number

    def moved(self, direction: str, nbytes: int) -> None:
        """Counts one message of `nbytes` as "sent", "received" or "shared"."""
        with self._lock:
            self._counts[f"{direction}_messages"] += 1
            self._counts[f"{direction}_bytes"] += nbytes

    def as_dict(self) -> dict[str, int]:
        """Returns the counts by name."""
        with self._lock:
            return dict(self._counts)
