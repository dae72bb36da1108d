"""Judges when to try again to record after the disk has refused, and counts what is lost meanwhile."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

FIRST_PAUSE, LONGEST_PAUSE = 1.0, 60.0
"""Seconds before the next try: each pause is twice the one before, until one try holds that long."""
ROOM = 256 * 2**20
ROOM_SHARE = 20
"""Free bytes, or the part of a small disk, that let a recording go on."""
MOST_REASONS = 20


@dataclass(slots=True)
class RecordingLosses:
    """Counts what a recording lacks."""

    messages: Counter[str] = field(default_factory=Counter)
    firings: int = 0
    spans: list[tuple[int, int | None]] = field(default_factory=list)
    """Event time (ns) from which nothing was stored, and from which it was again."""
    reasons: list[str] = field(default_factory=list)

    @property
    def any(self) -> bool:
        """Returns whether anything is lost, if only the end of a file."""
        return bool(self.messages) or self.firings > 0 or bool(self.spans) or bool(self.reasons)

    def because(self, reason: str) -> bool:
        """Notes why; False where that reason is known."""
        if reason in self.reasons or len(self.reasons) >= MOST_REASONS:
            return False
        self.reasons.append(reason)
        return True

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "messages": sum(self.messages.values()),
            "streams": dict(sorted(self.messages.items())),
            "firings": self.firings,
            "spans": [list(span) for span in self.spans],
            "reasons": list(self.reasons),
        }


class Outage:
    """Decides when a recorder whose disk has refused may try again."""

    def __init__(self, folder: Path, clock: Callable[[], float] | None = None) -> None:
        self._folder, self._clock = folder, clock or time.monotonic
        self._pause = FIRST_PAUSE
        self._due = 0.0

    def begin(self) -> None:
        """The disk has refused."""
        now = self._clock()
        held = now - self._due
        self._pause = FIRST_PAUSE if held > LONGEST_PAUSE else min(2 * self._pause, LONGEST_PAUSE)
        self._due = now + self._pause

    def over(self) -> bool:
        """Returns whether it is time for a try, and the disk has room."""
        return self._clock() >= self._due and self._has_room()

    def _has_room(self) -> bool:
        try:
            disk = os.statvfs(self._folder)
        except OSError:
            return False
        free, whole = disk.f_bavail * disk.f_frsize, disk.f_blocks * disk.f_frsize
        return free >= min(ROOM, whole // ROOM_SHARE)
