"""Live admission: what an operator is given when time will not wait for it.

The aligner is the same as in a replay. In front of it stand bounded queues with the operator's declared policy, and a
clock that gives up waiting: when an input's `wait` has run out, its frontier is forced. All of this only changes which
messages reach which firing; the firing records say which, so a live run can be repeated exactly.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import NamedTuple

from dataflow.graph.model import Node
from dataflow.operator import Operator
from dataflow.runtime.firings import DropRecord
from dataflow.runtime.runner import Emitter, OperatorRunner
from dataflow.sync import NEVER, Entry

Clock = Callable[[], float]
"""Seconds, never going back."""

EventClock = Callable[[], int]
"""The event time that a device's message would be stamped with now, ns since the epoch."""


class _Arrival(NamedTuple):
    """One thing that a stream said: a message, a frontier or its end."""

    kind: str
    stamp: int
    entry: Entry | None = None
    reason: str = ""


class AdmissionQueue:
    """What waits in front of the triggers of one operator, a queue for each stream.

    At most `size` messages a stream: of more, policy `newest` drops the oldest and `oldest` the arriving one; `block`
    drops none, since flow control holds the producer back.
    """

    def __init__(self, policy: str, size: int, triggers: Mapping[str, str]) -> None:
        self.policy, self.size = policy, size
        self.triggers = triggers  # stream → input
        self._queues: dict[str, deque[_Arrival]] = {stream: deque() for stream in triggers}
        self._messages: Counter[str] = Counter()
        self.dropped: list[DropRecord] = []

    def put(self, stream: str, arrival: _Arrival) -> None:
        queue = self._queues[stream]
        if arrival.kind == "message":
            if self.policy != "block" and self._messages[stream] >= self.size:
                if self.policy == "oldest":
                    self._drop(stream, arrival)
                    return
                self._drop_oldest(stream)
            self._messages[stream] += 1
        elif arrival.kind == "frontier" and queue and queue[-1].kind == "frontier":
            queue.pop()  # the new promise holds all that the old one did
        queue.append(arrival)

    def take(self) -> tuple[str, _Arrival] | None:
        """The arrival with the oldest stamp (an end last), and its stream."""
        waiting = [(q[0].kind == "end", q[0].stamp, s) for s, q in self._queues.items() if q]
        if not waiting:
            return None
        stream = min(waiting)[2]
        arrival = self._queues[stream].popleft()
        self._messages[stream] -= arrival.kind == "message"
        return stream, arrival

    def _drop_oldest(self, stream: str) -> None:
        queue = self._queues[stream]
        for place, arrival in enumerate(queue):
            if arrival.kind == "message":
                del queue[place]
                self._messages[stream] -= 1
                self._drop(stream, arrival)
                return

    def _drop(self, stream: str, arrival: _Arrival) -> None:
        entry = arrival.entry
        assert entry is not None
        self.dropped.append(
            DropRecord(self.triggers[stream], stream, entry.incarnation, entry.seq, entry.stamp, "overflow")
        )


class Patience:
    """How long a decision has waited, and which inputs it need not wait for any longer.

    A decision waits from when it came up, and never before event time has reached its stamp: a tick that lies ahead
    cannot be late.
    """

    def __init__(self, wait: Mapping[str, int | None], clock: Clock, event_clock: EventClock) -> None:
        self.wait, self.clock, self.event_clock = wait, clock, event_clock
        self._stamp = NEVER
        self._since = 0.0

    def exhausted(self, stamp: int, needs: Mapping[str, int]) -> dict[str, int]:
        """Of the frontiers that a decision at `stamp` needs, those whose input has had its time."""
        if stamp != self._stamp:
            self._stamp, self._since = stamp, self.clock()
        return {
            name: frontier
            for name, frontier in needs.items()
            if (budget := self.wait.get(name)) is not None and self._left(stamp, budget) <= 0
        }

    def due_in(self, stamp: int, needs: Mapping[str, int]) -> float | None:
        """Seconds until the next input has had its time; None when there is nothing to give up."""
        budgets = [b for name in needs if (b := self.wait.get(name)) is not None]
        return max(0.0, self._left(stamp, min(budgets))) if budgets else None

    def _left(self, stamp: int, budget: int) -> float:
        since_asked = self._since + budget * 1e-9 - self.clock()
        since_stamp = (stamp + budget - self.event_clock()) * 1e-9
        return max(since_asked, since_stamp)


class LiveRunner(OperatorRunner):
    """One operator in a live run."""

    def __init__(
        self,
        node: Node,
        emitter: Emitter,
        *,
        static: frozenset[str],
        seed: int = 0,
        paranoid: bool = False,
        operator: Operator | None = None,
        clock: Clock = time.monotonic,
        event_clock: EventClock = time.time_ns,
    ) -> None:
        super().__init__(node, emitter, static=static, seed=seed, paranoid=paranoid, operator=operator)
        triggers = {
            stream: port.name
            for port in self.spec.triggers
            for stream in node.inputs.get(port.name, ())
            if stream not in static
        }
        self.queue = AdmissionQueue(node.live.queue, node.live.size, triggers)
        self.patience = Patience(node.live.wait, clock, event_clock)
        self.forced: Counter[tuple[str, str]] = Counter()

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        return {**self.aligner.drops, **self.forced}

    def push(self, stream: str, entry: Entry) -> None:
        if stream in self.queue.triggers:
            self.queue.put(stream, _Arrival("message", entry.stamp, entry))
        else:
            self.aligner.push(stream, entry)

    def advance(self, stream: str, frontier: int) -> None:
        if stream in self.queue.triggers:
            self.queue.put(stream, _Arrival("frontier", frontier))
        else:
            self.aligner.advance(stream, frontier)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        if stream in self.queue.triggers:
            self.queue.put(stream, _Arrival("end", NEVER if final_stamp is None else final_stamp, None, reason))
        else:
            self.aligner.end(stream, final_stamp, reason)

    def step(self) -> bool:
        """One firing: of what is decided; else of what the queues hold; else of what has waited long enough."""
        if super().step():
            return True
        while not self.ended:
            taken = self.queue.take()
            if taken is not None:
                self._admit(*taken)
            elif not self._give_up():
                return False
            if super().step():
                return True
        return False

    def next_due(self) -> float | None:
        """Seconds until a decision need not wait any longer; None when nothing waits for the clock."""
        held = None if self.ended else self.aligner.waiting()
        return None if held is None else self.patience.due_in(held.stamp, held.needs)

    def take_drops(self) -> list[DropRecord]:
        mine, self.queue.dropped = self.queue.dropped, []
        for drop in mine:
            self.forced[drop.input, drop.reason] += 1
        return [*mine, *super().take_drops()]

    def _admit(self, stream: str, arrival: _Arrival) -> None:
        match arrival.kind:
            case "message":
                assert arrival.entry is not None
                self.aligner.push(stream, arrival.entry)
            case "frontier":
                self.aligner.advance(stream, arrival.stamp)
            case "end":
                self.aligner.end(stream, None if arrival.stamp == NEVER else arrival.stamp, arrival.reason)

    def _give_up(self) -> bool:
        """Forces the frontiers of inputs whose wait has run out; False when there is none."""
        held = self.aligner.waiting()
        if held is None or not held.needs:
            return False
        exhausted = self.patience.exhausted(held.stamp, held.needs)
        for name, frontier in exhausted.items():
            self.forced[name, "timeout"] += 1
            self.aligner.force(name, frontier)
        return bool(exhausted)
