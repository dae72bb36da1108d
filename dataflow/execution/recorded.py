"""Drives an operator by its recorded firings.

They say which messages each call was given, so nothing is decided again: drops, timeouts, lateness and restarts of a
live run are repeated exactly. A `Judge` compares what comes out, digest by digest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dataflow.execution.align import align_spec
from dataflow.execution.calls import Calls
from dataflow.execution.failure import RAISED, OperatorFailure
from dataflow.execution.generators.seeding import VERSION
from dataflow.execution.judge import Judge
from dataflow.execution.memory import WATCHED, MemoryGuard
from dataflow.execution.ports import Emitter
from dataflow.execution.protocol import Runner
from dataflow.execution.restarts import close_quietly
from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.operator import ParameterError
from dataflow.records.comparison import Verification
from dataflow.records.cuts import is_known, taken_by, without_unknown
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import Digests, beginning, needed_from, whole
from dataflow.sync import FOREVER, NEVER, Entry, Firing, MessageRef, RecordedAligner


class Watcher:
    """Is told what re-execution is about to do, and what it has done. Called for every step: it must be cheap."""

    def begins(self, phase: str, operator: str) -> None:
        """`phase`: setup, fire, read or close; `operator`: whose turn it is, empty for read."""

    def stepped(self, runner: RecordedRunner) -> None:
        """A runner has made a firing, or has ended."""


class RecordedRunner(Runner):
    """One operator, re-executed by its `records`. `inputs` are the digests of what it was given; `seeding` is the
    version by which the recorded run seeded its generators; `begin` the stamp from which it is to be repeated. `guard`
    watches over what it is given in each firing; without one, only the first firings are watched."""

    def __init__(
        self,
        node: Node,
        emitter: Emitter,
        *,
        static: frozenset[str],
        records: Iterable[FiringRecord],
        inputs: Digests,
        seed: int = 0,
        seeding: int = VERSION,
        guard: MemoryGuard | None = None,
        begin: int | None = None,
        watcher: Watcher | None = None,
    ) -> None:
        super().__init__(node, node.make(), emitter)
        self._guard, self._watched = guard or MemoryGuard(), FOREVER if guard is not None else WATCHED
        self._watcher = watcher or Watcher()
        self.calls = Calls(node, self.operator, seed, version=seeding)
        self.judge = Judge(node.name, tuple(self.ports.states), inputs)
        kept, lost = whole(records)
        self._setup_record = kept.pop(0) if kept and kept[0].kind == "setup" else None
        self._before, self._records, self.result.began = beginning(kept, begin, stateless=self.operator.stateless)
        if not self.operator.stateless:
            self._records, self.result.unknown = without_unknown(self._records)
        calls = [r for r in self._records if r.kind in CALLS]
        self.result.firings = len(calls) + lost + self.result.unknown
        self.result.lost_records = lost
        self._align_spec = align_spec(node, self.spec, static)
        self.aligner = RecordedAligner(self._align_spec, (r.firing() for r in calls))
        self._position = 0
        self._changed: dict[str, Any] = {}
        self._latest: dict[str, tuple[int, int]] = {}
        self._open = set(node.taken)

    @property
    def result(self) -> Verification:
        """Returns what re-execution has come to so far."""
        return self.judge.result

    def setup(self) -> None:
        """`setup()` of the operator; files that have changed since are noted. Raises `OperatorFailure`."""
        self._watcher.begins("setup", self.node.name)
        statics = self.calls.setup()
        if self._setup_record is not None:
            self.judge.files(self._setup_record, self.operator.files)
            for name, message, seq in self.judge.outputs(self._setup_record, statics):
                self.ports.emit_as(name, message, seq, self._setup_record.incarnation)
        self._take_up()
        self.ports.end_statics()

    def _take_up(self) -> None:
        """Returns where re-execution begins in the middle: the last restart, the parameters and the state of that
        moment."""
        changes: dict[str, Any] = {}
        for record in self._before:
            if record.kind == "param":
                changes[record.detail["name"]] = record.detail["value"]
            elif record.kind == "setup":
                self._changed |= changes
                changes = {}
            elif (taken := taken_by(record)) is not None:
                self._changed |= taken.at_setup
                changes = dict(taken.since)
        again = [r for r in self._before if r.kind == "setup" or ((t := taken_by(r)) is not None and t.again)]
        if again:
            statics = self._make_anew(again[-1].incarnation)
            if again[-1].kind == "setup":
                self.judge.statics(again[-1], statics)
        self._change(changes, again[-1].incarnation if again else 0)
        if self._before and is_known(last := self._before[-1]):
            self.calls.restore(last.detail["state"], (last.incarnation, last.stamp))

    def _change(self, values: Mapping[str, Any], incarnation: int) -> None:
        """Sets parameters to values that they had when the recording was made."""
        for name, value in dict(values).items():
            self._changed[name] = value
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
        if self._position < len(self._records) and not self.ended:
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
        firing = self.aligner.poll()
        if firing is None:
            if self._position >= len(self._records) or self._is_lost(self.aligner.missing()):
                self._end()
                return True
            self.done = max(self.done, self._records[self._position].stamp - 1)
            return False
        record = self._records[self._position]
        with self.work:
            self._fire(firing, record)
        self._position += 1
        self.done = max(self.done, record.stamp)
        return True

    def _repeat_changes(self) -> None:
        """Returns what happened to the operator between the last firing and the next, in its recorded order."""
        while self._position < len(self._records) and self._records[self._position].kind not in CALLS:
            record = self._records[self._position]
            self._position += 1
            place = (record.incarnation, record.stamp)
            match record.kind:
                case "setup":
                    self._start_again(record)
                case "param" | "reset":
                    self._attempt(record)
                case "snapshot":
                    self.judge.state(record, self.calls.snapshot(place))
                case "restore":
                    self._restore(record)
                case "cut":
                    self._take_up_at(record)

    def _start_again(self, record: FiringRecord) -> None:
        """A new incarnation: a fresh operator, with the parameters as they were last set."""
        self.judge.statics(record, self._make_anew(record.incarnation))

    def _make_anew(self, incarnation: int) -> Mapping[str, Message]:
        """A fresh operator, with the parameters as they were last set; its static messages."""
        close_quietly(self.operator)
        self.operator = self.calls.operator = self.node.make()
        self._change(self._changed, incarnation)
        return self.calls.setup()

    def _take_up_at(self, record: FiringRecord) -> None:
        """Goes on after records that were left out: a fresh operator with its parameters and its state there."""
        taken = taken_by(record)
        if taken is None:
            return
        self._changed |= taken.at_setup
        if taken.again or self.result.verified:
            self._make_anew(record.incarnation)
        else:
            self._change(taken.at_setup, record.incarnation)
        self._change(taken.since, record.incarnation)
        if taken.state is not None:
            self.calls.restore(taken.state, (record.incarnation, record.stamp))
            self.result.began = "snapshot"

    def _attempt(self, record: FiringRecord) -> None:
        """Changes a parameter, or resets; compares what that raises."""
        place, detail = (record.incarnation, record.stamp), record.detail
        try:
            if record.kind == "param":
                self._changed[detail["name"]] = detail["value"]
                self.calls.parameter(detail["name"], detail["value"], place)
            else:
                self.calls.reset(detail["input"], place)
        except RAISED as error:
            self.judge.error(record, error)
        else:
            self.judge.error(record, None)

    def _restore(self, record: FiringRecord) -> None:
        """A replay that began in the middle: with this state, or with one that is unavailable."""
        state = record.detail["state"]
        if state is None:
            rest = self._records[self._position :]
            self.result.lost_records += sum(r.kind in CALLS for r in rest)
            del self._records[self._position :]
            self.aligner = RecordedAligner(self._align_spec, ())
            return
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
        stamp = self._records[self._position].stamp if self._position < len(self._records) else None
        return stamp, {} if missing is None else {missing.stream: missing.seq}

    def needs_from(self) -> dict[str, tuple[int, int]]:
        """By stream, the first message (incarnation, number) that is needed to repeat what is to be repeated."""
        return needed_from(self._records)

    def set_parameter(self, name: str, value: Any) -> Any:
        raise ParameterError("the parameters of a re-execution are the recorded ones")

    def _fire(self, firing: Firing, record: FiringRecord) -> None:
        self.judge.given(record, firing)
        if record.detail.get("injected"):  # a fault that was tried out: the operator was not called
            self.result.verified += 1
            return
        watched = self.result.verified < self._watched
        if watched:
            self._guard.take(self.node.name, firing)
        try:
            messages = self.calls.process(firing)
            if record.outcome == "error":
                self.ports.check(messages, firing.stamp)
        except RAISED as error:
            self.judge.error(record, error)
            messages = {}
        else:
            self.judge.error(record, None)
        if watched and (what := self._guard.changed(self.node.name)):
            self.result.wrote = self.result.wrote or what
        for name, message, seq in self.judge.outputs(record, messages):
            self.ports.emit_as(name, message, seq, record.incarnation)
        if "summary" in record.detail:
            self.judge.summary(record, self.calls.summary((record.incarnation, record.stamp)))
        self.firings += record.kind != "finish"
        self.result.verified += 1

    def _end(self) -> None:
        self.ended, self.done = True, FOREVER
        self.result.unverifiable = sum(r.kind in CALLS for r in self._records[self._position :])
        if self.result.unverifiable and (lost := self.aligner.missing()) is not None:
            self.result.missing = f"{lost.stream} #{lost.seq}"
            if (lost.incarnation, lost.seq) > self._latest.get(lost.stream, (-1, -1)):
                self.result.beyond = self.result.unverifiable
        self.ports.end(None, "end of records")
