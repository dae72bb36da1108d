"""The inbox of a process: what its threads put there, and what arrives through its rings.

One thread takes, any may put. Whoever waits here waits for one eventfd: the writers of the rings, the readers of the
rings that this process writes to (when they were full and have room again) and its own threads all wake it by that.
"""

from __future__ import annotations

import os
import queue
import select
from collections import deque
from collections.abc import Sequence
from typing import Any

from dataflow.transport import Incoming

Item = tuple[Any, ...]


class Inbox:
    """A queue that also takes in rings. `wake`: the eventfd that was handed down; without one, its own."""

    def __init__(self, wake: int | None = None, incoming: Sequence[Incoming] = ()) -> None:
        self.wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC) if wake is None else wake
        self._incoming = tuple(incoming)
        self._items: deque[Item] = deque()
        self._asleep = False

    def put(self, item: Item) -> None:
        """Appends an item; on any thread."""
        self._items.append(item)
        if self._asleep:
            os.eventfd_write(self.wake, 1)

    def get(self, timeout: float) -> Item:
        """Returns the next item, or raises `queue.Empty` when there is none in time, or something else woke it."""
        if self.empty() and timeout > 0:
            self._wait(timeout)
        return self.get_nowait()

    def _wait(self, timeout: float) -> None:
        self._asleep = True
        if not self._items and not sum(not ring.sleep() for ring in self._incoming):
            woken, _, _ = select.select([self.wake], [], [], timeout)
            if woken:
                self._forget_wakes()
        self._asleep = False
        for ring in self._incoming:
            ring.awake()

    def get_nowait(self) -> Item:
        """Returns the next item; raises `queue.Empty` when there is none."""
        if not self._items and self.empty():
            raise queue.Empty
        return self._items.popleft()

    def empty(self) -> bool:
        """Tells whether there is nothing, in the rings either."""
        for ring in self._incoming:
            if ring.arrived():
                self._items.extend(("envelope", key, payload) for key, payload in ring.take())
        return not self._items

    def counters(self) -> dict[str, int]:
        """Returns what has arrived through the rings."""
        return {
            "received_messages": sum(ring.messages for ring in self._incoming),
            "received_bytes": sum(ring.nbytes for ring in self._incoming),
            "unresolved": sum(ring.unresolved for ring in self._incoming),
        }

    def qsize(self) -> int:
        return len(self._items)

    def _forget_wakes(self) -> None:
        try:
            os.eventfd_read(self.wake)
        except BlockingIOError:
            return
