"""Drives an operator by its recorded firings.

They say which messages each call was given, so nothing is decided again: drops, timeouts, lateness and restarts of a
live run are repeated exactly. A `Comparator` compares what comes out, digest by digest.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.environments import imported_packages, installed, require_environment
from dataflow.execution.calls import Calls
from dataflow.execution.comparator import Comparator
from dataflow.execution.effects.journal import RecordedJournal
from dataflow.execution.failure import RAISED, OperatorFailure
from dataflow.execution.generators.seeding import VERSION
from dataflow.execution.memory import WATCHED, MemoryGuard
from dataflow.execution.ports import Emitter
from dataflow.execution.protocol import Runner
from dataflow.execution.restarts import close_quietly
from dataflow.execution.runner import align_spec
from dataflow.graph.code import code_now, stored_operator
from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.operator import Operator, ParameterError
from dataflow.records.comparison import Verification
from dataflow.records.cuts import code_in, is_known, parameters_at, taken_by
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import Digests
from dataflow.records.repetition import Repetition
from dataflow.state import of_another_version
from dataflow.sync import FOREVER, NEVER, Entry, Firing, FiringInputs, MessageRef, RecordedAligner, Uses


class Watcher:
    """Is told what re-execution is about to do, and what it has done. Called for every step: it must be cheap."""

    def begins(self, phase: str, operator: str) -> None:
        """`phase`: setup, fire, read or close; `operator`: whose turn it is, empty for read."""

    def stepped(self, runner: RecordedRunner) -> None:
        """A runner has made a firing, or has ended."""


class RecordedRunner(Runner):
    """One operator, re-executed by its records, of which `repetition` has those that are repeated. `inputs` are the
    digests of what it was given; `seeding` is the version by which the recorded run seeded its generators.
    `make_effects`: see `RecordedJournal`. `guard` watches over what it is given in each firing; without one, only the
    first firings are watched."""

    def __init__(
        self,
        node: Node,
        emitter: Emitter,
        *,
        static: frozenset[str],
        repetition: Repetition,
        inputs: Digests,
        seed: int = 0,
        seeding: int = VERSION,
        guard: MemoryGuard | None = None,
        watcher: Watcher | None = None,
        make_effects: bool = False,
    ) -> None:
        operator, self._as_it_was = _with_code(node, repetition.code_of(0))
        super().__init__(node, operator, emitter)
        self._guard, self._watched = guard or MemoryGuard(), FOREVER if guard is not None else WATCHED
        self._watcher = watcher or Watcher()
        self.effects = RecordedJournal(make=make_effects)
        self.calls = Calls(node, self.operator, seed, version=seeding, effects=self.effects)
        self.comparator = Comparator(node.name, tuple(self.ports.states), inputs)
        self._repetition = repetition
        self.result.began = self._repetition.began
        self.result.unknown, self.result.lost_records = self._repetition.unknown, self._repetition.lost
        self._calls_left = self._repetition.calls
        self.result.firings = self._calls_left + self.result.lost_records + self.result.unknown
        self._align_spec = align_spec(node, self.spec, static)
        self.aligner = RecordedAligner(self._align_spec, self._repetition.uses)
        self._ahead = iter(self._repetition)
        self.record = self._repetition.setup
        """The record that is repeated now, or was last."""
        self.next_record = next(self._ahead, None)
        """The record that is repeated next; None behind the last one."""
        self._inputs: FiringInputs | None = None
        """Of the next call, once it is its turn."""
        self.changed: dict[str, Any] = {}
        self._latest: dict[str, tuple[int, int]] = {}
        self._open = set(node.taken)

    @property
    def result(self) -> Verification:
        """Returns what re-execution has come to so far."""
        return self.comparator.result

    def setup(self) -> None:
        """`setup()` of the operator; files that have changed since are noted. Raises `OperatorFailure`."""
        self._watcher.begins("setup", self.node.name)
        statics = self.calls.setup()
        if (record := self._repetition.setup) is not None:
            self.comparator.files(record, self.operator.files)
            then = record.detail.get("packages", {})
            self.comparator.packages(then, {name: installed(name) for name in then} or imported_packages())
            self._look_at_code(record)
            for name, message, seq in self.comparator.outputs(record, statics):
                self.ports.emit_as(name, message, seq, record.incarnation)
        self._take_up()
        self.ports.end_statics()

    def _take_up(self) -> None:
        """Returns where re-execution begins in the middle: the last restart, the parameters and the state of that
        moment."""
        before = self._repetition.before
        at_setup, changes = parameters_at(before)
        self.changed |= at_setup
        again = [r for r in before if r.kind == "setup" or ((t := taken_by(r)) is not None and t.again)]
        if again:
            statics = self._make_anew(again[-1].incarnation)
            if again[-1].kind == "setup":
                self.comparator.statics(again[-1], statics)
            self._look_at_code(again[-1])
        self._change(changes, again[-1].incarnation if again else 0)
        if before and is_known(last := before[-1]):
            self.calls.restore(last.detail["state"], (last.incarnation, last.stamp))

    def _change(self, values: Mapping[str, Any], incarnation: int) -> None:
        """Sets parameters to values that they had when the recording was made."""
        for name, value in dict(values).items():
            self.changed[name] = value
            try:
                self.calls.parameter(name, value, (incarnation, NEVER))
            except RAISED as error:
                when = f"taking the recorded value of parameter {name!r}"
                raise OperatorFailure(self.node.name, when, error) from error

    def close(self) -> None:
        """Closes the operator. An error is printed: no record holds the error of `close()` in the run."""
        self._watcher.begins("close", self.node.name)
        close_quietly(self.operator)

    def push(self, stream: str, entry: Entry) -> None:
        self._latest[stream] = (entry.incarnation, entry.seq)
        if self.next_record is not None and not self.ended and self.aligner.takes(stream, entry):
            self.comparator.arrived(stream, entry)
            self.aligner.push(stream, entry)
        if not self.awake:
            self.wake()

    def advance(self, stream: str, frontier: int) -> None:
        """Recorded firings wait for messages, not for promises."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self._open.discard(stream)
        self.wake()

    def step(self) -> bool:
        """Makes the next recorded firing once its messages are there; ends when it cannot come any more."""
        if self.ended:
            return False
        self._watcher.begins("fire", self.node.name)
        worked = self._make_next()
        if worked:
            self.wake()
            self._watcher.stepped(self)
        self._watcher.begins("read", "")
        return worked

    def _make_next(self) -> bool:
        self._repeat_changes()
        record = self.next_record
        if record is not None and self._inputs is None:
            self._inputs = record.firing()
        firing = None if self._inputs is None else self.aligner.take(self._inputs)
        if record is None or firing is None:
            if record is None or self._is_lost(self.aligner.missing()):
                self._end()
                return True
            self.done = max(self.done, record.stamp - 1)
            return False
        self.record = record
        with self.work:
            self._fire(firing, record)
        self._advance()
        self._calls_left -= 1
        self.done = max(self.done, record.stamp)
        return True

    def _advance(self) -> None:
        """Reads the next record."""
        self.next_record, self._inputs = next(self._ahead, None), None

    def _repeat_changes(self) -> None:
        """Returns what happened to the operator between the last firing and the next, in its recorded order."""
        while self.next_record is not None and self.next_record.kind not in CALLS:
            self.record = record = self.next_record
            self._advance()
            place = (record.incarnation, record.stamp)
            match record.kind:
                case "setup":
                    self._start_again(record)
                case "param" | "reset":
                    self._attempt(record)
                case "snapshot":
                    self.comparator.state(record, self.calls.snapshot(place))
                case "restore":
                    self._restore(record)
                case "cut":
                    self._take_up_at(record)

    def _start_again(self, record: FiringRecord) -> None:
        """A new incarnation: a fresh operator, with the parameters as they were last set."""
        self.comparator.statics(record, self._make_anew(record.incarnation))
        self._look_at_code(record)

    def _look_at_code(self, record: FiringRecord) -> None:
        """Notes code that is not as it was, unless what a reload has replaced runs."""
        if not self._as_it_was:
            then = code_in(record) or {}
            self.comparator.code(then, code_now(type(self.operator), then).digests)

    def _make_anew(self, incarnation: int) -> Mapping[str, Message]:
        """A fresh operator, with the parameters as they were last set; its static messages."""
        close_quietly(self.operator)
        self.operator, self._as_it_was = _with_code(self.node, self._repetition.code_of(incarnation))
        self.calls.operator = self.operator
        self._change(self.changed, incarnation)
        return self.calls.setup()

    def _take_up_at(self, record: FiringRecord) -> None:
        """Goes on after records that were left out: a fresh operator with its parameters and its state there."""
        taken = taken_by(record)
        if taken is None:
            return
        self.changed |= taken.at_setup
        if taken.again or self.result.verified:
            self._make_anew(record.incarnation)
            self._look_at_code(record)
        else:
            self._change(taken.at_setup, record.incarnation)
        self._change(taken.since, record.incarnation)
        if taken.state is not None:
            self._take_over(taken.state, record)
            self.result.began = "snapshot"

    def _attempt(self, record: FiringRecord) -> None:
        """Changes a parameter, or resets; compares what that raises."""
        place, detail = (record.incarnation, record.stamp), record.detail
        error: BaseException | None = None
        try:
            if record.kind == "param":
                self.changed[detail["name"]] = detail["value"]
                self.calls.parameter(detail["name"], detail["value"], place)
            else:
                self.calls.reset(detail["input"], place)
        except RAISED as raised:
            error = raised
        self.comparator.error(record, error)

    def _restore(self, record: FiringRecord) -> None:
        """A replay that began in the middle: with this state, or with one that is unavailable."""
        state = record.detail["state"]
        if state is None:
            self.result.lost_records += self._calls_left
            self._calls_left, self.next_record = 0, None
            self.aligner = RecordedAligner(self._align_spec, Uses())
            return
        self._take_over(state, record)

    def _take_over(self, state: bytes, record: FiringRecord) -> None:
        """Takes over a state from before which nothing can be repeated, of another version of the class, too."""
        with of_another_version():
            self.calls.restore(state, (record.incarnation, record.stamp))

    def _is_lost(self, missing: MessageRef | None) -> bool:
        """Returns whether a message that the next firing needs can no longer come."""
        if missing is None:
            return not self._open
        passed = self._latest.get(missing.stream, (-1, -1)) > (missing.incarnation, missing.seq)
        return passed or missing.stream not in self._open

    def waiting(self) -> tuple[int | None, dict[str, int]]:
        """The stamp of the next firing, and the stream and number of the message that it waits for."""
        missing = self.aligner.missing()
        stamp = None if self.next_record is None else self.next_record.stamp
        return stamp, {} if missing is None else {missing.stream: missing.seq}

    def needs_from(self) -> dict[str, tuple[int, int]]:
        """By stream, the first message (incarnation, number) that is needed to repeat what is to be repeated."""
        return self._repetition.needed

    def set_parameter(self, name: str, value: Any) -> Any:
        raise ParameterError("the parameters of a re-execution are the recorded ones")

    def _fire(self, firing: Firing, record: FiringRecord) -> None:
        self.comparator.given(record, firing)
        if record.detail.get("injected"):  # a fault that was tried out: the operator was not called
            self.result.verified += 1
            return
        watched = self.result.verified < self._watched
        if watched:
            self._guard.take(self.node.name, firing)
        self.effects.begin(record.detail)
        try:
            messages = self.calls.process(firing)
            if record.outcome == "error":
                self.ports.check(messages, firing.stamp)
        except RAISED as error:
            self.comparator.error(record, error)
            messages = {}
        else:
            self.comparator.error(record, None)
        if watched and (what := self._guard.changed(self.node.name)):
            self.result.wrote = self.result.wrote or what
        for name, message, seq in self.comparator.outputs(record, messages):
            self.ports.emit_as(name, message, seq, record.incarnation)
        if "summary" in record.detail:
            self.comparator.summary(record, self.calls.summary((record.incarnation, record.stamp)))
        if self.effects.counts:
            self.result.effects = self.effects.summary()
        self.firings += record.kind != "finish"
        self.result.verified += 1

    def _end(self) -> None:
        self.ended, self.done = True, FOREVER
        self.result.unverifiable = self._calls_left
        if self.result.unverifiable and (lost := self.aligner.missing()) is not None:
            self.result.missing = f"{lost.stream} #{lost.seq}"
            if (lost.incarnation, lost.seq) > self._latest.get(lost.stream, (-1, -1)):
                self.result.beyond = self.result.unverifiable
        self.ports.end(None, "end of records")


def _with_code(node: Node, digests: Mapping[str, str] | None) -> tuple[Operator, bool]:
    """A new operator, of the code with these digests where a reload has stored it, and whether it is of that. Raises
    `EnvError` in a process of another environment."""
    require_environment(node.name, node.env)
    found = None if digests is None else stored_operator(node, digests)
    return (node.operator if found is None else found)(**node.params), found is not None
