"""Prints the output of processes on a separate thread: a stopped terminal must not stop the processes."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

KEPT = 1000
"""Lines that wait for a terminal which takes none; of more, the oldest are not shown."""
CLOSE_WITHIN = 1.0


class Console:
    """Hands lines on to `show`, in order."""

    def __init__(self, show: Callable[[str, str], object]) -> None:
        self._show = show
        self._lines: deque[tuple[str, str]] = deque()
        self._lost = 0
        self._over = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="words", daemon=True)
        self._thread.start()

    def put(self, label: str, line: str) -> None:
        """Shows a line of a process soon; never waits."""
        with self._changed:
            self._lines.append((label, line))
            if len(self._lines) > KEPT:
                self._lines.popleft()
                self._lost += 1
            self._changed.notify()

    def close(self) -> None:
        """Waits (bounded) until everything has been shown."""
        with self._changed:
            self._over = True
            self._changed.notify()
        self._thread.join(CLOSE_WITHIN)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._lines or self._over)
                if not self._lines:
                    return
                lost, self._lost = self._lost, 0
                label, line = self._lines.popleft()
            if lost:
                self._show(label, f"({lost} lines before this one were not shown)")
            self._show(label, line)
