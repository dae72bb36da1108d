"""Drives an operator by its recorded firings and compares what it makes, digest by digest.

The recorded firings say which messages each call was given, so nothing is decided again: drops, timeouts, lateness and
restarts of a live run are repeated exactly. A difference is the operator's own when everything it had been given
until then was as recorded (*culprit*); otherwise it follows from another's (*downstream*).
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import PurePath
from typing import Any, Literal

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
from dataflow.recording import Recording
from dataflow.records.firing import WITHHELD, Emission, FiringRecord, decode_batch
from dataflow.sync import FOREVER, NEVER, Entry, Firing, InputRef, MessageRef, RecordedAligner

CALLS = ("fire", "tick", "finish")
"""The kinds of records that stand for a call with messages."""

RAISED = (Exception, SystemExit, KeyboardInterrupt)
"""What an operator may raise; a live run records all of it as the operator's error."""

_ADDRESS = re.compile(r"0x[0-9a-fA-F]+")

Verdict = Literal["identical", "culprit", "downstream", "unverifiable"]
Digests = Mapping[str, Mapping[tuple[int, int], bytes]]
"""Stream → (incarnation, seq) → the recorded digest."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The first firing of an operator that came out otherwise. `expected` and `got` are digests, or say what else."""

    index: int
    kind: str
    stamp: int
    port: str
    expected: str
    got: str
    incarnation: int = 0


@dataclass(slots=True)
class Verification:
    """What re-executing one operator came to.

    `verified` firings were repeated and compared; `unverifiable` ones could not be, because a message they were given
    is not to be had; `lost_records` are missing between others, so the firings that follow them in their incarnation
    cannot be repeated either. `beyond` of the unverifiable ones wait for a message after the last one of its stream.
    `unaccounted` messages were made by no record, `unfinished` says that the records end before the run did: records
    are lost. `cut` says that the recording itself ends before the run did, and before this operator; `after_cut` are
    then the messages without a record. `not_stored` messages were made again, but are not in the recording.
    `tainted` is the index of the first firing that was given anything other than recorded, `own_fault` says that the
    first difference came before; `states` of the differences are in snapshots, not in messages.
    `began` says from where it was repeated: "start", "snapshot" (its recorded state) or "stateless".
    """

    operator: str
    firings: int = 0
    verified: int = 0
    outputs: int = 0
    differing: int = 0
    states: int = 0
    unverifiable: int = 0
    beyond: int = 0
    lost_records: int = 0
    unaccounted: int = 0
    unfinished: bool = False
    cut: bool = False
    after_cut: int = 0
    not_stored: int = 0
    began: str = "start"
    own_fault: bool = False
    tainted: int | None = None
    first: Difference | None = None
    missing: str = ""
    files_changed: list[str] = field(default_factory=list)

    @property
    def verdict(self) -> Verdict:
        if self.first is not None:
            return "culprit" if self.own_fault else "downstream"
        return "identical" if self.whole else "unverifiable"

    @property
    def whole(self) -> bool:
        """Everything that was recorded before the cut, if there is one, was repeated, and there was anything."""
        if self.lost_records or self.unaccounted or self.unfinished:
            return False
        if self.cut:
            return self.unverifiable == self.beyond and (self.verified > 0 or not (self.beyond or self.after_cut))
        return not self.unverifiable

    def to_wire(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> Verification:
        first = values["first"]
        return Verification(**{**values, "first": None if first is None else Difference(**first)})


def recorded_firings(recording: Recording, operator: str) -> Iterator[FiringRecord]:
    """The firing records of one operator, in order."""
    for _, payload in recording.firings(operator):
        yield from decode_batch(payload).records


def first_places(ref: InputRef) -> Iterator[tuple[str, tuple[int, int]]]:
    """(stream, (incarnation, number)) of the first message that a reference names on each stream."""
    match ref:
        case None:
            return
        case MessageRef():
            yield ref.stream, (ref.incarnation, ref.seq)
        case tuple():
            for run in ref:
                yield run.stream, (run.incarnation, run.first_seq)
        case _:
            for one in ref.values():
                yield one.stream, (one.incarnation, one.seq)


def needed_from(records: Iterable[FiringRecord]) -> dict[str, tuple[int, int]]:
    """By stream, the first message (incarnation, number) that the calls of `records` took."""
    needed: dict[str, tuple[int, int]] = {}
    for record in records:
        for ref in record.inputs.values():
            for stream, place in first_places(ref):
                needed[stream] = min(place, needed.get(stream, place))
    return needed


def messages_of(ref: InputRef) -> Iterator[MessageRef]:
    """Every message that a reference names."""
    match ref:
        case None:
            return
        case MessageRef():
            yield ref
        case tuple():
            for run in ref:
                yield from run
        case _:
            yield from ref.values()


def recorded_digests(recording: Recording, nodes: Iterable[Node], streams: frozenset[str]) -> Digests:
    """What the given nodes had emitted on the given streams."""
    found: dict[str, dict[tuple[int, int], bytes]] = {stream: {} for stream in streams}
    for node in nodes:
        outputs = list(node.outputs.values())
        if not streams.isdisjoint(outputs):
            for record in recorded_firings(recording, node.name):
                for stream, emission in zip(outputs, record.outputs, strict=False):  # a failed call has none
                    if emission is not None and stream in found:
                        found[stream][record.incarnation, emission.seq] = emission.digest
    return found


def whole(records: Iterable[FiringRecord]) -> tuple[list[FiringRecord], int]:
    """The records by (incarnation, index), each once, and how many calls had to be left out.

    Where records are missing, those after them in the same incarnation cannot be repeated: the operator's state there
    is not known. The next incarnation begins from `setup()` again (or, after a jump of the clock, does not).
    """
    kept: list[FiringRecord] = []
    lost = 0
    following = (0, 0)
    known = True
    for record in sorted(records, key=lambda r: (r.incarnation, r.index)):
        place = (record.incarnation, record.index)
        if place < following:
            continue  # handed over twice, when its process died
        begins = record.incarnation > following[0] or not following[1]
        if begins:
            known = record.index == 0 and (record.kind != "reset" or known)
        else:
            known = known and place == following
        following = (record.incarnation, record.index + 1)
        if known:
            kept.append(record)
        else:
            lost += record.kind in CALLS
    return kept, lost


def beginning(
    records: list[FiringRecord], begin: int | None, *, stateless: bool
) -> tuple[list[FiringRecord], list[FiringRecord], str]:
    """What lies before the place from which records are repeated, the rest, and how that place was found.

    It is after the last snapshot at or before the stamp `begin`, or at `begin` itself for an operator without state;
    for any other at the start, since its state in the middle is not known.
    """
    if begin is None:
        return [], records, "start"
    place = max((k + 1 for k, r in enumerate(records) if r.kind == "snapshot" and r.stamp <= begin), default=0)
    if stateless:
        place = next((k for k, r in enumerate(records) if r.kind in CALLS and r.stamp >= begin), len(records))
    found = "stateless" if stateless else "snapshot" if place else "start"
    return records[:place], records[place:], found


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
