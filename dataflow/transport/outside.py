"""Publishes streams to subscribers from outside the run, on a separate thread: none of them holds up the graph.

Messages wait in a queue. In a live run it is bounded by dropping: the oldest go first, and
subscribers see a gap in the numbers. In any other run nothing is lost, so a subscriber that is too slow makes the run
wait once the queue is full.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque

from dataflow.transport.publisher import BusError, Counters, StreamPublisher

MOST_MESSAGES, MOST_BYTES = 4096, 256 << 20
CLOSE_WITHIN = 2.0


class OutsidePublisher:
    """The queue of what subscribers from outside are to get. `lossless`: it makes its producer wait when it is full."""

    def __init__(self, counted: Counters, *, lossless: bool) -> None:
        self._counted, self._lossless = counted, lossless
        self._queue: deque[tuple[StreamPublisher, bytes]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closed = False

    def put(self, publisher: StreamPublisher, payload: bytes) -> None:
        """Publishes after everything that was put before."""
        with self._changed:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="outside", daemon=True)
                self._thread.start()
            if self._lossless:
                self._changed.wait_for(lambda: not self._full() or self._closed)
            self._queue.append((publisher, payload))
            self._bytes += len(payload)
            while self._full() and not self._lossless and len(self._queue) > 1:
                self._bytes -= len(self._queue.popleft()[1])
                self._counted.add("unpublished")
            self._changed.notify_all()

    def close(self) -> None:
        """Publishes what is left, as far as that is taken in time; further calls do nothing."""
        deadline = time.monotonic() + CLOSE_WITHIN
        with self._changed:
            self._changed.wait_for(lambda: not self._queue or self._closed, deadline - time.monotonic())
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(max(0.0, deadline - time.monotonic()))

    def _full(self) -> bool:
        return len(self._queue) > MOST_MESSAGES or self._bytes > MOST_BYTES

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._queue) or self._closed)
                if self._closed:
                    return
                publisher, payload = self._queue.popleft()
                self._bytes -= len(payload)
                self._changed.notify_all()
            try:
                publisher.put(payload)
            except BusError as error:
                if not self._closed:  # else the bus was closed over a subscriber that takes nothing
                    print(f"nothing is published any more: {error}", file=sys.stderr)
                return
