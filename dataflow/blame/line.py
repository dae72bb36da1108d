"""The recorded calls of one operator, made again with other inputs."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Mapping
from typing import NamedTuple

from dataflow.capture.capture import changes_between, shot_of
from dataflow.capture.captured import CapturedCall, make_change, set_up
from dataflow.debugging.debugger import Debugger
from dataflow.debugging.fired import RepeatedCall
from dataflow.execution.calls import Calls
from dataflow.execution.effects.journal import RecordedJournal
from dataflow.execution.failure import RAISED, readable
from dataflow.execution.restarts import close_quietly
from dataflow.graph.model import Graph
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.records.cuts import is_known, parameters_at
from dataflow.records.firing import CALLS
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import seeding_of
from dataflow.sync import Firing
from dataflow.sync.entries import entries_of

MOST_BYTES = 2**28
"""Of the states that are kept of one operator."""
AHEAD = 100_000_000
"""Duration (ns) of calls before those that are asked for, that are read with them."""


class Call(NamedTuple):
    """A call: the operator, and the number of the call among the operator's, as `debug` counts them."""

    operator: str
    number: int


class Line:
    """The calls of one operator. `shots`: those whose inputs are held, by number, from `first` on without a gap.

    Raises as `Debugger`.
    """

    def __init__(
        self, recording: Recording, graph: Graph, operator: str, made: Callable[[], None], read: Callable[[int], None]
    ) -> None:
        """`made` is called before each call that is made again, `read` with the bytes of the inputs of each that is
        read."""
        self._debugger = Debugger(recording, operator, graph, most_bytes=0)  # `shots` holds what is needed
        self.node = node = self._debugger.node
        records = list(FiringLog.read(recording).ordered(node))
        self.records = [record for record in records if record.kind in CALLS]
        self._changes = [r for r in records if r.kind not in CALLS and r.outcome != "error"]
        self._changes_parameters = any(r.kind == "param" for r in self._changes)
        setups = sorted((r.incarnation, r.index) for r in self._changes if r.kind in ("setup", "cut"))
        places = [(r.incarnation, r.index) for r in self.records]
        before = [bisect.bisect_left(setups, place) for place in places]
        self._begins = [bisect.bisect_left(places, setups[k - 1]) if k else 0 for k in before]
        given = [r for r in self._changes if r.kind in ("restore", "cut") and is_known(r)]
        self._with_states = {bisect.bisect_left(places, (r.incarnation, r.index)) for r in given}
        self.other: int | None = None
        """The first call that was read and is not what was recorded."""
        self.shots: dict[int, CapturedCall] = {}
        self.first = len(self.records)
        self.nbytes = 0
        """Of these inputs; a message that several calls take counts each time."""
        self._read: set[int] = set()
        self._states: dict[int, bytes] = {}
        """States before calls."""
        self._as_new: dict[int, bool] = {}
        """By call, whether the state before it is that of a new operator."""
        self._graph, self._seeding, self._made, self._was_read = graph, seeding_of(recording), made, read
        self._journal = RecordedJournal()
        self.error = ""
        """The error of the last call that raised."""
        self._calls: Calls | None = None
        self._at = -1
        """The number of the call that `_calls` is just before, as it was then; -1: it was given other inputs."""

    @property
    def stateless(self) -> bool:
        """Returns whether the operator declares that it has no state."""
        return self.node.operator.stateless

    def close(self) -> None:
        """Closes the operator."""
        self.leave()
        self._debugger.close()

    def begin_of(self, number: int) -> int:
        """The number of the first call behind the operator's last `setup()` before a call."""
        return self._begins[number]

    def begins_with_state(self, number: int) -> bool:
        """Returns whether the operator was given a state before a call: it was reloaded, or began in the middle."""
        return number in self._with_states

    def emitted(self, stream: str, place: tuple[int, int]) -> int | None:
        """The number of the call that emitted a message (incarnation, number); None where it was no call."""
        port = list(self.node.outputs.values()).index(stream)
        for number, record in enumerate(self.records):
            made = record.outputs[port] if port < len(record.outputs) else None
            if made is not None and (record.incarnation, made.seq) == place:
                return number
        return None

    def reach(self, first: int, last: int) -> list[int]:
        """Reads the inputs of the calls from `first` to `last`; returns the numbers of those that were not held."""
        if self._read.issuperset(range(first, last + 1)):
            return []
        if not self.stateless and first < (begin := self.begin_of(last)):
            return self.reach(begin, last) + self.reach(first, begin - 1)
        first, until = self._ahead(first), last
        while until in self._read:
            until -= 1
        fired = self._debugger.goto(first)
        if fired.before is None and not self.stateless and first > (begin := self.begin_of(first)):
            return self.reach(begin, last)
        place = self.records[first].incarnation, self.records[first].index
        changes = changes_between(self._changes, self._debugger, place, until)
        read: set[int] = set()
        added: dict[int, CapturedCall] = {}
        nbytes = 0

        def take(each: RepeatedCall) -> bool:
            nonlocal nbytes
            if each.number <= until:
                read.add(each.number)
                if not each.same:
                    self.other = each.number if self.other is None else min(self.other, each.number)
            if each.number <= until and each.firing is not None and each.number not in self.shots:
                added[each.number] = shot_of(self._debugger, each, tuple(changes.get(each.number, ())))
                inputs = each.firing.inputs.values()
                nbytes += sum(entry.value.nbytes() for given in inputs for entry in entries_of(given))
                self._was_read(nbytes)
            return each.number >= until

        if not take(fired):
            self._debugger.until(take)
        self._read |= read
        self.shots |= added
        self.nbytes += nbytes
        if fired.before is not None:
            self._states[first] = fired.before
        self.first = first if self.stateless else min(first, self.first)
        return list(added)

    def _ahead(self, first: int) -> int:
        """The number of a call before one, from which on they are read, too: going back begins anew each time."""
        begin, left = self.begin_of(first), AHEAD
        while first > begin and first - 1 not in self._read and (left := left - self.records[first - 1].duration) > 0:
            first -= 1
        return first

    def begin(self, number: int, *, anew: bool = False) -> None:
        """Brings the operator to just before a call, as it was then; `anew`: into the state of a new one.

        Raises `OperatorFailure`, and what the operator raises.
        """
        is_there = self._at == number or (self.stateless and not self._changes_parameters)
        if self._calls is not None and not anew and is_there:
            return
        alone = anew or self.stateless
        begin = max(self.first, self.begin_of(number))
        near = number if alone else max((n for n in self._states if begin <= n <= number), default=begin)
        self._set_up(near)
        if not anew and near in self._states:
            assert self._calls is not None
            self._calls.restore(self._states[near], (self.records[near].incarnation, self.records[near].stamp - 1))
        self._at = near
        self._pass(near, number)
        self._at = -1 if anew else number
        self._keep(number)

    def is_as_new(self, number: int) -> bool:
        """Returns whether the state before a call is that of a new operator; False where the operator gives none."""
        if number not in self._as_new:
            self._as_new[number] = self.has_forgotten(number, number)
        return self._as_new[number]

    def has_forgotten(self, begin: int, number: int) -> bool:
        """Returns whether an operator that is new before the call `begin` has the recorded state before `number`; False
        where the operator gives none."""
        self.begin(begin, anew=True)
        self._pass(begin, number)
        new = self._state(number)
        self.begin(number)
        return new is not None and self._state(number) == new

    def returned_by(self, number: int) -> int | None:
        """The last of the calls before one, all held, that has brought another state back to that of a new operator."""
        return next((n for n in range(number - 1, self.begin_of(number) - 1, -1) if not self._was_new(n)), None)

    def _was_new(self, number: int) -> bool:
        """`is_as_new` of a call whose inputs are held, found for all calls up to it at once."""
        if number not in self._as_new:
            first = self.begin_of(number)
            self.begin(first, anew=True)
            new = self._state(first)
            self.begin(first)
            for passed in range(first, number + 1):
                self._as_new[passed] = self._state(passed) == new
                self._pass(passed, passed + 1)
        return self._as_new[number]

    def _pass(self, first: int, end: int) -> None:
        """Makes the held calls from one to before another as they were."""
        for number in range(first, end):
            if number in self.shots:
                self.fire(number, self.shots[number].firing)

    def _state(self, number: int) -> bytes | None:
        """The state of the operator, just before a call."""
        assert self._calls is not None
        return self._calls.snapshot((self.records[number].incarnation, self.records[number].stamp - 1))

    def _set_up(self, number: int) -> None:
        """Makes a new operator, with the parameters as they were before a call."""
        self.leave()
        record, node = self.records[number], self.node
        place = record.incarnation, record.index
        at_setup, since = parameters_at(r for r in self._changes if (r.incarnation, r.index) < place)
        self._calls = calls = Calls(node, node.make(), self._graph.seed, version=self._seeding, effects=self._journal)
        set_up(calls, at_setup, since)

    def fire(self, number: int, firing: Firing, *, other: bool = False) -> Mapping[str, Message] | None:
        """Makes a call, with the recorded inputs or `other` ones, and the changes behind it; returns its messages by
        port, None where it raises. The operator was brought there by `begin` and what followed."""
        assert self._calls is not None
        self._made()
        self._journal.begin(self.shots[number].effects)
        as_recorded = self._at == number and not other
        try:
            return self._calls.process(firing)
        except KeyboardInterrupt:
            raise
        except RAISED as error:
            self.error = readable(error)
            return None
        finally:
            self._go_on(number + 1)
            self._at = number + 1 if as_recorded else -1

    def skip(self, number: int) -> None:
        """Leaves a call out, but for the changes behind it."""
        self._go_on(number + 1)
        self._at = -1

    def _go_on(self, number: int) -> None:
        assert self._calls is not None
        for change in self.shots[number].changes if number in self.shots else ():
            make_change(self._calls, change)

    def _keep(self, number: int) -> None:
        if self.stateless or self._at != number or number in self._states or self._calls is None:
            return
        state = self._state(number)
        if state is not None and sum(map(len, self._states.values())) + len(state) <= MOST_BYTES:
            self._states[number] = state

    def leave(self) -> None:
        """Closes the operator that the calls are made with."""
        if self._calls is not None:
            close_quietly(self._calls.operator)
        self._calls, self._at = None, -1
