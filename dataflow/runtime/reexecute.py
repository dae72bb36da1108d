"""Drives an operator by its recorded firings and compares what it makes, digest by digest.

The recorded firings say which messages each call was given, so nothing is decided again: drops, timeouts and lateness of
a live run are repeated exactly. A difference is the operator's own when everything it had been given until then was as
recorded (*culprit*); otherwise it follows from another's (*downstream*).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.operator import Operator, OperatorSpec, outputs_of
from dataflow.recording import Recording
from dataflow.runtime.align import align_spec
from dataflow.runtime.firings import Emission, FiringRecord, decode_batch
from dataflow.runtime.runner import Emitter, OperatorFailure, OutputPorts, call_operator, changed_input, entries_of
from dataflow.runtime.seeding import firing_seed, seed_generators
from dataflow.sync import FOREVER, NEVER, Entry, Firing, MessageRef, RecordedAligner

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


@dataclass(slots=True)
class Verification:
    """What re-executing one operator came to.

    `verified` firings were repeated and compared; `unverifiable` ones could not be, because a message they were given
    is not to be had; `after_cut` messages lie after the operator's last record. `tainted` is the index of the first
    firing that was given anything other than recorded.
    """

    operator: str
    firings: int = 0
    verified: int = 0
    outputs: int = 0
    differing: int = 0
    unverifiable: int = 0
    after_cut: int = 0
    complete: bool = False
    tainted: int | None = None
    first: Difference | None = None
    missing: str = ""
    files_changed: list[str] = field(default_factory=list)

    @property
    def verdict(self) -> Verdict:
        if self.first is not None:
            by_itself = self.tainted is None or self.first.index < self.tainted
            return "culprit" if by_itself else "downstream"
        return "unverifiable" if self.unverifiable else "identical"

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


def recorded_digests(recording: Recording, nodes: Iterable[Node], streams: frozenset[str]) -> Digests:
    """What the given nodes had emitted on the given streams."""
    found: dict[str, dict[tuple[int, int], bytes]] = {stream: {} for stream in streams}
    for node in nodes:
        outputs = list(node.outputs.values())
        if not streams.isdisjoint(outputs):
            for record in recorded_firings(recording, node.name):
                for stream, emission in zip(outputs, record.outputs, strict=True):
                    if emission is not None and stream in found:
                        found[stream][record.incarnation, emission.seq] = emission.digest
    return found


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
    ) -> None:
        self.node, self.seed, self.paranoid = node, seed, paranoid
        self.operator: Operator = node.make()
        self.spec: OperatorSpec = self.operator.spec
        self.ports = OutputPorts(node, self.spec, emitter)
        self.emitter = emitter
        self.result = Verification(node.name)
        self._inputs = inputs
        all_records = list(records)
        self._setup = next((r for r in all_records if r.kind == "setup"), None)
        self._records = [r for r in all_records if r.kind in ("fire", "tick", "finish")]
        self.result.firings = len(self._records)
        self.result.complete = any(r.kind == "finish" for r in self._records)
        self.aligner = RecordedAligner(align_spec(node, self.spec, static), (r.firing() for r in self._records))
        self._position = 0
        self._latest: dict[str, tuple[int, int]] = {}
        self._open = {s for streams in node.inputs.values() for s in streams}
        self._static = static
        self.firings = 0
        self.done = NEVER
        self.ended = False
        self.busy_ns = 0

    def setup(self) -> None:
        """`setup()` of the operator; files that have changed since are noted. Raises `OperatorFailure`."""
        try:
            self.operator.rng = seed_generators(firing_seed(self.seed, self.node.name, NEVER))
            self.operator.setup()
            statics = dict(self.operator.static_outputs())
        except Exception as error:
            raise OperatorFailure(self.node.name, "setup()", error) from error
        if self._setup is not None:
            before = self._setup.detail.get("files", {})
            self.result.files_changed = sorted(
                f for f, digest in self.operator.files.items() if before.get(f) != digest
            )
            self._compare(self._setup, statics)
        for state in self.ports.states.values():
            if state.port.static:
                state.promised = FOREVER
                self.emitter.end(state.stream, None, "static")

    def push(self, stream: str, entry: Entry) -> None:
        self._latest[stream] = (entry.incarnation, entry.seq)
        if self._position < len(self._records) and not self.ended:
            self.aligner.push(stream, entry)
        elif not self.result.complete:
            self.result.after_cut += stream not in self._static

    def advance(self, stream: str, frontier: int) -> None:
        """Recorded firings wait for messages, not for promises."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self._open.discard(stream)

    def step(self) -> bool:
        """Makes the next recorded firing once its messages are there; ends when it cannot come any more."""
        if self.ended:
            return False
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

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        """Nothing is dropped again."""
        return {}

    def _fire(self, firing: Firing, record: FiringRecord) -> None:
        started = time.time_ns()
        if self.result.tainted is None and not self._as_recorded(firing):
            self.result.tainted = record.index
        self.operator.rng = seed_generators(firing_seed(self.seed, self.node.name, firing.stamp))
        try:
            messages = outputs_of(self.operator, call_operator(self.operator, firing))
        except Exception as error:
            self._differ(record, "", record.outcome, f"{type(error).__name__}: {error}")
            messages = {}
        else:
            if record.outcome == "error":
                self._differ(record, "", f"error: {record.detail.get('error', '')}", "no error")
            if self.paranoid and (problem := changed_input(self.node, firing)) is not None:
                raise OperatorFailure(self.node.name, f"{record.kind} at stamp {record.stamp}", problem)
        self._compare(record, messages)
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
        for (name, state), expected in zip(self.ports.states.items(), record.outputs, strict=True):
            got = messages.get(name)
            if expected is None and got is None:
                continue
            self.result.outputs += 1
            if expected is None or got is None:
                self._differ(record, name, *(_word(expected), _word(got)))
            elif got.digest() != expected.digest:
                self._differ(record, name, expected.digest.hex(), got.digest().hex())
            if expected is not None and got is not None:
                assert state.digest is not None
                state.digest.update(got.digest())
                self.ports.emitted += 1
                entry = Entry(got.stamp, got, expected.seq, record.incarnation, got.digest(), state.stream)
                state.last = state.promised = max(state.promised, got.stamp)
                self.emitter.message(state.stream, entry)

    def _differ(self, record: FiringRecord, port: str, expected: str, got: str) -> None:
        self.result.differing += 1
        if self.result.first is None:
            self.result.first = Difference(record.index, record.kind, record.stamp, port, expected, got)

    def _end(self) -> None:
        self.ended, self.done = True, FOREVER
        self.result.unverifiable = len(self._records) - self._position
        if self.result.unverifiable and (lost := self.aligner.missing()) is not None:
            self.result.missing = f"{lost.stream} #{lost.seq}"
        self.ports.end(None, "end of records")


def _word(emission: Emission | Message | None) -> str:
    return "nothing" if emission is None else f"a message at stamp {emission.stamp}"
