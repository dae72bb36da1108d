"""Passes on what processes print, on a thread of its own: a terminal that is stopped holds up nobody."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

MOST_LINES = 10_000
END_WITHIN = 2.0


class Printer:
    """Calls `put(label, line)` for each line in order. Lines that a stopped terminal does not take are left out."""

    def __init__(self, put: Callable[[str, str], None]) -> None:
        self._put = put
        self._lines: queue.Queue[tuple[str, str] | None] = queue.Queue(MOST_LINES)
        self._thread = threading.Thread(target=self._run, name="printer", daemon=True)
        self._thread.start()
        self.left_out = 0

    def take(self, label: str, line: str) -> None:
        try:
            self._lines.put_nowait((label, line))
        except queue.Full:
            self.left_out += 1

    def close(self) -> None:
        """Waits (bounded) until everything is printed."""
        try:
            self._lines.put(None, timeout=END_WITHIN)
        except queue.Full:
            return
        self._thread.join(END_WITHIN)

    def _run(self) -> None:
        while (item := self._lines.get()) is not None:
            self._put(*item)
