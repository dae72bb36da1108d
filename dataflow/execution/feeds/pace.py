"""The pace of a run: which event time it is by the clock."""

from __future__ import annotations

import time


class Pace:
    """Event time against the clock, from `begin` on; before that, and without a rate, nothing waits for the clock."""

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._began: tuple[int, float] | None = None

    def begin(self, first: int | None, at: float) -> None:
        """Event time `first` (ns) was, or is, at `at` (seconds since the epoch)."""
        if self._rate is not None and first is not None:
            self._began = (first, at)

    @property
    def held(self) -> bool:
        """Returns whether steps wait for the clock."""
        return self._began is not None

    def due_in(self, stamp: int) -> float:
        """Seconds until a stamp, below 0 when it is past; 0 when nothing waits for the clock."""
        if self._began is None:
            return 0.0
        first, at = self._began
        return at + (stamp - first) * 1e-9 / (self._rate or 1.0) - time.time()

    def put(self, stamp: int) -> None:
        """Event time `stamp` is now: what was paused goes on from there."""
        if self._began is not None:
            self._began = (stamp, time.time())

    def change(self, rate: float | None, due: int) -> None:
        """Goes on at another rate, from the event time of now, at the latest that of the next step, `due` (ns); from
        there where nothing waited for the clock so far."""
        place = due if self._began is None else min(self.event_time(), due)
        self._rate, self._began = rate, None
        self.begin(place, time.time())

    def event_time(self) -> int:
        """Event time now: the clock's own, or, where sources are held to the clock, as far as they have been let."""
        if self._began is None:
            return time.time_ns()
        first, at = self._began
        return first + round((time.time() - at) * 1e9 * (self._rate or 1.0))
