"""Tells whether a wait is so short that it is better spent looking than asleep.

To be woken costs tens of microseconds, and on a core that others have used meanwhile as much again as the work that
follows. So a process of a live run that has learned that something arrives soon after what it did last (an answer to
what it has sent) keeps looking for it. It does so only while nobody else wants its core, and never for long.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

LONGEST = 0.001
"""Seconds: a wait that is longer on average is not spent looking."""
OTHERS = 100e-6
"""Seconds that one look takes at most, unless somebody else was given the core meanwhile."""
REST = 0.1
"""Seconds without spinning once somebody else has wanted the core."""
FOLLOWS = 4
"""Waits over which a mean follows a change."""
COUNTED = 0.01
"""Seconds that one wait counts for, at most."""


class Spinning:
    """What is known of the waits after each thing that a process may have done last."""

    def __init__(self, clock: Callable[[], float] | None = None, give_way: Callable[[], None] | None = None) -> None:
        self._clock, self._give_way = clock or time.monotonic, give_way or _give_way
        self._means: dict[str, float] = {}
        self._after, self._since = "", 0.0
        self._rests_until = 0.0

    def did(self, what: str) -> None:
        """Notes what the process did last: a message of a stream that it took, or that it sent."""
        self._after, self._since = what, self._clock()

    def arrived(self) -> None:
        """Notes that something has arrived since."""
        if self._after:
            waited = min(self._clock() - self._since, COUNTED)
            mean = self._means.get(self._after, COUNTED)
            self._means[self._after] = mean + (waited - mean) / FOLLOWS
            self._after = ""

    def worth(self) -> float:
        """Seconds from now on that are worth spending on looking; 0: none."""
        mean = self._means.get(self._after, COUNTED)
        if mean > LONGEST or (now := self._clock()) < self._rests_until:
            return 0.0
        return self._since + 2 * mean - now

    def look(self, found: Callable[[], bool], timeout: float) -> bool:
        """Looks for as long as it is worth it and nobody else wants the core; True when something was found."""
        before = self._clock()
        until = before + min(self.worth(), timeout)
        while before < until:
            if found():
                return True
            self._give_way()
            now = self._clock()
            if now - before > OTHERS:
                self._rests_until = now + REST
                break
            before = now
        return False


def _give_way() -> None:
    """Lets other threads of this process have the interpreter, and other processes the core."""
    time.sleep(0)
    os.sched_yield()
