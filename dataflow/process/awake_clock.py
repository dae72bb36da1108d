"""A clock that goes on while its process runs, for everything that is judged by how long it took.

A stopped container, a suspended laptop or a storm of swapping stops the waiting process together with the awaited one:
a clock that went on meanwhile is no evidence against either.
"""

from __future__ import annotations

import time
from collections.abc import Callable

LONGEST_STEP = 0.5
"""Seconds that count, at most, between two readings: users of the clock read it more often while they run."""
LOOK_EVERY = 0.2
"""Seconds of a single wait that is timed by such a clock."""


class AwakeClock:
    """Seconds, never going back; a longer time between two readings counts as `LONGEST_STEP`."""

    def __init__(self, clock: Callable[[], float] | None = None) -> None:
        self._clock = clock or time.monotonic
        self._read = self._now = self._clock()
        self._lost = 0.0

    def __call__(self) -> float:
        """Reads the clock."""
        read = self._clock()
        step = min(read - self._read, LONGEST_STEP)
        self._lost += read - self._read - step
        self._now += step
        self._read = read
        return self._now

    def take_lost(self) -> float:
        """Returns the seconds that did not count since this was last asked."""
        lost, self._lost = self._lost, 0.0
        return lost

    def sleep(self, seconds: float) -> None:
        """Waits until the clock has gone on by so many seconds."""
        until = self() + seconds
        while (left := until - self()) > 0:
            time.sleep(min(left, LOOK_EVERY))
