"""Runs one source: `stream()` is read step by step, numbered and recorded; in a live run its clock may jump."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from dataflow.execution.calls import Calls, require_complete
from dataflow.execution.clock_correction import ClockCorrection
from dataflow.execution.failure import OperatorFailure, readable
from dataflow.execution.generators.loading import LOADS
from dataflow.execution.generators.seeding import change_seed, seed_generators
from dataflow.execution.generators.shared_generators import CALLS_IN_PROGRESS, SharedGenerators, Tripwire
from dataflow.execution.log import FiringLog
from dataflow.execution.ports import Emitter, OutputPorts
from dataflow.execution.work import Work
from dataflow.graph.code import ReloadError, code_now
from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.operator import OutputError, Source, outputs_of
from dataflow.sync import NEVER

_NOTHING: Mapping[str, int] = {}
JUMP_AFTER = 3
"""So many steps in a row with stamps in the past are a clock that has jumped back; fewer are stray messages."""


class SourceRunner:
    """One source: `stream()` is read one step at a time, with one step of look-ahead."""

    def __init__(
        self, node: Node, emitter: Emitter, *, seed: int = 0, operator: Source | None = None, live: bool = False
    ) -> None:
        self.node, self.seed = node, seed
        self.operator = node.make() if operator is None else operator
        assert isinstance(self.operator, Source)
        self.source: Source = self.operator
        self._code = code_now(type(self.operator))
        self.ports = OutputPorts(node, self.operator.spec, emitter, lossy=live)
        self._live, self._pulled, self._tripwire = live, 0, Tripwire()
        self.refused: Counter[str] = Counter()
        """Steps of a live run that were not sent, by reason: `overflow`, `past`, `repeated`."""
        self._recorded: Counter[str] = Counter()
        self._backwards: list[int] = []
        self._resumed = False
        self._changed: dict[str, Any] = {}
        self.records = FiringLog(node.name, emitter)
        self.firings = 0
        self.ended = False
        self.work = Work()
        """The time of reading `stream()`."""
        self.first: int | None = None
        self.last = NEVER
        self.clock = ClockCorrection()
        self._read = NEVER  # the stamp that was read last, on whichever thread
        self._steps: Iterator[Mapping[str, Message]] = iter(())
        self._next: dict[str, Message] | None = None

    def setup(self) -> None:
        started = time.time_ns()
        statics = Calls(self.node, self.operator, self.seed).setup()
        self.records.add_setup(self.operator, started, self.ports.prepare(statics, NEVER))
        self.ports.publish()
        self.ports.end_statics()
        self._begin_stream()

    def _begin_stream(self) -> None:
        try:
            self._steps = iter(self.source.stream())
        except BaseException as error:
            raise OperatorFailure(self.node.name, "stream()", error) from error

    def look_ahead(self) -> int | None:
        """The stamp of the next step, or None at the end. Raises `OperatorFailure`."""
        if self._next is None and not self.ended:
            with self.work, CALLS_IN_PROGRESS.call(self.node.name, self._read):
                self._next = self.pull()
        return None if self._next is None else step_stamp(self._next)

    def take(self) -> dict[str, Message] | None:
        """The next step without emitting it, None at the end: for the thread that reads a source in a live run.
        `check_draws` is to follow, as soon as the step is on its way."""
        step, self._next = self._next, None
        if step is not None:
            return step
        self._tripwire.set()
        work = self.work
        work.begin()
        try:
            return self.pull()
        finally:
            work.end()

    def check_draws(self) -> None:
        """Raises `OperatorFailure` if the step that was taken has drawn from generators that operators depend on."""
        try:
            self._tripwire.check(self.node.name)
        except SharedGenerators as error:
            raise OperatorFailure(self.node.name, _when(self.last), error) from error

    def pull(self) -> dict[str, Message] | None:
        """Reads the source's next non-empty step; for live sources called on the reader's own thread.

        Where it runs on the thread of the operators, which leave the global generators as they please, these are seeded
        first: what a step draws does not depend on what else is in the process.
        """
        self._pulled += 1
        if not self._live:
            seed_generators(change_seed(self.seed, self.node.name, "step", self.records.incarnation, self._pulled))
        try:
            for step in self._steps:
                messages = outputs_of(self.operator.spec, step)
                if messages:
                    require_complete(self.operator.spec, messages, "stream()")
                    if shift := self.clock.shift(step_stamp(messages)):
                        messages = {port: m.replace(stamp=m.stamp + shift) for port, m in messages.items()}
                    self._read = step_stamp(messages)
                    if len(messages) > 1:
                        self._check_stamps(messages)
                    return messages
        except BaseException as error:
            raise OperatorFailure(self.node.name, _when(self._read), error) from error
        finally:
            if not self._live:
                LOADS.seed = None
        return None

    def _check_stamps(self, messages: Mapping[str, Message]) -> None:
        stamps = {m.stamp for m in messages.values()}
        if len(stamps) != 1:
            raise OutputError(
                f"{self.node.name} yielded stamps {sorted(stamps)} together; one step of stream() has one stamp"
            )

    def admit(self) -> tuple[int, int]:
        """Emits the step that was looked at; returns how many messages and bytes it was."""
        assert self._next is not None
        step, self._next = self._next, None
        return self.emit(step)

    def promise(self) -> None:
        """Every port is known up to the last step, so sparse ports delay no consumer."""
        self.ports.promise(self.last)

    def emit(self, step: Mapping[str, Message]) -> tuple[int, int]:
        return self._emit(step, step_stamp(step))

    def _emit(self, step: Mapping[str, Message], stamp: int) -> tuple[int, int]:
        started = time.time_ns()
        if stamp <= self.last:
            error = OutputError(f"{self.node.name} yielded stamp {stamp} after {self.last}: stamps strictly increase")
            raise OperatorFailure(self.node.name, "stream()", error)
        self.last = stamp
        self.first = stamp if self.first is None else self.first
        try:
            emissions = self.ports.prepare(step, stamp)
        except OutputError as error:
            raise OperatorFailure(self.node.name, "stream()", error) from error
        self.firings += 1
        refused = self._take_refused() if self.refused else _NOTHING
        self.records.add_step(stamp, started, emissions, refused)
        self.ports.publish()
        return step_size(step)

    def _take_refused(self) -> dict[str, int]:
        """Returns how many steps were not sent since the last record that counts them, by reason."""
        fresh, self._recorded = self.refused - self._recorded, self.refused.copy()
        return dict(fresh)

    def emit_live(self, step: Mapping[str, Message]) -> tuple[int, int] | None:
        """As `emit`, for a source whose stamps may go back: returns None for a step that is not sent.

        One step with a stamp in the past is dropped as `past`. Where the next ones lie there too, and go on from it,
        the clock has jumped back: the streams begin a new incarnation. A source that was started again and gives what
        it gave before is not listened to until it is past that (`repeated`).
        """
        stamp = step_stamp(step)
        if stamp > self.last:
            self._backwards.clear()
            self._resumed = False
            return self._emit(step, stamp)
        if self._resumed:
            self.refused["repeated"] += 1
            return None
        if self._backwards and stamp <= self._backwards[-1]:
            self._backwards.clear()
        self._backwards.append(stamp)
        if len(self._backwards) < JUMP_AFTER:
            self.refused["past"] += 1
            return None
        self._backwards.clear()
        self._begin_after_jump(stamp)
        return self._emit(step, stamp)

    def _begin_after_jump(self, stamp: int) -> None:
        incarnation = self.records.incarnation + 1
        self.records = FiringLog(self.node.name, self.ports.emitter, incarnation)
        self.ports.begin(incarnation, stamps_go_back=True)
        self.records.add("reset", stamp, time.time_ns(), detail={"last": self.last})
        self.last = NEVER

    def resume(self, incarnation: int, last: Mapping[str, int], changed: Mapping[str, Any]) -> None:
        """Takes the place of a source whose process died; to be called before `setup()`."""
        self.records = FiringLog(self.node.name, self.ports.emitter, incarnation)
        self.ports.resume(incarnation, last)
        self.last = max(last.values(), default=NEVER)
        self._resumed = not self.source.real_time
        self._change(changed)

    def start_again(self) -> None:
        """Puts a fresh source in the place of one that failed, with the parameters as they were last set; its streams
        begin a new incarnation. Raises `OperatorFailure` when that fails too."""
        old = self.operator
        self._steps, self._next = iter(()), None
        self._backwards.clear()
        incarnation = self.records.incarnation + 1
        self.records = FiringLog(self.node.name, self.ports.emitter, incarnation)
        self.ports.begin(incarnation)
        self._resumed = not self.source.real_time
        try:
            old.close()
        except Exception as error:  # the first failure is known
            print(f"{self.node.name}: close() after a failure: {readable(error)}", file=sys.stderr)
        try:
            self.operator = self._code.operator(**self.node.params)
            assert isinstance(self.operator, Source)
            self.source = self.operator
            self._change(self._changed)
        except Exception as error:
            raise OperatorFailure(self.node.name, "construction", error) from error
        started = time.time_ns()
        Calls(self.node, self.operator, self.seed).setup()  # its static streams go on as they are
        self.records.add_setup(self.operator, started, (None,) * len(self.ports.states), self._code)
        self._begin_stream()

    def _change(self, changed: Mapping[str, Any]) -> None:
        self._changed = dict(changed)
        for name, value in changed.items():
            self.operator.set_parameter(name, value)

    def set_parameter(self, name: str, value: Any) -> Any:
        """Changes a parameter; recorded. Returns the value as validated. Raises `ParameterError`. No generator is
        seeded: `stream()` goes on with what it has drawn, and no source is re-executed."""
        started = time.time_ns()
        self.operator.set_parameter(name, value)
        self._changed[name] = value
        plain = self.operator.params.model_dump(mode="json")[name]
        self.records.add("param", max(self.last, NEVER + 1), started, detail={"name": name, "value": plain})
        return plain

    def reload(self) -> dict[str, Any]:
        """Raises `ReloadError`."""
        raise ReloadError(f"{self.node.name!r} is a source, which holds its device: end the run and start it again")

    def finish(self, reason: str = "end of source") -> None:
        """Ends the streams; the source is done."""
        if not self.ended:
            self.ended = True
            self._next = None
            none = (None,) * len(self.ports.states)
            self.records.add("finish", self.last, time.time_ns(), outputs=none, detail=self._take_refused())
            self.ports.end(None if self.last == NEVER else self.last, reason)

    def close(self) -> None:
        """Closes the source, and before that a stream that was not read to its end; one that is read by a thread of
        its own is that thread's to end. Raises what that raises."""
        if not self._live:
            self.close_stream()
        self.operator.close()

    def close_stream(self) -> None:
        """Ends `stream()` where it stands, so that its `finally` runs; on the thread that reads it."""
        close = getattr(self._steps, "close", None)
        if close is not None:
            try:
                close()
            except BaseException as error:
                raise OperatorFailure(self.node.name, "the end of stream()", error) from error


def step_stamp(step: Mapping[str, Message]) -> int:
    for message in step.values():
        return message.stamp
    raise AssertionError("a step has a message")


def step_size(step: Mapping[str, Message]) -> tuple[int, int]:
    """Returns how many messages and bytes a step is."""
    size = 0
    for message in step.values():
        for array in message.arrays():
            if array is not None:
                size += array.nbytes
    return len(step), size


def _when(last: int) -> str:
    """Returns in words where a source failed; `last`: the stamp that it gave before."""
    return "stream() before its first message" if last == NEVER else f"stream() after stamp {last}"
