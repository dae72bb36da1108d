"""Runs one operator: its aligner decides, `process()` works, what comes out is checked, numbered and recorded.

A runner is single-threaded and independent of processes and keys: messages are pushed in by stream name, and emitted
ones go to an `Emitter`. Runs, replays and tests (`dataflow.testing.play`) drive `OperatorRunner`; `LiveRunner` and
`RecordedRunner` take its place in a live run and in a re-execution.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

from dataflow.execution.calls import Calls
from dataflow.execution.failure import RAISED, InputMutated, OperatorFailure, TooManyTicks
from dataflow.execution.log import FiringLog, unlisted
from dataflow.execution.memory import WATCHED, MemoryGuard
from dataflow.execution.ports import Emitter
from dataflow.execution.protocol import Runner
from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.operator import Operator, OperatorSpec
from dataflow.records.firing import MAX_STATE_BYTES, Emission, Kind
from dataflow.records.spacing import StateSpacing
from dataflow.sync import (
    FOREVER,
    NEVER,
    AlignSpec,
    BatchSpec,
    Drop,
    Entry,
    Firing,
    SampledSpec,
    TriggerSpec,
    format_duration,
    format_stamp,
)
from dataflow.sync.single import make_aligner

MOST_TICKS = 1_000_000
"""Ticks that may be due at once, with no message between them: 10 Hz for a day and more. A timer that owes more was led
by a wrong stamp. A live run leaves ticks out instead, and counts them."""

SHORT = 1_000_000
"""ns: an operator whose calls take less on average does not announce each one by a frontier below its stamp. Its
messages imply the same frontier at once."""

MOST_DROPPED = 10_000
"""Stamps that one step may drop before it returns to its driver, which has other work."""


_NOTHING: Mapping[str, Any] = {}


class OperatorRunner(Runner):
    """One operator that has inputs, from `setup()` to its end."""

    def __init__(
        self,
        node: Node,
        emitter: Emitter,
        *,
        static: frozenset[str],
        seed: int = 0,
        paranoid: bool = False,
        operator: Operator | None = None,
        lossy: bool = False,
        snapshots: StateSpacing | None = None,
    ) -> None:
        super().__init__(node, node.make() if operator is None else operator, emitter, lossy=lossy)
        self.paranoid, self.snapshots = paranoid, snapshots
        self._left_out = 0
        self._warm: int | None = None
        self._guard, self._watched = MemoryGuard(), FOREVER if paranoid else WATCHED
        self.idle = NEVER
        """The output frontier after the last step, where that left nothing to decide; else NEVER."""
        self.calls = Calls(node, self.operator, seed)
        self.records = FiringLog(node.name, emitter)
        self.aligner = make_aligner(align_spec(node, self.spec, static))

    def take_over(self, operator: Operator, stamp: int) -> None:
        """Begins in the middle: with an operator that is set up and has the state it had before `stamp`. To be called
        before `setup()`."""
        self.operator = self.calls.operator = operator
        self._warm = stamp

    def setup(self) -> None:
        started = time.time_ns()
        statics = self.calls.setup() if self._warm is None else self.calls.static_outputs()
        self.records.add_setup(self.operator, started, self.ports.prepare(statics, NEVER))
        self.ports.publish()
        self.ports.end_statics()
        if self._warm is not None:
            started = time.time_ns()
            state = self.calls.snapshot((self.records.incarnation, self._warm))
            kept = state if state is None or len(state) <= MAX_STATE_BYTES else None
            self.records.add("restore", self._warm, started, detail={"state": kept, "before": self._warm})

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        return self.aligner.drops

    @property
    def late(self) -> Mapping[str, int]:
        return self.aligner.late

    def take_drops(self) -> tuple[list[Drop], Mapping[tuple[str, str], int]]:
        """Returns what was dropped since the last record, and the number of what was too much to be listed."""
        return self.aligner.take_drops(), self.aligner.take_unlisted()

    def has_drops(self) -> bool:
        """Returns whether anything was dropped since the last record."""
        return bool(self.aligner.dropped)

    def waiting(self) -> tuple[int | None, dict[str, int]]:
        """The stamp that cannot be decided yet, and the frontiers that would decide it, by input."""
        held = self.aligner.waiting()
        return (None, {}) if held is None else (held.stamp, dict(held.needs))

    def set_parameter(self, name: str, value: Any) -> Any:
        started = time.time_ns()
        stamp = self.working_stamp if self.ended else max(self.done, NEVER + 1)
        plain = self.calls.parameter(name, value, (self.records.incarnation, stamp))
        self.records.add("param", stamp, started, detail={"name": name, "value": plain})
        return plain

    def push(self, stream: str, entry: Entry) -> None:
        self.aligner.push(stream, entry)
        if not self.awake:
            self.wake()

    def advance(self, stream: str, frontier: int) -> None:
        self.aligner.advance(stream, frontier)
        if not self.awake:
            self.wake()

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self.aligner.end(stream, final_stamp, reason)
        self.wake()

    def step(self) -> bool:
        if self.ended:
            return False
        if self.node.every is not None:
            self._bound_ticks(self.node.every)
        firing = self.aligner.poll(MOST_DROPPED)
        if firing is None:
            frontier = self.aligner.output_frontier()
            self.ports.promise(frontier)
            self.done = max(self.done, frontier)
            if self.aligner.paused:
                self.idle = NEVER
                self.wake()
            return self.aligner.paused
        work = self.work
        if work.mean_ns > SHORT:
            self.ports.promise(firing.stamp - 1)
        self.working_stamp = firing.stamp
        self.working_since = work.begin() * 1e-9
        try:
            self._fire(firing)
        finally:
            work.end()
            self.working_since = None
        if firing.kind == "finish":
            self.ended, self.done, self.idle = True, FOREVER, FOREVER
            self.ports.end(self.aligner.final_stamp(), "end of input")
            return True
        frontier = self.idle = self.aligner.idle_frontier()
        if frontier == NEVER:
            frontier = firing.stamp
            self.wake()
        self.ports.promise(frontier)
        if frontier > self.done:
            self.done = frontier
        return True

    def _bound_ticks(self, period: int) -> None:
        """Raises `OperatorFailure` when the timer owes more than it may."""
        number, first, last = self.aligner.owed_ticks()
        if number > MOST_TICKS:
            error = TooManyTicks(
                f"{number:,} ticks, one every {format_duration(period)}, are due at once, from {format_stamp(first)} "
                f"to {format_stamp(last)}: the stamps of its inputs jump ahead. At most {MOST_TICKS:,} are made up "
                "for: mend the stamps, or set a longer `every`"
            )
            raise OperatorFailure(self.node.name, "its timer", error)

    def _fire(self, firing: Firing) -> None:
        started = time.time_ns()
        kind: Kind = firing.kind
        try:
            if self.firings < self._watched:
                messages = self._call_watched(firing)
            else:
                messages = self.calls.process(firing)
            emissions = self.ports.prepare(messages, firing.stamp)
        except RAISED as error:
            failure = OperatorFailure(self.node.name, f"{kind} at stamp {firing.stamp}", error)
            self._record(kind, firing, started, (), failure.summary)
            raise failure from error
        if kind != "finish":
            self.firings += 1
        self._record(kind, firing, started, emissions, None)
        self.ports.publish()
        spacing = self.snapshots
        if spacing is not None and kind != "finish" and spacing.is_due(firing.stamp, self.work.cpu_ns, self.firings):
            self._snapshot(firing.stamp, spacing)

    def _call_watched(self, firing: Firing) -> dict[str, Message]:
        """Makes a call and looks whether it has written into its inputs: an error if `paranoid`, else printed."""
        self._guard.take(self.node.name, firing)
        messages = self.calls.process(firing)
        if what := self._guard.changed(self.node.name):
            problem = InputMutated(self.node.name, what)
            if self.paranoid:
                raise problem
            print(f"warning: {problem}", file=sys.stderr)
            self._watched = 0
        return messages

    def _snapshot(self, stamp: int, spacing: StateSpacing) -> None:
        """Records the operator's state behind the firing at a stamp."""
        started = time.time_ns()
        state = self.calls.snapshot((self.records.incarnation, stamp))
        if state is None:
            return
        spacing.took(len(state))
        if len(state) <= MAX_STATE_BYTES:
            self.records.add("snapshot", stamp, started, detail={"state": state})
            return
        self._left_out += 1
        self.records.add("snapshot", stamp, started, detail={"left_out": len(state)})
        self.operator.log.warning(
            "a snapshot of %d bytes is left out, at most %d are recorded; %d so far",
            len(state),
            MAX_STATE_BYTES,
            self._left_out,
        )

    def _record(
        self,
        kind: Kind,
        firing: Firing,
        started: int,
        outputs: tuple[Emission | None, ...],
        error: str | None,
        *,
        injected: bool = False,
    ) -> None:
        if error is None and kind != "finish" and not self.calls.effects.made and not self.has_drops():
            self.records.add_firing(kind, started, firing, outputs, "ok", (), _NOTHING)
            return
        detail: dict[str, Any] = {}
        if error is not None:
            detail = {"error": error, **({"injected": True} if injected else {})}
        elif kind == "finish" and (summary := self.calls.summary((self.records.incarnation, firing.stamp))):
            detail = {"summary": summary}
        detail |= self.calls.effects.take()
        dropped: tuple[Drop, ...] = ()
        if self.has_drops():
            listed, more = self.take_drops()
            dropped = tuple(listed)
            detail |= unlisted(more)
        self.records.add_firing(kind, started, firing, outputs, "ok" if error is None else "error", dropped, detail)


def align_spec(node: Node, spec: OperatorSpec, static: frozenset[str]) -> AlignSpec:
    """The alignment of one operator; `static` names the graph's static streams. An input left unwired takes no part."""
    triggers: list[TriggerSpec] = []
    sampled: list[SampledSpec] = []
    batches: list[BatchSpec] = []
    for name, port in spec.inputs.items():
        streams = node.inputs.get(name, ())
        if not streams:
            continue
        if port.kind == "in":
            triggers.append(TriggerSpec(name, streams, port.many))
        elif port.kind == "sampled":
            sampled.append(SampledSpec(name, streams, port.max_age, port.required, port.before or None, port.many))
        else:
            batches.append(BatchSpec(name, streams, port.max, port.max_age, port.many))
    merged = spec.merge
    joined = len(triggers) > 1 and not merged
    return AlignSpec(
        triggers=tuple(triggers),
        sampled=tuple(sampled),
        batches=tuple(batches),
        mode="merge" if merged else "join",
        tolerance=node.tolerance if joined else 0,
        every=node.every,
        static=static & node.taken,
    )
