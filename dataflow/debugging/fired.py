"""A recorded call that was made again, with everything that can be seen of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from types import SimpleNamespace
from typing import Any, NamedTuple

from dataflow.execution.calls import Calls
from dataflow.execution.failure import RAISED
from dataflow.execution.recorded import RecordedRunner
from dataflow.execution.snapshots import changed_places, unpack_state
from dataflow.messages.base import Message
from dataflow.recording.streams.diff import FieldDifference
from dataflow.records.firing import FiringRecord
from dataflow.state import seen
from dataflow.sync import Firing

States = tuple[bytes | None, bytes | None]
"""The packed state before and after a call; None where the operator gives none."""


class Call(NamedTuple):
    """A recorded call of an operator: `record` is the number of its record in its incarnation; `stamp` in ns."""

    incarnation: int
    record: int
    kind: str
    stamp: int

    def follows(self, other: Call) -> bool:
        """Returns whether nothing was recorded between another call and this one."""
        return (self.incarnation, self.record) == (other.incarnation, other.record + 1)


@dataclass(frozen=True, slots=True)
class RepeatedOutput:
    """Holds what came out of one port: now (`here`), and in the recorded run. `fields` differ."""

    port: str
    stream: str
    same: bool
    here: Message | None
    recorded: Message | None
    fields: tuple[FieldDifference, ...] = ()


@dataclass(frozen=True, slots=True)
class RepeatedCall:
    """A call that was made again. `number` counts the operator's calls from 0.

    `inputs`: by name what `process()` was given, a message, None, a tuple, or a dict by stream. `packed` gives the
    states, for which it makes a call again that was only passed by. `error` is the traceback of what it raised now,
    `recorded_error` the text of then. `injected`: the run tried out a fault there, and did not call the operator.
    """

    number: int
    call: Call
    inputs: Mapping[str, Any]
    made: tuple[RepeatedOutput, ...]
    packed: Callable[[], States]
    error: str | None
    recorded_error: str | None
    injected: bool
    record: FiringRecord
    firing: Firing | None
    """The call as it was made; None where none was."""
    raised: BaseException | None
    ports: Sequence[str]
    """All that the operator declares for its outputs."""
    same: bool
    """Outputs and the error are the recorded ones, as verification compares them."""
    takes: Sequence[str] = ()
    """All that the operator declares for its inputs."""
    kept: type | None = None
    """The dataclass that it declares for its state."""

    @property
    def outputs(self) -> Mapping[str, Message | None]:
        """Returns what came out now, by port."""
        return {made.port: made.here for made in self.made}

    @property
    def before(self) -> bytes | None:
        """Returns the packed state before the call."""
        return self.packed()[0]

    @property
    def after(self) -> bytes | None:
        """Returns the packed state after the call."""
        return self.packed()[1]

    def states(self) -> tuple[Mapping[str, Any] | None, Mapping[str, Any] | None]:
        """Returns the state before and after, by field: its collections are those that the operator declares; None
        where it gives none."""
        before, after = (None if state is None else seen(self.kept, state) for state in self._unpacked())
        return before, after

    def changes(self) -> Iterator[tuple[str, Any, Any]]:
        """Yields what the call changed in the state: the place ("motion.speed"), the value before, and after."""
        states = self.states()
        for place in self._changed_places():
            before, after = (reduce(_part, place, state) for state in states)
            yield ".".join(place), before, after

    def changed(self) -> tuple[str, ...]:
        """Names of the parts of the state that the call changed."""
        return tuple(dict.fromkeys(place[0] for place in self._changed_places()))

    def _changed_places(self) -> Iterator[tuple[str, ...]]:
        before, after = self._unpacked()
        return changed_places(before or {}, after or {})

    def _unpacked(self) -> tuple[Mapping[str, Any] | None, Mapping[str, Any] | None]:
        before, after = (None if state is None else unpack_state(state) for state in self.packed())
        return before, after

    def names(self) -> dict[str, Any]:
        """Names for an expression about the call: `inp` and `out` by input and port (None where it is silent, as inputs
        at `finish()` are), `stamp`, `number`, `same`, `error`."""
        return {
            "inp": SimpleNamespace(**dict.fromkeys(self.takes) | dict(self.inputs)),
            "out": SimpleNamespace(**dict.fromkeys(self.ports) | dict(self.outputs)),
            "stamp": self.call.stamp,
            "number": self.number,
            "same": self.same,
            "error": self.error,
        }

    def names_then(self) -> dict[str, Any]:
        """Names for an expression about the call as it was recorded; an output that was not stored is None."""
        then = {made.port: made.recorded for made in self.made}
        out = SimpleNamespace(**dict.fromkeys(self.ports) | then)
        return self.names() | {"out": out, "same": True, "error": self.recorded_error}

    def lacks_for(self, error: BaseException) -> bool:
        """Returns whether an error of an expression comes of an input or an output that has nothing in this call: of
        None as if it were a message, or of the first, the last or the largest of no messages."""
        given = dict.fromkeys(self.takes) | dict(self.inputs)
        made = dict.fromkeys(self.ports) | dict(self.outputs)
        values = [*given.values(), *made.values()]
        if isinstance(error, AttributeError | TypeError):
            return "'NoneType'" in str(error) and any(value is None for value in values)
        empty = any(isinstance(value, tuple | Mapping) and not value for value in values)
        return isinstance(error, LookupError | ValueError) and empty

    def as_json(self, operator: str, origin: int) -> dict[str, Any]:
        """Returns the call of an operator as JSON values; the stamps of messages are counted from `origin` (ns)."""
        return {
            "operator": operator,
            "number": self.number,
            **self.call._asdict(),
            "same": self.same,
            "injected": self.injected,
            "inputs": {name: described(value, origin) for name, value in self.inputs.items()},
            "outputs": {m.port: {"same": m.same, "fields": [f.as_json() for f in m.fields]} for m in self.made},
            "changed": self.changed(),
            "error": self.error,
            "recorded_error": self.recorded_error,
        }


def described(value: Any, origin: int) -> str:
    """Returns what an input or an output holds, in words; stamps are counted from `origin` (ns)."""
    match value:
        case None:
            return "nothing"
        case Message():
            return f"{value.SCHEMA} at {(value.stamp - origin) * 1e-9:.3f} s"
        case Mapping():
            return "; ".join(f"{name}: {described(message, origin)}" for name, message in value.items()) or "nothing"
        case _:
            last = f", the last {described(value[-1], origin)}" if value else ""
            return f"{len(value):,} message{'' if len(value) == 1 else 's'}{last}"


def _part(value: Any, name: str) -> Any:
    return value.get(name) if isinstance(value, Mapping) else None


SPACING = 250_000_000
"""ns of CPU time of an operator between two states that are taken on the way."""

Process = Callable[[Firing], dict[str, Message]]
Through = Callable[[Process, Firing], dict[str, Message]]
"""Makes a call in place of `Process`, such as under a debugger."""


class Abandoned(BaseException):
    """Raised by a `Through` in the middle of a call that is not to be made to its end."""


class Probe(Calls):
    """Calls an operator as re-execution does, and keeps what is seen of its last call.

    Takes the state before and after the call `target`, after each `SPACING` of work, and behind records that are no
    calls. `through` makes the call `target`, if it is set.
    """

    def __init__(self, runner: RecordedRunner) -> None:
        calls = runner.calls
        super().__init__(calls.node, calls.operator, calls.seed, version=calls.version, effects=calls.effects)
        self._runner = runner
        self._looked_at = 0
        self._after: tuple[Call, bytes | None] | None = None
        """The last call after which the state was taken, with that."""
        self.target: Call | None = None
        self.through: Through | None = None
        self.call: Call | None = None
        """The last call."""
        self.firing: Firing | None = None
        self.outputs: Mapping[str, Message] = {}
        self.before: bytes | None = None
        self.after: bytes | None = None
        self.raised: BaseException | None = None

    @property
    def aimed(self) -> bool:
        """Returns whether the last call was the target."""
        return self.call == self.target

    def process(self, firing: Firing) -> dict[str, Message]:
        """Makes the call. Raises what the operator raises."""
        previous, self.call = self.call, call_of(self._runner.record)
        self.firing, self.outputs, self.raised = firing, {}, None
        self.before = self.after = None
        looks = self._runner.work.cpu_ns - self._looked_at >= SPACING
        if self.aimed or looks or previous is None or not self.call.follows(previous):
            self._looked_at = self._runner.work.cpu_ns
            self.before = self._state_before(self.call, previous)
        try:
            through = self.through if self.aimed else None
            self.outputs = super().process(firing) if through is None else through(super().process, firing)
            return dict(self.outputs)
        except RAISED as error:
            self.raised = error
            raise
        finally:
            if self.aimed:
                self.after = self.snapshot((self.call.incarnation, self.call.stamp))
                self._after = self.call, self.after

    def _state_before(self, call: Call, previous: Call | None) -> bytes | None:
        if self._after is not None and self._after[0] == previous and call.follows(previous):
            return self._after[1]
        return self.snapshot((call.incarnation, call.stamp - 1))


def call_of(record: FiringRecord | None) -> Call:
    """The call of a record. There is one while a call is made."""
    assert record is not None
    return Call(record.incarnation, record.index, record.kind, record.stamp)
