"""Chooses which images, overlays and clouds a file shows: in each step of event time the first of each stream. Pure.

The steps are the same for all streams, and a choice depends on nothing but the stream's own stamps: an image and what
was made from it, which has its stamp, are chosen together, in whatever order streams arrive. So what is drawn over an
image belongs to it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

from dataflow.messages import Message


@dataclass(slots=True)
class Pace:
    """The choice of one viewer session.

    `step`: event time (ns) in which one message of each of `streams` is drawn; 0: every message.
    """

    step: int = 0
    streams: Collection[str] = frozenset()
    _drawn: dict[str, int] = field(default_factory=dict)  # stream: the step of its last drawn message
    _passed: dict[str, Message] = field(default_factory=dict)  # stream: its last message, where that was not drawn

    def takes(self, stream: str, message: Message) -> bool:
        """Returns whether a message is drawn. One that is passed over is drawn at the end if it is its last."""
        if self.step == 0 or stream not in self.streams:
            return True
        step = message.stamp // self.step
        if self._drawn.get(stream) == step:
            self._passed[stream] = message
            return False
        self._drawn[stream] = step
        self._passed.pop(stream, None)
        return True

    def rest(self) -> Iterator[tuple[str, Message]]:
        """Gives the last message of each stream where it was passed over, by stamp: its end is shown."""
        yield from sorted(self._passed.items(), key=lambda entry: (entry[1].stamp, entry[0]))
        self._passed.clear()
