"""Messages that wait to be drawn: bounded in number and bytes; where there is no room, the oldest goes."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field

from dataflow.messages import Message
from dataflow.view.scores import Summaries


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds on what may wait for the viewer: messages and bytes of arrays."""

    messages: int = 500
    bytes: int = 64 << 20


@dataclass(slots=True)
class Backlog:
    """The queue between the callers of a sink and its drawing thread.

    Messages that hold for all time are never dropped.
    """

    bounds: Bounds
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _static: deque[tuple[str, Message]] = field(default_factory=deque)
    _messages: deque[tuple[str, Message]] = field(default_factory=deque)
    _scores: Summaries = field(default_factory=dict)
    _bytes: int = 0
    _closing: bool = False

    def put_static(self, stream: str, message: Message) -> bool:
        """Adds a message that holds for all time; returns whether it was taken."""
        with self._changed:
            if not self._closing:
                self._static.append((stream, message))
            self._changed.notify_all()
            return not self._closing

    def put(self, stream: str, message: Message, wait: float) -> int | None:
        """Adds a message, after waiting up to `wait` seconds for room; returns how many were dropped for it.

        None: it was not taken, for the sink is closing.
        """
        size, dropped = message.nbytes(), 0
        with self._changed:
            if self._closing:
                return None
            if wait > 0:
                self._changed.wait_for(lambda: not self._full(size) or self._closing, wait)
            while self._messages and self._full(size):
                self._bytes -= self._messages.popleft()[1].nbytes()
                dropped += 1
            self._messages.append((stream, message))
            self._bytes += size
            self._changed.notify_all()
        return dropped

    def put_scores(self, scores: Summaries) -> None:
        """Sets the scores; they are given out before messages."""
        with self._changed:
            self._scores = scores
            self._changed.notify_all()

    def take(self) -> tuple[str, Message] | Summaries | None:
        """Waits for the next (stream, message), or scores; None where nothing is left and nothing will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._scores or self._static or self._messages or self._closing)
            if self._scores:
                scores, self._scores = self._scores, {}
                return scores
            if self._static:
                return self._static.popleft()
            if not self._messages:
                return None
            stream, message = self._messages.popleft()
            self._bytes -= message.nbytes()
            self._changed.notify_all()
            return stream, message

    def close(self) -> None:
        """Takes nothing more; what waits is still given out."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()

    def __len__(self) -> int:
        with self._changed:
            return len(self._static) + len(self._messages)

    def _full(self, size: int) -> bool:
        """Returns whether another message of `size` bytes is too much; one message alone never is."""
        return bool(self._messages) and (
            len(self._messages) >= self.bounds.messages or self._bytes + size > self.bounds.bytes
        )
