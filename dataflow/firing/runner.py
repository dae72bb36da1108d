"""Runs one operator: its aligner decides, `process()` works, what comes out is checked, numbered and recorded.

A runner is single-threaded and knows nothing of processes and keys: messages are pushed in by stream name, and what is
emitted goes to an `Emitter`. Hosts, tests (`dataflow.testing.play`) and re-execution all drive this one class.
"""

from __future__ import annotations

import time
import traceback
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dataflow.firing.align import align_spec
from dataflow.firing.seeding import firing_seed, seed_generators
from dataflow.firing.snapshots import pack_state
from dataflow.graph.model import Node
from dataflow.messages.base import Message
from dataflow.messages.digest import StreamDigest
from dataflow.operator import Context, Operator, OperatorSpec, OutputError, OutputPort, Outputs, outputs_of
from dataflow.records.firing import WITHHELD, DropRecord, Emission, FiringRecord, Kind
from dataflow.sync import FOREVER, NEVER, Aligner, Entry, Firing, InputValue, refs_of

MOST_OF_A_TRACEBACK = 20_000


class OperatorFailure(RuntimeError):
    """An operator raised or broke its contract. Carries its name, the firing and the operator's own traceback."""

    def __init__(self, operator: str, when: str, error: BaseException) -> None:
        self.operator, self.when = operator, when
        self.summary = readable(error)
        try:
            self.traceback = cut(_printable("".join(traceback.format_exception(error))), MOST_OF_A_TRACEBACK)
        except Exception:  # its own text cannot be made
            self.traceback = "".join(traceback.format_tb(error.__traceback__)) + self.summary
        super().__init__(f"operator {operator!r} failed in {when}: {self.summary}")


def readable(error: BaseException) -> str:
    """The type and text of an error, whatever it is made of."""
    try:
        text = str(error)
    except Exception as problem:
        text = f"(its text cannot be made: {type(problem).__name__})"
    return cut(_printable(f"{type(error).__name__}: {text}" if text else type(error).__name__))


def cut(text: str, most: int = 2000) -> str:
    """The beginning and the end of a text that is longer than `most` characters, with a note of what is left out."""
    if len(text) <= most:
        return text
    return f"{text[: most // 2]} [... {len(text) - most // 2 * 2} characters left out ...] {text[-(most // 2) :]}"


