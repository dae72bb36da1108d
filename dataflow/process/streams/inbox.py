"""The inbox of a process: what its threads put there, and what arrives through its rings.

One thread takes, any may put. A thread that waits here waits for one eventfd: the writers of the rings, the readers of
the rings that this process writes to (when they were full and have room again) and its own threads all wake it by that.
The write to the eventfd wakes (an edge), so the eventfd is never read.

The thread that takes has the *turn*: it alone touches what the process has. While it waits for want of anything to do,
another thread may have the turn for a moment, and do what it would else have to wake that one for.
"""

from __future__ import annotations

import os
import queue
import select
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any

from dataflow.transport import Incoming

Item = tuple[Any, ...]


class Inbox:
    """A queue that also takes in rings. `wake`: the eventfd that was handed down; without one, its own. The thread that
    makes it has the turn."""

    def __init__(self, wake: int | None = None, incoming: Sequence[Incoming] = ()) -> None:
        self.wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC) if wake is None else wake
        self._incoming = tuple(incoming)
        self._items: deque[Item] = deque()
        self.qsize = self._items.__len__
        self._asleep = False
        self._turn = threading.Lock()
        self._turn.acquire()
        self._poll = select.epoll()
        self._poll.register(self.wake, select.EPOLLIN | select.EPOLLET)

    def put(self, item: Item) -> None:
        """Appends an item; on any thread."""
        self._items.append(item)
        if self._asleep:
            os.eventfd_write(self.wake, 1)

    def take_turn(self) -> bool:
        """Takes the turn until `give_turn`, on any thread, if the one that has it waits and nothing is there for it."""
        if not self._asleep or not self._turn.acquire(False):
            return False
        if self._items:
            self._turn.release()
            return False
        return True

    def give_turn(self, *, wake: bool) -> None:
        """Gives the turn back. `wake`: there is something to do for the thread that waits."""
        self._turn.release()
        if wake:
            os.eventfd_write(self.wake, 1)

    def get(self, timeout: float) -> Item:
        """Returns the next item, or raises `queue.Empty` when there is none in time, or something else woke it."""
        if timeout > 0 and not self._items:
            self._wait(timeout)
        return self.get_nowait()

    def _wait(self, timeout: float) -> None:
        self._asleep = True
        arrived = bool(self._items)
        for ring in self._incoming:
            if not ring.sleep():
                arrived = True
        if not arrived:
            self._turn.release()
            try:
                self._poll.poll(timeout)
            finally:
                self._turn.acquire()
        self._asleep = False
        for ring in self._incoming:
            ring.awake()

    def get_nowait(self) -> Item:
        """Returns the next item; raises `queue.Empty` when there is none."""
        if not self._items and self.empty():
            raise queue.Empty
        return self._items.popleft()

    def empty(self) -> bool:
        """Returns whether there is nothing, in the rings either."""
        items = self._items
        for ring in self._incoming:
            if ring.arrived():
                for key, payload in ring.take():
                    items.append(("envelope", key, payload))
        return not items

    def close(self) -> None:
        """Gives up what it waits by; the eventfd stays."""
        self._poll.close()

    def counters(self) -> dict[str, int]:
        """Returns what has arrived through the rings."""
        return {
            "received_messages": sum(ring.messages for ring in self._incoming),
            "received_bytes": sum(ring.nbytes for ring in self._incoming),
            "unresolved": sum(ring.unresolved for ring in self._incoming),
        }
