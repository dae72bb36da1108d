"""A recorded call that was made again, with everything that can be seen of it."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

from dataflow.execution.calls import Calls, value_of
from dataflow.execution.failure import RAISED
from dataflow.execution.recorded import RecordedRunner
from dataflow.execution.snapshots import changes, unpack_state
from dataflow.messages.base import Message
from dataflow.recording.streams.diff import FieldDifference
from dataflow.records.firing import FiringRecord
from dataflow.sync import Firing


class Call(NamedTuple):
    """A recorded call of an operator: `record` is the number of its record in its incarnation; `stamp` in ns."""

    incarnation: int
    record: int
    kind: str
    stamp: int


@dataclass(frozen=True, slots=True)
class Made:
    """Holds what came out of one port: now (`here`), and in the recorded run. `fields` differ."""

    port: str
    stream: str
    same: bool
    here: Message | None
    recorded: Message | None
    fields: tuple[FieldDifference, ...] = ()


@dataclass(frozen=True, slots=True)
class Fired:
    """A call that was made again. `number` counts the operator's calls from 0.

    `inputs`: by name what `process()` was given, a message, None, a tuple, or a dict by stream. `before`, `after`: the
    packed state, None where the operator gives none. `error` is the traceback of what it raised now, `recorded_error`
    the text of then. `injected`: the run tried out a fault there, and did not call the operator.
    """

    number: int
    call: Call
    inputs: Mapping[str, Any]
    made: tuple[Made, ...]
    before: bytes | None
    after: bytes | None
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

    @property
    def outputs(self) -> Mapping[str, Message | None]:
        """Returns what came out now, by port."""
        return {made.port: made.here for made in self.made}

    def states(self) -> tuple[Mapping[str, Any] | None, Mapping[str, Any] | None]:
        """The state before and after, as `snapshot()` gives it."""
        before, after = (None if state is None else unpack_state(state) for state in (self.before, self.after))
        return before, after

    def changed(self) -> tuple[str, ...]:
        """Names of the parts of the state that the call changed."""
        before, after = (state or {} for state in self.states())
        return tuple(dict.fromkeys(place.partition(".")[0] for place, _, _ in changes(before, after)))

    def names(self) -> dict[str, Any]:
        """Names for an expression about the call: `inp` and `out` by input and port (None where it is silent),
        `stamp`, `number`, `same`, `error`."""
        return {
            "inp": SimpleNamespace(**self.inputs),
            "out": SimpleNamespace(**dict.fromkeys(self.ports) | dict(self.outputs)),
            "stamp": self.call.stamp,
            "number": self.number,
            "same": self.same,
            "error": self.error,
        }


SPACING = 250_000_000
"""ns of CPU time of an operator between two states that are taken on the way."""

Process = Callable[[Firing], dict[str, Message]]
Through = Callable[[Process, Firing], dict[str, Message]]
"""Makes a call in place of `Process`, such as under a debugger."""


class Probe(Calls):
    """Calls an operator as re-execution does, and keeps what is seen of its last call.

    Takes the state before and after the call `target`, and after each `SPACING` of work. `through` makes the call
    `target`, if it is set.
    """

    def __init__(self, runner: RecordedRunner) -> None:
        calls = runner.calls
        super().__init__(calls.node, calls.operator, calls.seed, version=calls.version, effects=calls.effects)
        self._runner = runner
        self._looked_at = 0
        self.target: Call | None = None
        self.through: Through | None = None
        self.call: Call | None = None
        """The last call."""
        self.firing: Firing | None = None
        self.inputs: Mapping[str, Any] = {}
        self.outputs: Mapping[str, Message] = {}
        self.before: bytes | None = None
        self.after: bytes | None = None
        self.error: str | None = None
        self.raised: BaseException | None = None

    def process(self, firing: Firing) -> dict[str, Message]:
        """Makes the call. Raises what the operator raises."""
        self.call = call = call_of(self._runner.record)
        self.firing = firing
        aimed = call == self.target
        looks = aimed or self._runner.work.cpu_ns - self._looked_at >= SPACING
        self.inputs = {name: value_of(given) for name, given in firing.inputs.items()}
        self.outputs, self.error, self.raised = {}, None, None
        self.before = self.after = None
        if looks:
            self._looked_at = self._runner.work.cpu_ns
            self.before = self.snapshot((call.incarnation, call.stamp - 1))
        try:
            through = self.through if aimed else None
            self.outputs = super().process(firing) if through is None else through(super().process, firing)
            return dict(self.outputs)
        except RAISED as error:
            self.error, self.raised = "".join(traceback.format_exception(error)), error
            raise
        finally:
            self.after = self.snapshot((call.incarnation, call.stamp)) if aimed else None


def call_of(record: FiringRecord | None) -> Call:
    """The call of a record. There is one while a call is made."""
    assert record is not None
    return Call(record.incarnation, record.index, record.kind, record.stamp)
