"""Goes to any call of one operator of a recorded run, forwards and back.

Forwards the re-execution goes on; back it begins again, from a state that was taken on the way or is recorded.
"""

from __future__ import annotations

import bisect
import pdb
from bdb import BdbQuit
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate
from types import CodeType

from dataflow.debugging.fired import Call, Fired, Made, Probe, Process, Through, call_of
from dataflow.debugging.sources import Sources
from dataflow.execution.failure import readable
from dataflow.graph.model import Graph
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.recording.streams.diff import differences
from dataflow.records.cuts import Taken, cut_record
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.records.window import records_from
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.reexecution.recorded_run import ReplayError, graph_that_is_here, recorded_message
from dataflow.sync import Firing

AHEAD = 60 * 10**9
"""Span (ns) behind a call that is gone to in which records are read: those that follow are gone to as well."""
NEAR = 16
"""Calls to a state further on, beyond which an operator is set up anew and begins there."""
MOST_BYTES = 2**28
"""Of the states that are kept; beyond it every other one is let go."""


class DebugError(ReplayError):
    """Raised for a call that cannot be gone to; the message has the reason, and what there is."""


class Debugger:
    """One operator of a recorded run. `calls` are its recorded calls, in order; `at` is the one that was made last.
    `live_effects`: a call outside that is not recorded is made.

    Runs the operator in this process, which should have the environment of operators (`threads.environment`): what
    depends on the hashes of strings else repeats only by chance. Raises `DebugError`, `ReplayError`, `RecordingError`,
    `GraphError`.
    """

    def __init__(
        self, recording: Recording, operator: str, graph: Graph | None = None, *, live_effects: bool = False
    ) -> None:
        self._recording, self._live_effects = recording, live_effects
        self.graph = graph_that_is_here(recording)[0] if graph is None else graph
        log = FiringLog.read(recording)
        self.node = node = self.graph.nodes[_named(operator, self.graph, log)]
        headings = log.headings(node)
        self.calls: Sequence[Call] = [Call(*heading) for heading in headings if heading.kind in CALLS]
        made = accumulate(heading.kind in CALLS for heading in headings)
        self._recorded = [n for n, heading in zip(made, headings, strict=True) if heading.kind == "snapshot"]
        """The numbers of the calls in front of which a state is recorded, in order."""
        self._feeding = plan_feeding(recording, self.graph, [node.name])
        self._kept: dict[int, FiringRecord] = {}
        """States before calls, by the call's number, as `cut` records."""
        self._sources = Sources(node.operator)
        self._work: Recomputation | None = None
        self._bounded = False
        """True while only the records up to some time behind a call are read."""
        self._probe: Probe | None = None
        self._reached = -1
        self._same = True
        """True when the last call gave what was recorded."""
        self.at: Fired | None = None

    # ------------------------------------------------------------------------------------------------- going

    def goto(self, number: int) -> Fired:
        """Makes the call of that number, counted from 0 (from the end if negative), and those that it needs before.

        Raises `DebugError` where there is none, or where it cannot be made again; `OperatorFailure`.
        """
        number = range(len(self.calls))[number] if -len(self.calls) <= number < len(self.calls) else number
        if not 0 <= number < len(self.calls):
            raise DebugError(f"{self.node.name} has calls 0 to {len(self.calls) - 1}, there is no {number}")
        state = number if self.node.operator.stateless else max(self._nearest_kept(number), self._nearest(number))
        if self._work is None or number <= self._reached or state > self._reached + NEAR:
            self._begin(number, self.calls[number].stamp + AHEAD)
        if self._reach(number) != number and self._bounded:
            self._begin(number)
            self._reach(number)
        if self._reached != number:
            raise DebugError(self._unreached(number))
        self.at = self._fired()
        return self.at

    def _reach(self, number: int) -> int:
        """Goes on to a call; returns the number of the one that was made last."""
        assert self._probe is not None
        self._probe.target = self.calls[number]
        for reached in self._onwards():
            if reached >= number:
                break
        return self._reached

    def _nearest_kept(self, number: int) -> int:
        """The number of the call at or before `number` in front of which a state is kept; -1 where none is."""
        return max((n for n in self._kept if n <= number), default=-1)

    def _nearest(self, number: int) -> int:
        """The same, in front of which a state is recorded."""
        place = bisect.bisect_right(self._recorded, number)
        return self._recorded[place - 1] if place else -1

    def number_at(self, stamp: int) -> int:
        """The number of the last call at or before a stamp (ns), of the first one where there is none.

        Where the clock went back, of the last incarnation that has such a call.
        """
        for number in range(len(self.calls) - 1, -1, -1):
            if self.calls[number].stamp <= stamp:
                return number
        return 0

    def until(self, condition: Callable[[Fired], bool]) -> Fired | None:
        """Goes on to the next call for which `condition` is true; None where none is: then `at` stays."""
        after = -1 if self.at is None else self.at.number
        if after + 1 == len(self.calls):
            return None
        if self._work is None or self._bounded:
            self._begin(after + 1)
        for reached in self._onwards():
            if reached > after and condition(self._fired()):
                return self.goto(reached)
        self._leave()
        return None

    def first_difference(self) -> Fired | None:
        """Goes to the first call of all whose outputs or error are not the recorded ones."""
        self._leave()
        self.at = None
        return self.until(lambda fired: not fired.same)

    # ------------------------------------------------------------------------------------------------- again

    def again(self, through: Through | None = None) -> Fired:
        """Makes the call where we are once more, from the same state; `through` makes the call, if given.

        Raises `DebugError` where there is no call yet.
        """
        if self.at is None:
            raise DebugError("no call was made yet: goto one")
        self._begin(self.at.number, self.at.call.stamp + AHEAD)
        assert self._probe is not None
        self._probe.through = through
        try:
            return self.goto(self.at.number)
        finally:
            self._probe.through = None

    def step_into(self) -> Fired:
        """Makes the call once more under pdb, which stops at the first line of `process()` (`finish()`)."""
        name = "finish" if self.at is not None and self.at.call.kind == "finish" else "process"
        code = getattr(self.node.operator, name).__code__
        debugger = pdb.Pdb(nosigint=True)
        debugger.set_break(code.co_filename, _first_line(code), temporary=True)
        debugger.rcLines = ["continue"]

        def through(process: Process, firing: Firing) -> dict[str, Message]:
            made = debugger.runcall(process, firing)
            if made is None:
                raise BdbQuit
            return made

        fired = self.again(through)
        if self._probe is not None and isinstance(self._probe.raised, BdbQuit):
            return self.again()
        return fired

    def reload(self) -> Sequence[str]:
        """Takes over the modules whose source has changed; returns their names. The call where we are is not made
        again. Raises `DebugError` for source that does not compile or has no such operator any more."""
        try:
            changed = self._sources.reload()
        except Exception as error:
            raise DebugError(f"the changed source cannot be used, the old one is: {readable(error)}") from error
        if changed:
            self._kept = {n: r for n, r in self._kept.items() if self.at is not None and n == self.at.number}
            self._leave()
        return changed

    def close(self) -> None:
        """Closes the operator."""
        self._leave()

    # ------------------------------------------------------------------------------------------------- inside

    def _begin(self, number: int, end: int | None = None) -> None:
        """Sets the operator up for a call that lies behind the nearest state in front of it. `end`: the stamp (ns) up
        to which records are read."""
        self._leave()
        call = self.calls[number]
        stateless = self.node.operator.stateless
        kept = self._nearest_kept(number)
        begin: int | None = call.stamp if stateless else call.stamp - 1
        if any(c.stamp >= call.stamp for c in self.calls[:number]):
            begin = None  # stamps went back: they do not show where it is
        cut = self._kept[kept] if kept >= max(0, self._nearest(number)) and not stateless else None
        if cut is not None:
            begin = cut.stamp
        self._bounded = begin is not None and end is not None
        self._start(begin, cut, end)

    def _start(self, begin: int | None, cut: FiringRecord | None, end: int | None) -> None:
        log = FiringLog.read(self._recording) if begin is None or end is None else self._window(begin, cut, end)
        log.resumed = cut
        work = Recomputation(
            self._recording,
            self.graph,
            self._feeding,
            log,
            made=lambda stream, entry: None,
            begin=begin,
            live_effects=self._live_effects,
        )
        runner = work.runners[self.node.name]
        self._probe = runner.calls = Probe(runner)
        self._work, self._reached = work, -1
        try:
            work.begin()
        except BaseException:
            self._leave()
            raise

    def _window(self, begin: int, cut: FiringRecord | None, end: int) -> FiringLog:
        """The records from a stamp to another, and those that these need."""
        nodes = self.graph.nodes
        again = {name: nodes[name] for name in self._feeding.operators}
        taken = {stream for node in again.values() for stream in node.taken}
        makers = again | {name: nodes[name] for name in sorted(self.graph.streams[s].node for s in taken)}
        given = set() if cut is None else {cut.operator}
        stateful = {n for n, node in again.items() if not node.operator.stateless} - given
        stateless = again.keys() - stateful
        return records_from(self._recording, makers.values(), begin, stateless=stateless, stateful=stateful, end=end)

    def _onwards(self) -> Iterator[int]:
        """Makes one call after the other; yields their numbers."""
        assert self._work is not None
        assert self._probe is not None
        runner, probe = self._work.runners[self.node.name], self._probe
        result = runner.result
        done, differing = result.verified, result.differing - result.states
        while self._work.turn():
            if result.verified == done:
                continue
            done = result.verified
            self._same = result.differing - result.states == differing
            differing = result.differing - result.states
            if isinstance(probe.raised, KeyboardInterrupt):
                self._leave()
                raise KeyboardInterrupt
            self._reached = self._number(call_of(runner.record))
            self._keep()
            yield self._reached

    def _number(self, call: Call) -> int:
        return bisect.bisect_left(self.calls, (call.incarnation, call.record), key=lambda c: (c.incarnation, c.record))

    def _keep(self) -> None:
        """Keeps the state before the last call, if it was taken."""
        assert self._probe is not None
        assert self._work is not None
        call, state = self._probe.call, self._probe.before
        if call is None or state is None or call != self.calls[self._reached]:
            return
        runner = self._work.runners[self.node.name]
        place = FiringRecord(self.node.name, call.incarnation, call.record - 1, "fire", call.stamp - 1)
        taken = Taken(again=False, at_setup={}, since=dict(runner.changed), state=state)
        self._kept[self._reached] = cut_record(place, left_out=0, taken=taken, held=(), stamp=place.stamp)
        if sum(len(record.detail["state"]) for record in self._kept.values()) > MOST_BYTES:
            for number in sorted(self._kept)[1:-1:2]:
                del self._kept[number]

    def _fired(self) -> Fired:
        assert self._work is not None
        assert self._probe is not None
        record, probe = self._work.runners[self.node.name].record, self._probe
        assert record is not None
        call = call_of(record)
        injected = bool(record.detail.get("injected"))
        recorded = record.detail.get("error", "") if record.outcome == "error" else None
        error = None if injected else probe.error
        made = tuple(self._made(record, {} if injected else probe.outputs))
        return Fired(
            number=self._reached,
            call=call,
            inputs={} if injected else probe.inputs,
            made=made,
            before=None if injected else probe.before,
            after=None if injected else probe.after,
            error=error,
            recorded_error=recorded,
            injected=injected,
            record=record,
            firing=None if injected else probe.firing,
            raised=None if injected else probe.raised,
            ports=tuple(self.node.outputs),
            same=self._same,
        )

    def _made(self, record: FiringRecord, outputs: Mapping[str, Message]) -> Iterator[Made]:
        ports = self.node.outputs
        emissions = record.outputs or (None,) * len(ports)
        for (port, stream), emission in zip(ports.items(), emissions, strict=True):
            here = outputs.get(port)
            if here is None and emission is None:
                continue
            if here is not None and emission is not None and here.digest() == emission.digest:
                yield Made(port, stream, same=True, here=here, recorded=here)
                continue
            then = None
            if emission is not None:
                place = record.incarnation, emission.seq
                then = recorded_message(self._recording, stream, place, emission.stamp)
            fields = () if here is None or then is None else tuple(differences(then, here, None)[0])
            yield Made(port, stream, same=False, here=here, recorded=then, fields=fields)

    def _unreached(self, number: int) -> str:
        assert self._work is not None
        result = self._work.runners[self.node.name].result
        why = f"{result.missing} is not recorded" if result.missing else "records before it are missing"
        return f"call {number} of {self.node.name} cannot be made again: {why}"

    def _leave(self) -> None:
        if self._work is not None:
            self._work.close()
        self._work, self._reached = None, -1


def _first_line(code: CodeType) -> int:
    """The line of the first statement of a function."""
    return min(line for _, _, line in code.co_lines() if line is not None and line > code.co_firstlineno)


def _named(operator: str, graph: Graph, log: FiringLog) -> str:
    """The operator of that name, or the only one whose name ends with it. Raises `DebugError`."""
    there = sorted(n for n in graph.nodes.keys() & set(log.operators) if graph.nodes[n].taken)
    found = [name for name in there if name == operator] or [n for n in there if n.endswith(f"/{operator}")]
    if len(found) == 1:
        return found[0]
    if operator in graph.nodes and graph.nodes[operator].source:
        raise DebugError(f"{operator!r} is a source: what its device gave is recorded, not made again")
    what = f"{operator!r} is several operators" if found else f"no calls of {operator!r} are recorded"
    raise DebugError(f"{what}; there are: {', '.join(found or there)}")
