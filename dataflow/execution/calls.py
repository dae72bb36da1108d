"""Calls an operator: the one way for a run, a live run and a re-execution, so that they cannot drift apart.

Before every call the random generators are seeded (`dataflow.execution.generators.seeding`), so that it depends on its
arguments and the operator's state alone.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from threading import get_ident
from typing import Any

import numpy as np

from dataflow.execution.effects.answers import EffectError
from dataflow.execution.effects.journal import Journal
from dataflow.execution.failure import RAISED, RESTORE, OperatorFailure
from dataflow.execution.generators.loading import LOADS
from dataflow.execution.generators.seeding import VERSION, FiringSeed, change_seed, firing_seed, seed_generators
from dataflow.execution.generators.shared_generators import CALLS_IN_PROGRESS
from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.execution.threads import limit_threads_again
from dataflow.graph.model import Node
from dataflow.messages.base import Message, complete, lacking
from dataflow.operator import FINDING, Context, Operator, OperatorSpec, OutputError, Outputs, outputs_of
from dataflow.sync import NEVER, Entry, Firing, InputValue
from dataflow.sync.entries import entries_of

Place = tuple[int, int]
"""The place of a call that is no firing: (incarnation, stamp)."""


class Calls:
    """One operator. `version` is that of the seeding; `effects` the journal of what it calls outside; `operator` may be
    replaced, when it is restarted."""

    def __init__(
        self, node: Node, operator: Operator, seed: int, *, version: int = VERSION, effects: Journal | None = None
    ) -> None:
        self.node, self.operator, self.seed, self.version = node, operator, seed, version
        self.effects = Journal() if effects is None else effects
        self._seeded_by = f"{seed}/{node.name}/"
        self._firing: int | None = None
        """The stamp of the firing under way; None outside of one."""
        self._thread = 0
        """The thread that makes it."""
        self._asking = False
        """True in an effect."""

    def setup(self) -> dict[str, Message]:
        """`setup()`, then the messages of the static outputs. Raises `OperatorFailure`."""
        return self._set_up("setup()", self.operator.setup, limit_threads_again)

    def static_outputs(self) -> dict[str, Message]:
        """The messages of the static outputs of an operator that is set up. Raises `OperatorFailure`."""
        return self._set_up("static_outputs()")

    def _set_up(self, when: str, *steps: Callable[[], object]) -> dict[str, Message]:
        try:
            with CALLS_IN_PROGRESS.call(self.node.name, NEVER):
                self._seed(firing_seed(self.seed, self.node.name, NEVER))
                self.operator.journal_effects(self._effect)
                for step in steps:
                    step()
                return self._static_outputs()
        except RAISED as error:
            raise OperatorFailure(self.node.name, when, error) from error

    def process(self, firing: Firing) -> dict[str, Message]:
        """Returns what `process()`, or `finish()`, gives for a firing, by port. Raises what the operator raises."""
        operator, effects, stamp = self.operator, self.effects, firing.stamp
        CALLS_IN_PROGRESS.fires = True
        CALLS_IN_PROGRESS.operator, CALLS_IN_PROGRESS.stamp = self.node.name, stamp
        CALLS_IN_PROGRESS.begun += 1
        try:
            seed = FiringSeed((self._seeded_by, stamp))
            seed_generators(seed, self.version)
            operator.seed_rng(seed)
            self._firing, self._thread, effects.asked = stamp, get_ident(), 0
            spec = operator.spec
            outputs = outputs_of(spec, _call(operator, spec, firing))
            if effects.missed is not None:  # the operator has caught it
                raise effects.missed
            for message in outputs.values():
                if lacking(message):
                    complete_outputs(spec, outputs, firing)
                    break
            return outputs
        except RAISED as error:
            missed = effects.missed
            if missed is None or error is missed or isinstance(error, KeyboardInterrupt):
                raise
            raise missed from error  # the operator has raised another error in its place
        finally:
            self._firing = None
            LOADS.seed = None
            CALLS_IN_PROGRESS.ended += 1

    def reset(self, input: str, place: Place) -> None:
        """`on_reset()`. Raises what the operator raises."""
        with CALLS_IN_PROGRESS.call(self.node.name, place[1]):
            self._seed_change(f"reset {input}", place)
            self.operator.on_reset(input)

    def parameter(self, name: str, value: Any, place: Place) -> Any:
        """Sets a parameter, which calls `on_parameter()`; its value as validated, in plain form. Raises
        `ParameterError` and what the operator raises."""
        with CALLS_IN_PROGRESS.call(self.node.name, place[1]):
            self._seed_change(f"param {name}", place)
            self.operator.set_parameter(name, value)
            return self.operator.params.model_dump(mode="json")[name]

    def snapshot(self, place: Place) -> bytes | None:
        """The state, packed; None where the operator gives none. Raises `OperatorFailure`."""
        try:
            with CALLS_IN_PROGRESS.call(self.node.name, place[1]):
                self._seed_change("snapshot", place)
                state = self.operator.snapshot()
                return None if state is None else pack_state(state)
        except RAISED as error:
            raise OperatorFailure(self.node.name, f"snapshot() after stamp {place[1]}", error) from error

    def restore(self, state: bytes, place: Place) -> None:
        """Takes over a packed state. Raises `OperatorFailure`."""
        try:
            with CALLS_IN_PROGRESS.call(self.node.name, place[1]):
                self._seed_change("restore", place)
                self.operator.restore(unpack_state(state))
        except RAISED as error:
            raise OperatorFailure(self.node.name, RESTORE, error) from error

    def summary(self, place: Place) -> dict[str, float | int | str]:
        """Returns what the operator sums up, as plain values. Raises `OperatorFailure`."""
        with CALLS_IN_PROGRESS.call(self.node.name, place[1]):
            self._seed_change("summary", place)
            return summary_of(self.operator, self.node.name)

    def _static_outputs(self) -> dict[str, Message]:
        statics = dict(self.operator.static_outputs())
        for name, message in statics.items():
            port = self.operator.spec.outputs.get(name)
            if port is None or not port.static:
                raise OutputError(f"{self.node.name}: static_outputs() gave {name!r}, which is no static output port")
            if not isinstance(message, port.types):
                raise OutputError(f"{self.node.name}.{name} is a {port.type_text()}, got {type(message).__name__}")
        require_complete(self.operator.spec, statics, "static_outputs()")
        return statics

    def _effect(self, call: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Makes an effect of a firing. The generators are seeded anew behind it: the call may have drawn from them, and
        is not made in a re-execution."""
        stamp = self._firing
        if stamp is None:
            problem = "effect() is for process() and finish(): an answer is recorded with a firing"
        elif get_ident() != self._thread:
            problem = "effect() on another thread than process(): use the threads inside the call"
        elif self._asking:
            problem = "effect() inside an effect: its answer is part of the outer one's"
        else:
            self._asking = True
            try:
                return self.effects.ask(call, args, kwargs)
            finally:
                self._asking = False
                self._seed(change_seed(self.seed, self.node.name, f"effect {self.effects.asked}", 0, stamp))
        raise EffectError(f"{self.node.name}: {problem}")

    def _seed_change(self, what: str, place: Place) -> None:
        if self.version >= 2:
            self._seed(change_seed(self.seed, self.node.name, what, *place))

    def _seed(self, seed: int) -> None:
        seed_generators(seed, self.version)
        self.operator.seed_rng(seed)