def _printable(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


def summary_of(operator: Operator, name: str) -> dict[str, float | int | str]:
    """What an operator sums up, as plain values. Raises `OperatorFailure`."""
    try:
        found = dict(operator.summary())
        return {str(key): item if isinstance(item, str) else np.asarray(item).item() for key, item in found.items()}
    except Exception as error:
        raise OperatorFailure(name, "summary()", error) from error


class InputMutated(RuntimeError):
    """An operator changed the memory of a message it was given."""


class Emitter(Protocol):
    """Where a runner's output goes. Calls come in stream order."""

    def message(self, stream: str, entry: Entry) -> None:
        """A message was emitted; `entry.value` is the message."""

    def frontier(self, stream: str, frontier: int) -> None:
        """No later message of the stream has a stamp ≤ `frontier`."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """The stream has ended."""

    def record(self, record: FiringRecord) -> None:
        """A firing was made; called before its messages are sent, so no message is known that no record explains."""


@dataclass(slots=True)
class PortState:
    """One output port: its stream, the next sequence number, its last stamp and what it has promised."""

    port: OutputPort
    stream: str
    incarnation: int = 0
    seq: int = 0
    last: int = NEVER
    promised: int = NEVER
    digest: StreamDigest | None = None

    def __post_init__(self) -> None:
        self.digest = self.digest or StreamDigest()


class OutputPorts:
    """The output ports of one operator: rule 5 of the time model, sequence numbers and frontiers."""

    def __init__(self, node: Node, spec: OperatorSpec, emitter: Emitter, *, lossy: bool = False) -> None:
        self.node, self.emitter, self.lossy = node, emitter, lossy
        self.states = {name: PortState(port, node.outputs[name]) for name, port in spec.outputs.items()}
        self.emitted = 0
        self.withheld: Counter[str] = Counter()
        """Messages that were not sent because their stamps did not increase, by port."""
        self._prepared: list[tuple[str, Entry]] = []

    def prepare(self, messages: Mapping[str, Message], firing: int) -> tuple[Emission | None, ...]:
        """Checks and numbers what one firing emitted; `publish` sends it, after the firing was recorded.

        Raises `OutputError` for a stamp that the port may not carry. With `lossy`, a stamp that does not increase is
        no error: the message is not sent, and its emission is marked `withheld`.
        """
        self.check(messages, firing)
        emissions: list[Emission | None] = []
        for name, state in self.states.items():
            emitted = messages.get(name)
            if emitted is None:
                emissions.append(None)
                continue
            digest = emitted.digest()
            if emitted.stamp <= state.last:
                self.withheld[name] += 1
                emissions.append(Emission(WITHHELD, emitted.stamp, digest))
                continue
            assert state.digest is not None
            state.digest.update(digest)
            entry = Entry(emitted.stamp, emitted, state.seq, state.incarnation, digest, state.stream)
            self._prepared.append((state.stream, entry))
            state.last = state.promised = emitted.stamp
            emissions.append(Emission(state.seq, emitted.stamp, digest))
            state.seq += 1
            self.emitted += 1
        return tuple(emissions)

    def check(self, messages: Mapping[str, Message], firing: int) -> None:
        """Raises `OutputError` for a stamp that the port may not carry."""
        for name, message in messages.items():
            state = self.states[name]
            earliest = firing - state.port.lag
            if message.stamp < earliest:
                allowed = f"at or after the firing's {firing}" + (
                    f" less its lag of {state.port.lag} ns" if state.port.lag else ""
                )
                raise OutputError(f"{self.node.name}.{name} emitted stamp {message.stamp}; it must lie {allowed}")
            if message.stamp <= state.last and not self.lossy:
                raise OutputError(
                    f"{self.node.name}.{name} emitted stamp {message.stamp} after {state.last}: "
                    "the stamps of a stream strictly increase"
                )

    def publish(self) -> None:
        """Sends what was prepared, in order."""
        prepared, self._prepared = self._prepared, []
        for stream, entry in prepared:
            self.emitter.message(stream, entry)

    def begin(self, incarnation: int, *, stamps_go_back: bool = False) -> None:
        """Begins a new incarnation of every dynamic port: numbers from 0 again, and stamps too if they may go back."""
        for state in self.states.values():
            if state.port.static:
                continue
            state.incarnation, state.seq = incarnation, 0
            if stamps_go_back:
                state.last = state.promised = NEVER

    def resume(self, incarnation: int, last: Mapping[str, int]) -> None:
        """Goes on where an earlier process of this operator ended: its last stamps, by port."""
        self.begin(incarnation)
        for name, stamp in last.items():
            self.states[name].last = self.states[name].promised = stamp

    def promise(self, frontier: int) -> None:
        """Raises the frontier of every dynamic port to `frontier` less its lag, where that is news."""
        for state in self.states.values():
            if state.port.static or frontier in (NEVER, FOREVER):
                continue
            trailing = frontier - state.port.lag
            if trailing > state.promised:
                state.promised = trailing
                self.emitter.frontier(state.stream, trailing)

    def end(self, final: int | None, reason: str) -> None:
        """Ends every dynamic port at `final`, or at what it emitted or promised later."""
        for state in self.states.values():
            if state.promised != FOREVER:
                reached = max(NEVER if final is None else final, state.promised)
                state.promised = FOREVER
                self.emitter.end(state.stream, None if reached == NEVER else reached, reason)


class Recorder:
    """Numbers the firing records of one operator and hands them on."""

    def __init__(self, operator: str, emitter: Emitter, incarnation: int = 0) -> None:
        self.operator, self.emitter, self.incarnation, self.index = operator, emitter, incarnation, 0

    def add(self, kind: Kind, stamp: int, started: int, **fields: Any) -> None:
        duration = time.time_ns() - started
        self.emitter.record(
            FiringRecord(
                self.operator,
                self.incarnation,
                self.index,
                kind,
                stamp,
                wall_start=started,
                duration=duration,
                **fields,
            )
        )
        self.index += 1


def set_up(
    operator: Operator, ports: OutputPorts, records: Recorder, node: Node, seed: int, *, already: bool = False
) -> None:
    """`setup()` (unless that is done `already`), then the static outputs; recorded. Raises `OperatorFailure`."""
    started = time.time_ns()
    try:
        operator.rng = seed_generators(firing_seed(seed, node.name, NEVER))
        if not already:
            operator.setup()
        emissions = ports.prepare(checked_statics(operator, node), NEVER)
    except BaseException as error:
        raise OperatorFailure(node.name, "setup()", error) from error
    detail = {"params": operator.params.model_dump(mode="json"), "files": dict(operator.files)}
    records.add("setup", NEVER + 1, started, outputs=emissions, detail=detail)
    ports.publish()
    for state in ports.states.values():
        if state.port.static:
            ports.emitter.end(state.stream, None, "static")
            state.promised = FOREVER


def set_up_again(operator: Operator, ports: OutputPorts, records: Recorder, node: Node, seed: int) -> None:
    """`setup()` of an operator that takes the place of a failed one; its static streams go on as they are."""
    started = time.time_ns()
    try:
        operator.rng = seed_generators(firing_seed(seed, node.name, NEVER))
        operator.setup()
        checked_statics(operator, node)
    except BaseException as error:
        raise OperatorFailure(node.name, "setup()", error) from error
    detail = {"params": operator.params.model_dump(mode="json"), "files": dict(operator.files)}
    records.add("setup", NEVER + 1, started, outputs=(None,) * len(ports.states), detail=detail)


def checked_statics(operator: Operator, node: Node) -> dict[str, Message]:
    """What `static_outputs()` gives, by port. Raises `OutputError` for what is not declared so."""
    statics = dict(operator.static_outputs())
    for name, message in statics.items():
        port = operator.spec.outputs.get(name)
        if port is None or not port.static:
            raise OutputError(f"{node.name}: static_outputs() gave {name!r}, which is no static output port")
        if not isinstance(message, port.types):
            raise OutputError(f"{node.name}.{name} is a {port.type_text()}, got {type(message).__name__}")
    return statics


class OperatorRunner:
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
        snapshots: int | None = None,
    ) -> None:
        self.node, self.seed, self.paranoid, self.snapshots = node, seed, paranoid, snapshots
        self._next_snapshot: int | None = None
        self._warm: int | None = None
        self.operator = node.make() if operator is None else operator
        self.spec = self.operator.spec
        self.ports = OutputPorts(node, self.spec, emitter, lossy=lossy)
        self.records = Recorder(node.name, emitter)
        self.aligner = Aligner(align_spec(node, self.spec, static))
        self.firings = 0
        self.done = NEVER
        self.ended = False
        self.busy_ns = 0
        self.working_since: float | None = None
        """When the call that is under way began (monotonic seconds), for whoever watches over it."""
        self.working_stamp = NEVER

    def take_over(self, operator: Operator, stamp: int) -> None:
        """Begins in the middle: with an operator that is set up and has the state it had before `stamp`. To be called
        before `setup()`."""
        self.operator, self._warm = operator, stamp

    def setup(self) -> None:
        if self._warm is None:
            set_up(self.operator, self.ports, self.records, self.node, self.seed)
            return
        started = time.time_ns()
        set_up(self.operator, self.ports, self.records, self.node, self.seed, already=True)
        state = self.operator.snapshot()
        detail = {"state": None if state is None else pack_state(state), "before": self._warm}
        self.records.add("restore", self._warm, started, detail=detail)

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        """Messages dropped so far, by (input, reason)."""
        return self.aligner.drops

    def take_drops(self) -> list[DropRecord]:
        """What was dropped since the last record."""
        return [
            DropRecord(d.input, d.stream, d.incarnation, d.seq, d.stamp, d.reason, d.because)
            for d in self.aligner.take_drops()
        ]

    def waiting(self) -> tuple[int | None, dict[str, int]]:
        """The stamp that cannot be decided yet, and the frontiers that would decide it, by input."""
        held = self.aligner.waiting()
        return (None, {}) if held is None else (held.stamp, dict(held.needs))

    def set_parameter(self, name: str, value: Any) -> Any:
        """Changes a parameter between two firings; recorded. Returns the value as validated.

        Raises `ParameterError` for one that does not exist, cannot change while running, or is out of bounds.
        """
        return change_parameter(self.operator, self.records, name, value, max(self.done, NEVER + 1))

    def push(self, stream: str, entry: Entry) -> None:
        self.aligner.push(stream, entry)

    def advance(self, stream: str, frontier: int) -> None:
        self.aligner.advance(stream, frontier)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self.aligner.end(stream, final_stamp, reason)

    def step(self) -> bool:
        """Makes the next firing if it is decided; False when there is none. Raises `OperatorFailure`."""
        if self.ended:
            return False
        firing = self.aligner.poll()
        if firing is None:
            frontier = self.aligner.output_frontier()
            self.ports.promise(frontier)
            self.done = max(self.done, frontier)
            return False
        self.ports.promise(firing.stamp - 1)
        self.working_stamp, self.working_since = firing.stamp, time.monotonic()
        try:
            self._fire(firing)
        finally:
            self.working_since = None
        if firing.kind == "finish":
            self.ended, self.done = True, FOREVER
            self.ports.end(self.aligner.final_stamp(), "end of input")
        return True

    def _fire(self, firing: Firing) -> None:
        started = time.time_ns()
        kind: Kind = firing.kind
        try:
            self.operator.rng = seed_generators(firing_seed(self.seed, self.node.name, firing.stamp))
            messages = outputs_of(self.operator, call_operator(self.operator, firing))
            if self.paranoid and (problem := changed_input(self.node, firing)) is not None:
                raise problem
            emissions = self.ports.prepare(messages, firing.stamp)
        except BaseException as error:
            failure = OperatorFailure(self.node.name, f"{kind} at stamp {firing.stamp}", error)
            self._record(kind, firing, started, (), failure.summary)
            raise failure from error
        self.firings += kind != "finish"
        self._record(kind, firing, started, emissions, None)
        self.ports.publish()
        self.busy_ns += time.time_ns() - started
        if self.snapshots is not None and kind != "finish":
            self._snapshot_if_due(firing.stamp)

    def _snapshot_if_due(self, stamp: int) -> None:
        """Records the operator's state, about every `snapshots` ns of event time; at the same firings in every run."""
        assert self.snapshots is not None
        if self._next_snapshot is None:
            self._next_snapshot = stamp + self.snapshots
        if stamp < self._next_snapshot:
            return
        self._next_snapshot = stamp + self.snapshots
        started = time.time_ns()
        try:
            state = self.operator.snapshot()
            packed = None if state is None else pack_state(state)
        except Exception as error:
            raise OperatorFailure(self.node.name, f"snapshot() after stamp {stamp}", error) from error
        if packed is not None:
            self.records.add("snapshot", stamp, started, detail={"state": packed})

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
        detail: dict[str, Any] = {}
        if error is not None:
            detail = {"error": error, **({"injected": True} if injected else {})}
        elif kind == "finish" and (summary := summary_of(self.operator, self.node.name)):
            detail = {"summary": summary}
        self.records.add(
            kind,
            firing.stamp,
            started,
            tick=firing.tick,
            inputs=refs_of(firing).inputs,
            stale=firing.stale,
            late=firing.late,
            outputs=outputs,
            outcome="ok" if error is None else "error",
            drops=tuple(self.take_drops()),
            detail=detail,
        )


def change_parameter(operator: Operator, records: Recorder, name: str, value: Any, stamp: int) -> Any:
    """Sets a parameter of an operator that runs, and records it; the value as validated, in plain form."""
    started = time.time_ns()
    operator.set_parameter(name, value)
    plain = operator.params.model_dump(mode="json")[name]
    records.add("param", stamp, started, detail={"name": name, "value": plain})
    return plain


def call_operator(operator: Operator, firing: Firing) -> Outputs:
    """`process()` with what a firing holds, or `finish()`."""
    if firing.kind == "finish":
        return operator.finish()
    arguments: dict[str, Any] = {
        name: value_of(firing.inputs.get(name, () if port.kind == "batch" else None))
        for name, port in operator.spec.inputs.items()
    }
    if "context" in operator.spec.process_takes:
        arguments["context"] = Context(firing.stamp, firing.tick, firing.stale, firing.late)
    return operator.process(**arguments)


def changed_input(node: Node, firing: Firing) -> InputMutated | None:
    """An error for the first input message whose memory is no longer what its digest says."""
    for name, given in firing.inputs.items():
        for entry in entries_of(given):
            message: Message = entry.value
            if message.compute_digest() != message.digest():
                return InputMutated(
                    f"{node.name} changed the memory of its input {name!r} "
                    f"({message.SCHEMA} at stamp {message.stamp}); messages are immutable: copy before writing"
                )
    return None


def entries_of(given: InputValue) -> Sequence[Entry]:
    """All entries an input was given, in the order `process()` sees them."""
    match given:
        case None:
            return ()
        case Entry():
            return (given,)
        case Mapping():
            return tuple(given.values())
        case _:
            return given


def value_of(given: InputValue) -> Any:
    """What `process()` gets: a message, None, a tuple of messages, or a dict from stream to message."""
    match given:
        case None:
            return None
        case Entry():
            return given.value
        case Mapping():
            return {stream: entry.value for stream, entry in given.items()}
        case _:
            return tuple(entry.value for entry in given)
