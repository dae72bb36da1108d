"""Faults planted in the engine, to see how many seeds the simulation needs to find each."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from dataflow.execution.admission import AdmissionQueue, Patience
from dataflow.execution.calls import Calls
from dataflow.execution.feeds.window import Window
from dataflow.execution.live import LiveRunner
from dataflow.execution.log import FiringLog
from dataflow.execution.ports import OutputPorts
from dataflow.execution.runner import OperatorRunner
from dataflow.machines.pipe import _END, _FRAME, Pipe
from dataflow.process.awake import AwakeClock
from dataflow.process.channel import ChannelClosed, QueuedChannel
from dataflow.process.streams.losses import LossTold
from dataflow.sinks.flight_recorder import FlightSink, Wanted
from dataflow.sinks.parts import PartsSink
from dataflow.sinks.triggers import Triggers
from dataflow.sync import FOREVER, NEVER
from dataflow.sync.sampled import Sampled


class Mutant:
    """A fault: methods that take the place of others, by class and name."""

    said = ""
    replays = False
    """Whether only replays can find it."""

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        raise NotImplementedError

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


class CreditLost(Mutant):
    """A source does not hear of every fifth step that is done."""

    said = "a credit is lost"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = Window.cover

        heard: Counter[int] = Counter()

        def cover(self: Window, frontier: int) -> None:
            heard[id(self)] += 1
            if heard[id(self)] % 5:
                right(self, frontier)

        return {(Window, "cover"): cover}


class EarlyAcknowledgement(Mutant):
    """A source takes a step for done as soon as the one before it is."""

    said = "an acknowledgement comes too early"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = Window.cover

        def cover(self: Window, frontier: int) -> None:
            right(self, frontier)
            if self._outstanding:
                right(self, self._outstanding[0][0])

        return {(Window, "cover"): cover}


class LateRecord(Mutant):
    """A firing is recorded after its messages are sent."""

    said = "a record is written after its message"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = OperatorRunner._record
        publish = OutputPorts.publish

        def record(self: OperatorRunner, *args: Any, **fields: Any) -> None:
            publish(self.ports)
            right(self, *args, **fields)

        return {(OperatorRunner, "_record"): record}


class HighFrontier(Mutant):
    """An operator promises one nanosecond too much while it waits: the stamp that it cannot decide yet."""

    said = "a frontier is too high"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = OutputPorts.promise

        def promise(self: OutputPorts, frontier: int) -> None:
            right(self, frontier + 1 if frontier < FOREVER - 1 else frontier)

        return {(OutputPorts, "promise"): promise}


class SpinningWait(Mutant):
    """A live operator gives up waiting for a static stream, which cannot be given up: it spins."""

    said = "an operator spins on a static input that has not come"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        def exhausted(self: Patience, stamp: int, needs: Mapping[str, int]) -> dict[str, int]:
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

        return {(Patience, "exhausted"): exhausted, (LiveRunner, "_give_up"): give_up}


class BlockingSupervisor(Mutant):
    """The supervisor waits until a process has taken what is sent to it, each version of it."""

    said = "the supervisor waits for a process that is frozen"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = QueuedChannel.send

        def send(self: QueuedChannel, kind: str, fields: dict[str, Any], *, replaces: bool = False) -> None:
            right(self, kind, fields)
            self._socket.setblocking(True)
            with contextlib.suppress(ChannelClosed):
                while self._queue:
                    self.flush()
            self._socket.setblocking(False)

        return {(QueuedChannel, "send"): send}


class SilentGap(Mutant):
    """A gap in a stream is not told to the supervisor."""

    said = "a gap is not counted"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        def lost(self: LossTold, stream: str, first: int, following: int) -> None:
            return None

        return {(LossTold, "lost"): lost}


class SilentDrop(Mutant):
    """A queue that overflows drops without a word."""

    said = "a drop is not recorded"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        def drop(self: AdmissionQueue, stream: str, arrival: Any, reason: str = "overflow") -> None:
            return None

        return {(AdmissionQueue, "_drop"): drop}


class DeafToItself(Mutant):
    """A live operator forgets what it gave to itself while it was asked."""

    said = "an operator does not notice what it gives to itself"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        def decide(self: LiveRunner) -> bool:
            fired = OperatorRunner.step(self)
            self._told = fired and self.idle == NEVER
            if fired:
                self._wake_again()
            return fired

        return {(LiveRunner, "_decide"): decide}


class SleeplessClock(Mutant):
    """The clock of the supervisor goes on while it is stopped."""

    said = "a pause counts against processes"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        return {(AwakeClock, "__call__"): lambda self: self._clock()}


class HastySample(Mutant):
    """A firing samples what has arrived, whatever may still come at or before its stamp."""

    said = "a firing does not wait for what it samples"
    replays = True

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        return {(Sampled, "knows"): lambda self, stamp: True}


class GapTaken(Mutant):
    """The pipe between machines goes on behind what a reset link has lost."""

    said = "a pipe goes on behind what its link has lost"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = Pipe._on_frame

        def on_frame(self: Pipe, sample: Any) -> None:
            _, number, kind = _FRAME.unpack_from(sample.payload.to_bytes())
            if number > self._expected and kind == _END:
                self._expected = number
            right(self, sample)

        return {(Pipe, "_on_frame"): on_frame}


class NotIntroduced(Mutant):
    """A part of a recording lacks what stands in for operators that are not called in it."""

    said = "a part lacks operators that rest in it"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        return {(PartsSink, "_introduce_all"): lambda self: None}


class StateBefore(Mutant):
    """An operator records the state that it had at its last snapshot."""

    said = "a state is recorded that is over"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = Calls.snapshot
        last: dict[int, bytes | None] = {}

        def snapshot(self: Calls, place: tuple[int, int]) -> bytes | None:
            before, last[id(self)] = last.get(id(self)), right(self, place)
            return last[id(self)] if before is None else before

        return {(Calls, "snapshot"): snapshot}


class NotRestored(Mutant):
    """A reload does not record the state with which the new code goes on."""

    said = "a reload does not record the state that it keeps"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = FiringLog.add

        def add(self: FiringLog, kind: Any, *args: Any, **fields: Any) -> None:
            if kind != "restore":
                right(self, kind, *args, **fields)

        return {(FiringLog, "add"): add}


class ToldTwice(Mutant):
    """A trigger of a flight recorder asks again with each message while its condition holds."""

    said = "a trigger asks again while it holds"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        return {(Triggers, "_begins"): lambda self, trigger, name, holds: holds}


class DeafToDrops(Mutant):
    """A flight recorder is not triggered by what operators drop."""

    said = "a trigger by drops does nothing"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        return {(Triggers, "diagnostics"): lambda self, message: ()}


class ShortMemory(Mutant):
    """A flight recorder keeps half of what was before a trigger."""

    said = "a flight recorder keeps half of the time"

    def replaced(self) -> Mapping[tuple[Any, str], Callable[..., Any]]:
        right = FlightSink._keep

        def keep(self: FlightSink, wanted: Wanted, outcome: str = "") -> None:
            wanted.start += self.flight.keep // 2
            right(self, wanted, outcome)

        return {(FlightSink, "_keep"): keep}


MUTANTS: Mapping[str, Mutant] = {
    "credit": CreditLost(),
    "acknowledgement": EarlyAcknowledgement(),
    "record": LateRecord(),
    "frontier": HighFrontier(),
    "static_wait": SpinningWait(),
    "frozen": BlockingSupervisor(),
    "gap": SilentGap(),
    "drop": SilentDrop(),
    "itself": DeafToItself(),
    "pause": SleeplessClock(),
    "part": NotIntroduced(),
    "state": StateBefore(),
    "reload": NotRestored(),
    "again": ToldTwice(),
    "drops": DeafToDrops(),
    "half": ShortMemory(),
    "sample": HastySample(),
    "link": GapTaken(),
}
