"""Counts of what a process has sent and published."""

from __future__ import annotations

import threading
from typing import Final, Literal

NAMES: Final = (
    "sent_messages",  # to other processes of the run
    "sent_bytes",
    "shared_messages",  # of those sent, the ones that went through shared memory
    "shared_bytes",
    "shared_full",  # large messages that travelled whole because the pool had no room
    "published_messages",  # to subscribers from outside the run
    "published_bytes",
    "unpublished",  # not published because subscribers from outside were too slow
    "stalled",  # publications that waited until the link of a subscriber that took nothing was closed
)

Direction = Literal["sent", "shared", "published"]
_MOVED: Final[dict[Direction, tuple[str, str]]] = {
    "sent": ("sent_messages", "sent_bytes"),
    "shared": ("shared_messages", "shared_bytes"),
    "published": ("published_messages", "published_bytes"),
}


class Counters:
    """Counts what a process has moved so far. Thread-safe: its main thread and its publisher both add to it."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(NAMES, 0)
        self._lock = threading.Lock()

    def add(self, name: str, number: int = 1) -> None:
        """Adds to one count."""
        with self._lock:
            self._counts[name] += number

    def moved(self, direction: Direction, nbytes: int) -> None:
        """Counts one message of `nbytes`."""
        messages, size = _MOVED[direction]
        with self._lock:
            self._counts[messages] += 1
            self._counts[size] += nbytes

    def as_dict(self) -> dict[str, int]:
        """Returns the counts by name."""
        with self._lock:
            return dict(self._counts)
