"""Counts of what a process has published for subscribers from outside."""

from __future__ import annotations

import threading
from typing import Final

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
