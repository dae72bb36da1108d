"""Warnings of a process about faulty input: the first is printed at once, the following ones are counted."""

from __future__ import annotations

import select
import sys
import time
from collections import Counter
from collections.abc import Callable

AGAIN_AFTER = 10.0
"""Seconds after which a complaint about the same thing is printed again, with how many there were meanwhile."""


class ThrottledWarnings:
    """Prints to stderr, but never waits for the reader."""

    def __init__(self, clock: Callable[[], float] | None = None, printing: Callable[[str], bool] | None = None) -> None:
        self._clock, self._print = clock or time.monotonic, printing or print_without_waiting
        self._due: dict[str, float] = {}
        self._unprinted: Counter[str] = Counter()

    def say(self, about: str, text: str) -> None:
        """Prints a warning about something, such as a stream; `text` is the whole warning."""
        now = self._clock()
        more = self._unprinted[about]
        line = f"{text} ({more} more like it before)" if more else text
        if now >= self._due.get(about, now) and self._print(line):
            self._due[about] = now + AGAIN_AFTER
            self._unprinted.pop(about, None)
        else:
            self._unprinted[about] += 1


def print_without_waiting(line: str) -> bool:
    """Prints a line to stderr; False when it is not being read at the moment."""
    try:
        room = select.poll()
        room.register(sys.stderr, select.POLLOUT)
        writable = bool(room.poll(0))
    except (ValueError, OSError, TypeError):  # it is no file, or closed
        writable = True
    if writable:
        print(line, file=sys.stderr, flush=True)
    return writable
