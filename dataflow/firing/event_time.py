"""Event time in a live run, as the messages of one operator's inputs and a clock tell it."""

from __future__ import annotations

from dataflow.firing.admission import EventClock
from dataflow.sync import NEVER

OWN_CLOCK = 1_000_000_000
"""A device whose first stamp is farther (ns) from event time has a clock of its own, which then counts."""


class EventTime:
    """Event time now: by `clock`, and not before the newest stamp that was seen."""

    __slots__ = ("_clock", "_newest", "_shift")

    def __init__(self, clock: EventClock) -> None:
        self._clock = clock
        self._newest, self._shift = NEVER, 0

    def now(self) -> int:
        """The event time, ns."""
        return max(self._clock() + self._shift, self._newest)

    def see(self, stamp: int) -> None:
        """Takes note of the stamp of a message. The first one tells whether its device has a clock of its own."""
        if self._newest == NEVER and abs(stamp - self.now()) > OWN_CLOCK:
            self._shift = stamp - self._clock()
        if stamp > self._newest:
            self._newest = stamp

    def begin_at(self, stamp: int) -> None:
        """The device's clock has jumped, to `stamp`."""
        self._newest, self._shift = NEVER, stamp - self._clock()
