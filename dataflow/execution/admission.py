"""Live admission: what waits before an operator's triggers, event time, and how long decisions wait for inputs."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import NamedTuple

from dataflow.sync import FOREVER, NEVER, Drop, DropLog, DropReason, Entry

Clock = Callable[[], float]
"""Seconds, never going back."""

EventClock = Callable[[], int]
"""The event time that a device's message would be stamped with now, ns since the epoch."""


class Frontier(NamedTuple):
    """A frontier of a stream, or its end."""

    stamp: int
    ends: bool = False
    reason: str = ""


Arrival = Entry | Frontier
"""One thing that a stream said."""


class AdmissionQueue:
    """Queues in front of the triggers of one operator, one for each stream.

    At most `size` messages a stream: of more, policy `newest` drops the oldest and `oldest` the arriving one; `block`
    drops none, since flow control holds the producer back. Dropped messages go to `log`.
    """

    def __init__(self, policy: str, size: int, triggers: Mapping[str, str], log: DropLog) -> None:
        self.policy, self.size, self.log = policy, size, log
        self.triggers = triggers  # stream → input
        self._queues: dict[str, deque[Arrival]] = {stream: deque() for stream in triggers}
        self._messages: Counter[str] = Counter()

    def put(self, stream: str, entry: Entry) -> None:
        """Takes a message."""
        if self.policy != "block" and self._messages[stream] >= self.size:
            if self.policy == "oldest":
                self._drop(stream, entry)
                return
            self._drop_oldest(stream)
        self._messages[stream] += 1
        self._queues[stream].append(entry)

    def promise(self, stream: str, promise: Frontier) -> None:
        """Takes a frontier or an end, which holds all that a frontier right before it did."""
        queue = self._queues[stream]
        if not promise.ends and queue and isinstance(last := queue[-1], Frontier) and not last.ends:
            queue.pop()
        queue.append(promise)

    @property
    def holds(self) -> bool:
        """Returns whether anything waits."""
        return any(self._queues.values())

    def take(self) -> tuple[str, Arrival] | None:
        """The arrival with the oldest stamp (an end last), and its stream."""
        if len(self._queues) == 1:
            for stream, queue in self._queues.items():
                if not queue:
                    return None
                arrival = queue.popleft()
                if arrival.__class__ is Entry:
                    self._messages[stream] -= 1
                return stream, arrival
        waiting = [(_is_end(q[0]), q[0].stamp, s) for s, q in self._queues.items() if q]
        if not waiting:
            return None
        stream = min(waiting)[2]
        arrival = self._queues[stream].popleft()
        self._messages[stream] -= arrival.__class__ is Entry
        return stream, arrival

    def clear(self) -> None:
        """Drops every message that waits, since the clock behind an input jumped back."""
        for stream, queue in self._queues.items():
            for arrival in queue:
                if isinstance(arrival, Entry):
                    self._drop(stream, arrival, "reset")
            ends = [arrival for arrival in queue if _is_end(arrival)]
            queue.clear()
            queue.extend(ends)
        self._messages.clear()

    def _drop_oldest(self, stream: str) -> None:
        queue = self._queues[stream]
        for place, arrival in enumerate(queue):
            if isinstance(arrival, Entry):
                del queue[place]
                self._messages[stream] -= 1
                self._drop(stream, arrival)
                return

    def _drop(self, stream: str, entry: Entry, reason: DropReason = "overflow") -> None:
        self.log.add(dropped(self.triggers[stream], stream, entry, reason))


def _is_end(arrival: Arrival) -> bool:
    return isinstance(arrival, Frontier) and arrival.ends


def dropped(input: str, stream: str, entry: Entry, reason: DropReason) -> Drop:
    """The drop of a message that never reached the aligner."""
    return Drop(input, stream, entry.stamp, entry.seq, entry.incarnation, reason)


class WaitLimits:
    """Measures how long a decision has waited, and which inputs it need not wait for any longer.

    A decision waits from when it came up, and never before event time has reached its stamp: a tick that lies ahead
    cannot be late. A static stream is waited for without a limit, since nothing takes its place.
    """

    def __init__(self, wait: Mapping[str, int | None], clock: Clock, until: Callable[[int], int]) -> None:
        self.wait, self.clock = wait, clock
        self._until = until  # event time is a stamp: how long that takes, ns
        self._stamp = NEVER
        self._since = 0.0

    def exhausted(self, stamp: int, needs: Mapping[str, int]) -> dict[str, int]:
        """Of the frontiers that a decision at `stamp` needs, those whose input has had its time."""
        if stamp != self._stamp:
            self._stamp, self._since = stamp, self.clock()
        return {
            name: frontier
            for name, frontier in needs.items()
            if frontier < FOREVER and (budget := self.wait.get(name)) is not None and self._left(stamp, budget) <= 0
        }

    def due_in(self, stamp: int, needs: Mapping[str, int]) -> float | None:
        """Seconds until the next input has had its time; None when there is nothing to give up."""
        limited = [b for name, need in needs.items() if need < FOREVER and (b := self.wait.get(name)) is not None]
        return max(0.0, self._left(stamp, min(limited))) if limited else None

    def _left(self, stamp: int, budget: int) -> float:
        since_asked = self._since + budget * 1e-9 - self.clock()
        since_stamp = self._until(stamp + budget) * 1e-9
        return max(since_asked, since_stamp)


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