def summary_of(operator: Operator, name: str) -> dict[str, float | int | str]:
    """Returns what an operator sums up and its finding, if any, as plain values. Raises `OperatorFailure`."""
    try:
        found = dict(operator.summary())
        if finding := operator.finding():
            found[FINDING] = finding
        return {str(key): item if isinstance(item, str) else np.asarray(item).item() for key, item in found.items()}
    except Exception as error:
        raise OperatorFailure(name, "summary()", error) from error


def _call(operator: Operator, spec: OperatorSpec, firing: Firing) -> Outputs:
    if firing.kind == "finish":
        return operator.finish()
    arguments: dict[str, Any] = {}
    given = firing.inputs
    for name, absent in spec.absent.items():
        value = given.get(name, absent)
        arguments[name] = value.value if value.__class__ is Entry else value_of(value)
    if spec.takes_context:
        arguments["context"] = Context(firing.stamp, firing.tick, firing.stale, firing.late)
    return operator.process(**arguments)


def value_of(given: InputValue) -> Any:
    """Returns what `process()` gets: a message, None, a tuple of messages, or a dict from stream to message."""
    match given:
        case None:
            return None
        case Entry():
            return given.value
        case Mapping():
            return {stream: entry.value for stream, entry in given.items()}
        case _:
            return tuple(entry.value for entry in given)


@contextlib.contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Raises `TimeoutError` in the block when its time is up, between two steps of Python or in a call of the system:
    in the main thread, where signals come; in any other nothing bounds it. Compiled code is not interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(number: int, frame: object) -> None:
        raise TimeoutError(f"not over within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def complete_outputs(spec: OperatorSpec, outputs: Mapping[str, Message], firing: Firing) -> None:
    """Completes what `process()` or `finish()` returned, by port. Raises `OutputError` where the anchor has no frame.

    The anchor is the message that triggered the firing: of joined inputs the first. Merged inputs, and one with
    `many=True`, may fire at several messages at once, which then need to be of one frame.
    """
    for port, message in outputs.items():
        if missing := lacking(message):
            complete(message, firing.stamp, _frame(spec, firing, port, message) if missing != ["stamp"] else "")


def require_complete(spec: OperatorSpec, outputs: Mapping[str, Message], given_by: str) -> None:
    """Raises `OutputError` for a message that lacks its stamp or frame where no firing has them."""
    for port, message in outputs.items():
        if missing := lacking(message):
            raise OutputError(
                f"{spec.name}.{port} emitted {message.SCHEMA} without {' and '.join(missing)}: {given_by} is no "
                f"firing that has them; give {', '.join(f'{name}=...' for name in missing)}"
            )


def _frame(spec: OperatorSpec, firing: Firing, port: str, message: Message) -> str:
    anchors: dict[str, Message] = {}
    for trigger in spec.triggers:
        anchors |= {e.stream or trigger.name: e.value for e in entries_of(firing.inputs.get(trigger.name))}
        if anchors and not spec.merge:
            break
    frames = {name: getattr(anchor, "frame", None) for name, anchor in anchors.items()}
    found = set(frames.values())
    if len(found) == 1 and isinstance(frame := found.pop(), str):
        return frame
    if not anchors:
        why = "finish() has no anchor" if firing.kind == "finish" else "no message triggered the firing, but a tick"
    elif len(anchors) == 1:
        (anchor,) = anchors.values()
        why = f"the anchor, a {anchor.SCHEMA}, has none"
    else:
        why = "the messages that triggered it differ: " + ", ".join(f"{n} {frame!r}" for n, frame in frames.items())
    raise OutputError(f"{spec.name}.{port} emitted {message.SCHEMA} without frame, and {why}; give frame=...")
