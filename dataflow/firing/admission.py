"""Live admission: what an operator is given when time will not wait for it.

The aligner is the same as in a replay. In front of it stand bounded queues with the operator's declared policy, and a
clock that gives up waiting: when an input's `wait` has run out, its frontier is forced. All of this only changes which
messages reach which firing; the firing records say which, so a live run can be repeated exactly.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from dataflow.firing.restarts import Restarts
from dataflow.firing.runner import Emitter, OperatorFailure, OperatorRunner, Recorder, set_up_again
from dataflow.graph.model import Node
from dataflow.operator import Operator
from dataflow.records.firing import DropRecord
from dataflow.sync import NEVER, Aligner, Entry, Firing, InputValue, StreamOrderError

Clock = Callable[[], float]
"""Seconds, never going back."""

EventClock = Callable[[], int]
"""The event time that a device's message would be stamped with now, ns since the epoch."""


HANG = 3600.0
"""Seconds that a planned hang lasts, unless somebody ends it."""


OWN_CLOCK = 1_000_000_000
"""A device whose first stamp is farther (ns) from event time has a clock of its own, which then counts."""


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

    def clear(self, reason: str) -> None:
        """Drops every message that waits."""
        for stream, queue in self._queues.items():
            for arrival in queue:
                if arrival.kind == "message":
                    self._drop(stream, arrival, reason)
            ends = [arrival for arrival in queue if arrival.kind == "end"]
            queue.clear()
            queue.extend(ends)
        self._messages.clear()

    def _drop_oldest(self, stream: str) -> None:
        queue = self._queues[stream]
        for place, arrival in enumerate(queue):
            if arrival.kind == "message":
                del queue[place]
                self._messages[stream] -= 1
                self._drop(stream, arrival)
                return

    def _drop(self, stream: str, arrival: _Arrival, reason: str = "overflow") -> None:
        entry = arrival.entry
        assert entry is not None
        self.dropped.append(
            DropRecord(self.triggers[stream], stream, entry.incarnation, entry.seq, entry.stamp, reason)
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
    """One operator in a live run. It outlives its failures as its restart policy allows.

    A failed operator is made anew after the back-off and goes on with what is then in its queues; its streams begin a
    new incarnation. `on_failure` is told of every failure that is outlived.
    """

    def __init__(
        self,
        node: Node,
        emitter: Emitter,
        *,
        static: frozenset[str],
        seed: int = 0,
        paranoid: bool = False,
        operator: Operator | None = None,
        snapshots: int | None = None,
        clock: Clock = time.monotonic,
        event_clock: EventClock = time.time_ns,
        on_failure: Callable[[OperatorFailure, float], None] = lambda failure, pause: None,
    ) -> None:
        super().__init__(
            node,
            emitter,
            static=static,
            seed=seed,
            paranoid=paranoid,
            operator=operator,
            lossy=True,
            snapshots=snapshots,
        )
        triggers = {
            stream: port.name
            for port in self.spec.triggers
            for stream in node.inputs.get(port.name, ())
            if stream not in static
        }
        self.queue = AdmissionQueue(node.live.queue, node.live.size, triggers)
        self._event_clock = event_clock
        self._newest, self._shift = NEVER, 0
        self.patience = Patience(node.live.wait, clock, self._event_time)
        self.restarts = Restarts(node.live.restart, clock)
        self.forced: Counter[tuple[str, str]] = Counter()
        self.absent: set[str] = set()
        """Streams whose operator is gone at the moment."""
        self._static = static
        self._statics: dict[str, Entry] = {}
        self._on_failure = on_failure
        self._seen: dict[str, tuple[int, int]] = {}  # stream → incarnation, last stamp
        self._changed: dict[str, Any] = {}
        self._injected: str | None = None
        self._delay: tuple[float, float] = (0.0, 0.0)  # seconds before each firing, until when
        self._leaked: list[bytearray] = []
        self._clock = clock

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        withheld = {(f"→ {port}", "non_monotonic"): n for port, n in self.ports.withheld.items()}
        return {**self.aligner.drops, **self.forced, **withheld}

    # What streams say

    def push(self, stream: str, entry: Entry) -> None:
        if stream in self._static:
            self._statics[stream] = Entry(entry.stamp, entry.value, entry.seq, entry.incarnation, entry.digest, stream)
        else:
            incarnation, last = self._seen.get(stream, (entry.incarnation, NEVER))
            if entry.incarnation > incarnation and entry.stamp <= last and not self.ended:
                self._reset(stream, entry.stamp)
            self._seen[stream] = (entry.incarnation, entry.stamp)
            if self._newest == NEVER and abs(entry.stamp - self._event_time()) > OWN_CLOCK:
                self._shift = entry.stamp - self._event_clock()  # a device whose clock is not this machine's
            self._newest = max(self._newest, entry.stamp)
        if self.restarts.pending:
            self.done = max(self.done, entry.stamp)  # nobody waits for an operator that is away
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
            self._end_at(stream, final_stamp, reason)

    # Work

    def step(self) -> bool:
        """One firing: of what is decided; else of what the queues hold; else of what has waited long enough."""
        if self.restarts.pending:
            if self.restarts.due_in() > 0:
                return False
            self._start_again()
        self._skip_old_ticks()
        if super().step():
            return True
        while not self.ended:
            taken = self.queue.take()
            if taken is not None:
                self._admit(*taken)
            elif not self._give_up():
                return False
            self._skip_old_ticks()
            if super().step():
                return True
        return False

    def _skip_old_ticks(self) -> None:
        """Of the ticks that came due while the operator was busy, only the newest are made up for, as many as its queue
        holds; without this a slow operator would fall behind for ever."""
        if self.node.every is not None and self.queue.policy != "block" and not self.ended:
            patience = max((wait for wait in self.node.live.wait.values() if wait is not None), default=0)
            self.aligner.skip_ticks(self._event_time() - patience - self.queue.size * self.node.every)

    def next_due(self) -> float | None:
        """Seconds until a decision need not wait any longer; None when nothing waits for the clock."""
        if self.restarts.pending:
            return self.restarts.due_in()
        held = None if self.ended else self.aligner.waiting()
        return None if held is None else self.patience.due_in(held.stamp, held.needs)

    def take_drops(self) -> list[DropRecord]:
        mine, self.queue.dropped = self.queue.dropped, []
        for drop in mine:
            self.forced[drop.input, drop.reason] += 1
        return [*mine, *super().take_drops()]

    def set_parameter(self, name: str, value: Any) -> Any:
        changed = super().set_parameter(name, value)
        self._changed[name] = value
        return changed

    def resume(self, incarnation: int, last: Mapping[str, int], changed: Mapping[str, Any]) -> None:
        """Takes the place of an operator whose process died; to be called before `setup()`."""
        self.records = Recorder(self.node.name, self.ports.emitter, incarnation)
        self.ports.resume(incarnation, last)
        self._changed = dict(changed)
        for name, value in changed.items():
            self.operator.set_parameter(name, value)

    def begin_fault(self, kind: str, fields: Mapping[str, Any]) -> None:
        """A planned fault: `raise` fails the next firing without calling the operator, `hang` never ends it, `slow`
        begins every firing late for a while, `leak` takes memory that is not given back."""
        match kind:
            case "raise":
                self._injected = "planned"
            case "hang":
                self._delay = (HANG, self._clock() + HANG)
            case "slow":
                self._delay = (fields["by"], self._clock() + fields["span"])
            case "leak":
                noise = os.urandom(1 << 20)
                self._leaked += [bytearray(noise) for _ in range(fields["megabytes"])]  # others get a turn in between

    def _fire(self, firing: Firing) -> None:
        if self.absent:
            firing = self._without_the_absent(firing)
        pause, until = self._delay
        try:
            if pause and self._clock() < until:
                time.sleep(pause)
            if self._injected is not None and firing.kind != "finish":
                self._fail_injected(firing)
            super()._fire(firing)
        except OperatorFailure as failure:
            if firing.kind == "finish" or not self.restarts.failed():
                raise
            self._on_failure(failure, self.restarts.due_in())

    def _fail_injected(self, firing: Firing) -> None:
        reason, self._injected = self._injected, None
        failure = OperatorFailure(self.node.name, f"{firing.kind} at stamp {firing.stamp}", InjectedFault(reason))
        self._record(firing.kind, firing, time.time_ns(), (), failure.summary, injected=True)
        raise failure

    def _without_the_absent(self, firing: Firing) -> Firing:
        """Marks inputs stale whose producer is gone; drops what they still hold where the policy says so."""
        gone = frozenset(
            name
            for name, port in self.spec.inputs.items()
            if port.kind == "sampled" and not self.absent.isdisjoint(self.node.inputs.get(name, ()))
        )
        if not gone:
            return firing
        inputs = dict(firing.inputs)
        if self.node.live.on_stale == "drop":
            inputs |= {
                name: None for name in gone if not self.spec.inputs[name].required and not _is_many(inputs, name)
            }
        return Firing(firing.stamp, firing.kind, firing.tick, inputs, firing.stale | gone, firing.late)

    def _start_again(self) -> None:
        """A fresh operator in the place of the failed one, with the parameters as they were last set."""
        self.restarts.begun()
        old, self.operator = self.operator, self.node.make()
        self._begin_incarnation()
        try:
            _close_quietly(old)
            for name, value in self._changed.items():
                self.operator.set_parameter(name, value)
            set_up_again(self.operator, self.ports, self.records, self.node, self.seed)
        except OperatorFailure as failure:
            if not self.restarts.failed():
                raise
            self._on_failure(failure, self.restarts.due_in())

    def _reset(self, stream: str, stamp: int) -> None:
        """The clock behind a stream jumped back: alignment begins anew, and so do the operator's own streams."""
        started = time.time_ns()
        name = next(n for n, streams in self.node.inputs.items() if stream in streams)
        self.queue.clear("reset")
        drops = self.take_drops()
        self.forced += Counter(dict(self.aligner.drops))
        for held, count in self.aligner.buffered().items():
            if count and self.spec.inputs[held].kind != "sampled":
                self.forced[held, "reset"] += count
        ends = {s: e for s, e in self.aligner.ends.items() if s != stream and s not in self._static}
        self.aligner = Aligner(self.aligner.spec)
        for static in self._statics.values():
            self.aligner.push(static.stream, static)
        for ended, end in ends.items():
            self.aligner.end(ended, None, end.reason)
        self._newest, self._shift = NEVER, stamp - self._event_clock()
        self._begin_incarnation(stamps_go_back=True)
        self.done = NEVER
        try:
            self.operator.on_reset(name)
        except Exception as error:
            failure = OperatorFailure(self.node.name, "on_reset()", error)
            detail = {"input": name, "error": failure.summary}
            self.records.add("reset", NEVER + 1, started, outcome="error", drops=tuple(drops), detail=detail)
            raise failure from error
        self.records.add("reset", NEVER + 1, started, drops=tuple(drops), detail={"input": name})

    def _begin_incarnation(self, *, stamps_go_back: bool = False) -> None:
        incarnation = self.records.incarnation + 1
        self.records = Recorder(self.node.name, self.ports.emitter, incarnation)
        self.ports.begin(incarnation, stamps_go_back=stamps_go_back)

    def _event_time(self) -> int:
        """Event time now: by the clock, and not before what has been seen."""
        return max(self._event_clock() + self._shift, self._newest)

    def _admit(self, stream: str, arrival: _Arrival) -> None:
        match arrival.kind:
            case "message":
                assert arrival.entry is not None
                self.aligner.push(stream, arrival.entry)
            case "frontier":
                self.aligner.advance(stream, arrival.stamp)
            case "end":
                self._end_at(stream, None if arrival.stamp == NEVER else arrival.stamp, arrival.reason)

    def _end_at(self, stream: str, final_stamp: int | None, reason: str) -> None:
        try:
            self.aligner.end(stream, final_stamp, reason)
        except StreamOrderError:  # its clock went back, and it ended before it sent a message at its new time
            self.aligner.end(stream, None, reason)

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


class InjectedFault(RuntimeError):
    """A failure that was asked for, to see what follows from it."""


def _is_many(inputs: Mapping[str, InputValue], name: str) -> bool:
    return isinstance(inputs.get(name), Mapping)


def _close_quietly(operator: Operator) -> None:
    """Closes an operator that has failed; what else goes wrong in it is printed, since the first failure is known."""
    try:
        operator.close()
    except Exception as error:
        print(f"{type(operator).__name__}.close() after a failure: {type(error).__name__}: {error}", file=sys.stderr)
