"""Drives an operator by its recorded firings and compares what it makes, digest by digest.

The recorded firings say which messages each call was given, so nothing is decided again: drops, timeouts, lateness and
restarts of a live run are repeated exactly. A difference is the operator's own when everything it had been given
until then was as recorded (*culprit*); otherwise it follows from another's (*downstream*).
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import PurePath
from typing import Any

from dataflow.firing.align import align_spec
from dataflow.firing.runner import (
    Emitter,
    OperatorFailure,
    OutputPorts,
    call_operator,
    changed_input,
    entries_of,
    readable,
    summary_of,
)
from dataflow.firing.seeding import firing_seed, seed_generators
from dataflow.firing.snapshots import pack_state, unpack_state
from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.operator import Operator, OperatorSpec, outputs_of
from dataflow.records.comparison import Difference, Verification
from dataflow.records.firing import CALLS, WITHHELD, Emission, FiringRecord
from dataflow.records.reading import Digests, beginning, needed_from, whole
from dataflow.sync import FOREVER, NEVER, Entry, Firing, MessageRef, RecordedAligner

RAISED = (Exception, SystemExit, KeyboardInterrupt)
"""What an operator may raise; a live run records all of it as the operator's error."""

_ADDRESS = re.compile(r"0x[0-9a-fA-F]+")


