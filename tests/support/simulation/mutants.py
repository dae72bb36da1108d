"""Faults planted in the engine, to see how many seeds the simulation needs to find each."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from dataflow.execution.admission import AdmissionQueue, WaitLimits
from dataflow.execution.calls import Calls
from dataflow.execution.feeds.window import Window
from dataflow.execution.live import LiveRunner
from dataflow.execution.log import FiringLog
from dataflow.execution.ports import OutputPorts
from dataflow.execution.runner import OperatorRunner
from dataflow.machines.pipe import _END, _FRAME, Pipe
from dataflow.process.awake_clock import AwakeClock
from dataflow.process.channel import ChannelClosed, QueuedChannel
from dataflow.process.streams.losses import LossReportingPolicy
from dataflow.sinks.flight_recorder import FlightSink, PendingSpan
from dataflow.sinks.parts import PartsSink
from dataflow.sinks.triggers import Triggers
from dataflow.sync import FOREVER, NEVER
from dataflow.sync.sampled import Sampled

Methods = Mapping[tuple[Any, str], Callable[..., Any]]
"""Methods that take the place of others, by class and name."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """A fault: in words, and the methods that have another body. `replays`: only replays can find it."""

    said: str
    replaced: Callable[[], Methods]
    replays: bool = False

    @contextlib.contextmanager
    def planted(self) -> Iterator[None]:
        """The engine has this fault while the block runs."""
        places = self.replaced()
        before = {(cls, name): cls.__dict__[name] for cls, name in places}
        try:
            for (cls, name), function in places.items():
                setattr(cls, name, function)
            yield
        finally:
            for (cls, name), function in before.items():
                setattr(cls, name, function)


def credit_lost() -> Methods:
    """A source does not hear of every fifth step that is done."""
    right, heard = Window.cover, Counter[int]()

    def cover(self: Window, frontier: int) -> None:
        heard[id(self)] += 1
        if heard[id(self)] % 5:
            right(self, frontier)

    return {(Window, "cover"): cover}


def early_acknowledgement() -> Methods:
    """A source takes a step for done as soon as the one before it is."""
    right = Window.cover

    def cover(self: Window, frontier: int) -> None:
        right(self, frontier)
        if self._outstanding:
            right(self, self._outstanding[0][0])

    return {(Window, "cover"): cover}


def late_record() -> Methods:
    """A firing is recorded after its messages are sent."""
    right, publish = OperatorRunner._record, OutputPorts.publish

    def record(self: OperatorRunner, *args: Any, **fields: Any) -> None:
        publish(self.ports)
        right(self, *args, **fields)

    return {(OperatorRunner, "_record"): record}


def high_frontier() -> Methods:
    """An operator promises one nanosecond too much while it waits: the stamp that it cannot decide yet."""
    right = OutputPorts.promise

    def promise(self: OutputPorts, frontier: int) -> None:
        right(self, frontier + 1 if frontier < FOREVER - 1 else frontier)

    return {(OutputPorts, "promise"): promise}


def spinning_wait() -> Methods:
    """A live operator gives up waiting for a static stream, which cannot be given up: it spins."""

    def exhausted(self: WaitLimits, stamp: int, needs: Mapping[str, int]) -> dict[str, int]:
        if stamp != self._stamp:
            self._stamp, self._since = stamp, self.clock()
        return {
            name: frontier
            for name, frontier in needs.items()
            if (budget := self.wait.get(name)) is not None and self._left(stamp, budget) <= 0
        }

    def give_up(self: LiveRunner) -> bool:
        held = self.aligner.waiting()
        if held is None or not held.needs:
            return False
        given_up = self.patience.exhausted(held.stamp, held.needs)
        for name, frontier in given_up.items():
            self.aligner.force(name, frontier)
            self._timeouts[name] += 1
        return bool(given_up)

    return {(WaitLimits, "exhausted"): exhausted, (LiveRunner, "_give_up"): give_up}


def blocking_supervisor() -> Methods:
    """The supervisor waits until a process has taken what is sent to it, each version of it."""
    right = QueuedChannel.send

    def send(self: QueuedChannel, kind: str, fields: dict[str, Any], *, replaces: bool = False) -> None:
        right(self, kind, fields)
        self._socket.setblocking(True)
        with contextlib.suppress(ChannelClosed):
            while self._queue:
                self.flush()
        self._socket.setblocking(False)

    return {(QueuedChannel, "send"): send}


def deaf_to_itself() -> Methods:
    """A live operator forgets what it gave to itself while it was asked."""

    def decide(self: LiveRunner) -> bool:
        fired = OperatorRunner.step(self)
        self._told = fired and self.idle == NEVER
        if fired:
            self._wake_again()
        return fired

    return {(LiveRunner, "_decide"): decide}


def gap_taken() -> Methods:
    """The pipe between machines goes on behind what a reset link has lost."""
    right = Pipe._on_frame

    def on_frame(self: Pipe, sample: Any) -> None:
        _, number, kind = _FRAME.unpack_from(sample.payload.to_bytes())
        if number > self._expected and kind == _END:
            self._expected = number
        right(self, sample)

    return {(Pipe, "_on_frame"): on_frame}


def state_before() -> Methods:
    """An operator records the state that it had at its last snapshot."""
    right, last = Calls.snapshot, dict[int, bytes | None]()

    def snapshot(self: Calls, place: tuple[int, int]) -> bytes | None:
        before, last[id(self)] = last.get(id(self)), right(self, place)
        return last[id(self)] if before is None else before

    return {(Calls, "snapshot"): snapshot}


def not_restored() -> Methods:
    """A reload does not record the state with which the new code goes on."""
    right = FiringLog.add

    def add(self: FiringLog, kind: Any, *args: Any, **fields: Any) -> None:
        if kind != "restore":
            right(self, kind, *args, **fields)

    return {(FiringLog, "add"): add}


def short_memory() -> Methods:
    """A flight recorder keeps half of what was before a trigger."""
    right = FlightSink._keep

    def keep(self: FlightSink, wanted: PendingSpan, outcome: str = "") -> None:
        wanted.start += self.flight.keep // 2
        right(self, wanted, outcome)

    return {(FlightSink, "_keep"): keep}


def always(cls: Any, name: str, function: Callable[..., Any]) -> Callable[[], Methods]:
    """A method has another body."""
    return lambda: {(cls, name): function}


MUTANTS: Mapping[str, Mutant] = {
    "credit": Mutant("a credit is lost", credit_lost),
    "acknowledgement": Mutant("an acknowledgement comes too early", early_acknowledgement),
    "record": Mutant("a record is written after its message", late_record),
    "frontier": Mutant("a frontier is too high", high_frontier),
    "static_wait": Mutant("an operator spins on a static input that has not come", spinning_wait),
    "frozen": Mutant("the supervisor waits for a process that is frozen", blocking_supervisor),
    "gap": Mutant(
        "a gap is not counted", always(LossReportingPolicy, "lost", lambda self, stream, first, following: None)
    ),
    "drop": Mutant("a drop is not recorded", always(AdmissionQueue, "_drop", lambda self, *dropped: None)),
    "itself": Mutant("an operator does not notice what it gives to itself", deaf_to_itself),
    "pause": Mutant("a pause counts against processes", always(AwakeClock, "__call__", lambda self: self._clock())),
    "part": Mutant("a part lacks operators that rest in it", always(PartsSink, "_introduce_all", lambda self: None)),
    "state": Mutant("a state is recorded that is over", state_before),
    "reload": Mutant("a reload does not record the state that it keeps", not_restored),
    "again": Mutant(
        "a trigger asks again while it holds", always(Triggers, "_begins", lambda self, trigger, name, holds: holds)
    ),
    "drops": Mutant("a trigger by drops does nothing", always(Triggers, "diagnostics", lambda self, message: ())),
    "half": Mutant("a flight recorder keeps half of the time", short_memory),
    "sample": Mutant(
        "a firing does not wait for what it samples", always(Sampled, "knows", lambda self, stamp: True), replays=True
    ),
    "link": Mutant("a pipe goes on behind what its link has lost", gap_taken),
}
