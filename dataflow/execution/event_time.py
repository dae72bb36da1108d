"""Event time in a live run, as the messages of one operator's inputs and a clock tell it."""

from __future__ import annotations

from dataflow.execution.admission import EventClock
from dataflow.sync import NEVER

OWN_CLOCK = 1_000_000_000
"""A device whose first stamp is farther (ns) from event time has a separate clock, which then counts."""


class EventTime:
    """Event time now: by `clock`, and not before the newest stamp that was seen."""

    __slots__ = ("_clock", "_newest", "_shift")

    def __init__(self, clock: EventClock) -> None:
        self._clock = clock
        self._newest, self._shift = NEVER, 0

    def now(self) -> int:
        """The event time, ns."""
        return max(self._clock() + self._shift, self._newest)

    def until(self, stamp: int) -> int:
        """Returns how long it takes (ns) until event time is `stamp`; 0 when it is. That passes with the clock, also
        while event time stands still at a stamp that was seen before the clock came there."""
        return 0 if stamp <= self._newest else max(0, stamp - self._clock() - self._shift)

    def see(self, stamp: int) -> None:
        """Takes note of the stamp of a message. The first one shows whether its device has a separate clock. The offset
        of that clock is taken from the message with the lowest latency: the first one may have been delayed."""
        own_clock = self._newest == NEVER and abs(stamp - self.now()) > OWN_CLOCK
        if own_clock or (self._shift and stamp - self._clock() > self._shift):
            self._shift = stamp - self._clock()
        if stamp > self._newest:
            self._newest = stamp

    def begin_at(self, stamp: int) -> None:
        """The device's clock has jumped, to `stamp`."""
        self._newest, self._shift = NEVER, stamp - self._clock()