class RecordedRunner:
    """One operator, re-executed. The same shape as `OperatorRunner`, so a host drives either."""

    def __init__(
        self,
        node: Node,
        emitter: Emitter,
        *,
        static: frozenset[str],
        records: Iterable[FiringRecord],
        inputs: Digests,
        seed: int = 0,
        paranoid: bool = False,
        begin: int | None = None,
    ) -> None:
        self.node, self.seed, self.paranoid = node, seed, paranoid
        self.operator: Operator = node.make()
        self.spec: OperatorSpec = self.operator.spec
        self.ports = OutputPorts(node, self.spec, emitter)
        self.emitter = emitter
        self.result = Verification(node.name)
        self._inputs = inputs
        kept, lost = whole(records)
        self._setup_record = kept.pop(0) if kept and kept[0].kind == "setup" else None
        self._before, self._records, self.result.began = beginning(kept, begin, stateless=self.operator.stateless)
        calls = [r for r in self._records if r.kind in CALLS]
        self.result.firings = len(calls) + lost
        self.result.lost_records = lost
        self.aligner_spec = align_spec(node, self.spec, static)
        self.aligner = RecordedAligner(self.aligner_spec, (r.firing() for r in calls))
        self._position = 0
        self._changed: dict[str, Any] = {}
        self._latest: dict[str, tuple[int, int]] = {}
        self._open = {s for streams in node.inputs.values() for s in streams}
        self.firings = 0
        self.done = NEVER
        self.ended = False
        self.busy_ns = 0

    def setup(self) -> None:
        """`setup()` of the operator; files that have changed since are noted. Raises `OperatorFailure`."""
        statics = self._set_up()
        first = self._setup_record
        if first is not None:
            self.result.files_changed = _changed_files(first.detail.get("files", {}), self.operator.files)
            self._compare(first, statics)
        self._take_up()
        for state in self.ports.states.values():
            if state.port.static:
                state.promised = FOREVER
                self.emitter.end(state.stream, None, "static")

    def _change(self, values: Mapping[str, Any]) -> None:
        """Sets parameters to values that they had when the recording was made."""
        for name, value in values.items():
            self._changed[name] = value
            try:
                self.operator.set_parameter(name, value)
            except Exception as error:
                raise OperatorFailure(
                    self.node.name, f"taking the recorded value of parameter {name!r}", error
                ) from error

    def _take_up(self) -> None:
        """Where re-execution begins in the middle: the last restart, the parameters and the state of that moment."""
        changes: dict[str, Any] = {}
        for record in self._before:
            if record.kind == "param":
                changes[record.detail["name"]] = record.detail["value"]
            elif record.kind == "setup":
                self._changed |= changes
                changes = {}
        again = [record for record in self._before if record.kind == "setup"]
        if again:
            self._start_again(again[-1])
        self._change(changes)
        if self._before and self._before[-1].kind == "snapshot":
            self._restore_from(self._before[-1].detail["state"])

    def _restore_from(self, state: bytes) -> None:
        try:
            self.operator.restore(unpack_state(state))
        except Exception as error:
            raise OperatorFailure(self.node.name, "restore()", error) from error

    def _set_up(self) -> dict[str, Message]:
        try:
            self.operator.rng = seed_generators(firing_seed(self.seed, self.node.name, NEVER))
            self.operator.setup()
            return dict(self.operator.static_outputs())
        except RAISED as error:
            raise OperatorFailure(self.node.name, "setup()", error) from error

    def push(self, stream: str, entry: Entry) -> None:
        self._latest[stream] = (entry.incarnation, entry.seq)
        if self._position < len(self._records) and not self.ended:
            self.aligner.push(stream, entry)

    def advance(self, stream: str, frontier: int) -> None:
        """Recorded firings wait for messages, not for promises."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self._open.discard(stream)

    def step(self) -> bool:
        """Makes the next recorded firing once its messages are there; ends when it cannot come any more."""
        if self.ended:
            return False
        self._repeat_changes()
        firing = self.aligner.poll()
        if firing is None:
            if self._position >= len(self._records) or self._is_lost(self.aligner.missing()):
                self._end()
                return True
            self.done = max(self.done, self._records[self._position].stamp - 1)
            return False
        record = self._records[self._position]
        self._fire(firing, record)
        self._position += 1
        return True

    def _repeat_changes(self) -> None:
        """What happened to the operator between the last firing and the next, in its recorded order."""
        while self._position < len(self._records) and self._records[self._position].kind not in CALLS:
            record = self._records[self._position]
            self._position += 1
            self.operator.rng = seed_generators(firing_seed(self.seed, self.node.name, NEVER))
            match record.kind:
                case "setup":
                    self._start_again(record)
                case "param":
                    self._changed[record.detail["name"]] = record.detail["value"]
                    self._attempt(record, lambda d: self.operator.set_parameter(d["name"], d["value"]))
                case "reset":
                    self._attempt(record, lambda d: self.operator.on_reset(d["input"]))
                case "snapshot":
                    self._compare_state(record)
                case "restore":
                    self._restore(record)

    def _start_again(self, record: FiringRecord) -> None:
        """A new incarnation: a fresh operator, with the parameters as they were last set."""
        self.operator.close()
        self.operator = self.node.make()
        self._change(self._changed)
        statics = self._set_up()
        for (name, _), expected in zip(self.ports.states.items(), record.outputs, strict=True):
            if expected is not None and (name not in statics or statics[name].digest() != expected.digest):
                self._differ(record, name, expected.digest.hex(), "another static message")

    def _attempt(self, record: FiringRecord, change: Callable[[Mapping[str, Any]], object]) -> None:
        try:
            change(record.detail)
        except RAISED as error:
            self._compare_error(record, error)
        else:
            self._compare_error(record, None)

    def _compare_error(self, record: FiringRecord, error: BaseException | None) -> None:
        """Compares what a call raised, if anything; addresses in memory, which texts may hold, are left out."""
        expected = f"error: {record.detail.get('error', '')}" if record.outcome == "error" else "no error"
        got = "no error" if error is None else f"error: {readable(error)}"
        if _ADDRESS.sub("", expected) != _ADDRESS.sub("", got):
            self._differ(record, "", expected, got)

    def _restore(self, record: FiringRecord) -> None:
        """A replay that began in the middle: with this state, or with one that cannot be had again."""
        state = record.detail["state"]
        if state is None:
            rest = self._records[self._position :]
            self.result.lost_records += sum(r.kind in CALLS for r in rest)
            del self._records[self._position :]
            self.aligner = RecordedAligner(self.aligner_spec, ())
            return
        self._restore_from(state)

    def _compare_state(self, record: FiringRecord) -> None:
        state = self.operator.snapshot()
        packed = b"" if state is None else pack_state(state)
        if packed != record.detail["state"]:
            self.result.states += 1
            self._differ(record, "", "the recorded state", "another state")

    def _is_lost(self, missing: MessageRef | None) -> bool:
        """Whether a message that the next firing needs can no longer come."""
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

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        """Nothing is dropped again."""
        return {}

    def _fire(self, firing: Firing, record: FiringRecord) -> None:
        started = time.time_ns()
        if self.result.tainted is None and not self._as_recorded(firing):
            self.result.tainted = record.index
        if record.detail.get("injected"):  # a fault that was tried out: the operator was not called
            self.result.verified += 1
            return
        self.operator.rng = seed_generators(firing_seed(self.seed, self.node.name, firing.stamp))
        try:
            messages = outputs_of(self.operator, call_operator(self.operator, firing))
            if record.outcome == "error":
                self.ports.check(messages, firing.stamp)
        except RAISED as error:
            self._compare_error(record, error)
            messages = {}
        else:
            self._compare_error(record, None)
            if self.paranoid and (problem := changed_input(self.node, firing)) is not None:
                raise OperatorFailure(self.node.name, f"{record.kind} at stamp {record.stamp}", problem)
        self._compare(record, messages)
        if "summary" in record.detail:
            self._compare_summary(record)
        self.firings += record.kind != "finish"
        self.result.verified += 1
        self.busy_ns += time.time_ns() - started

    def _as_recorded(self, firing: Firing) -> bool:
        return all(
            self._inputs.get(entry.stream, {}).get((entry.incarnation, entry.seq), entry.digest) == entry.digest
            for given in firing.inputs.values()
            for entry in entries_of(given)
        )

    def _compare(self, record: FiringRecord, messages: Mapping[str, Message]) -> None:
        """Compares with the record, and emits under the recorded numbers what the record says was emitted."""
        recorded = record.outputs or (None,) * len(self.ports.states)
        for (name, state), expected in zip(self.ports.states.items(), recorded, strict=True):
            got = messages.get(name)
            if expected is None and got is None:
                continue
            self.result.outputs += 1
            if expected is None or got is None:
                self._differ(record, name, *(_word(expected), _word(got)))
            elif got.digest() != expected.digest:
                self._differ(record, name, expected.digest.hex(), got.digest().hex())
            if expected is not None and got is not None and expected.seq != WITHHELD:
                assert state.digest is not None
                state.digest.update(got.digest())
                self.ports.emitted += 1
                entry = Entry(got.stamp, got, expected.seq, record.incarnation, got.digest(), state.stream)
                state.last = state.promised = max(state.promised, got.stamp)
                self.emitter.message(state.stream, entry)

    def _compare_summary(self, record: FiringRecord) -> None:
        """What the operator sums up at its end: all that a sink makes."""
        expected, got = record.detail["summary"], summary_of(self.operator, self.node.name)
        name = next((n for n in (*expected, *got) if repr(expected.get(n)) != repr(got.get(n))), None)
        if name is not None:
            self._differ(record, "", *(f"summary {name}: {values.get(name, 'nothing')}" for values in (expected, got)))

    def _differ(self, record: FiringRecord, port: str, expected: str, got: str) -> None:
        self.result.differing += 1
        if self.result.first is None:
            self.result.own_fault = self.result.tainted is None
            self.result.first = Difference(
                record.index, record.kind, record.stamp, port, expected, got, record.incarnation
            )

    def _end(self) -> None:
        self.ended, self.done = True, FOREVER
        self.result.unverifiable = sum(r.kind in CALLS for r in self._records[self._position :])
        if self.result.unverifiable and (lost := self.aligner.missing()) is not None:
            self.result.missing = f"{lost.stream} #{lost.seq}"
            if (lost.incarnation, lost.seq) > self._latest.get(lost.stream, (-1, -1)):
                self.result.beyond = self.result.unverifiable
        self.ports.end(None, "end of records")


def _changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Files whose content is that of no file of the same name that was read then, wherever that lay."""
    known = {(PurePath(file).name, digest) for file, digest in before.items()}
    return sorted(file for file, digest in now.items() if (PurePath(file).name, digest) not in known)


def _word(emission: Emission | Message | None) -> str:
    return "nothing" if emission is None else f"a message at stamp {emission.stamp}"
