"""Goes to any call of one operator of a recorded run, forwards and back.

Forwards the re-execution goes on; back it begins again, from a state that was taken on the way or is recorded.
"""

from __future__ import annotations

import bisect
import pdb
import traceback
from bdb import BdbQuit
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from types import CodeType
from typing import Any

from dataflow.debugging.fired import (
    Abandoned,
    Call,
    Probe,
    Process,
    RepeatedCall,
    RepeatedOutput,
    States,
    Through,
    call_of,
)
from dataflow.debugging.ring import MOST_BYTES as MOST_HELD
from dataflow.debugging.ring import CachedCall, Ring
from dataflow.debugging.sources import Sources
from dataflow.execution.calls import value_of
from dataflow.execution.failure import RESTORE, OperatorFailure, readable
from dataflow.execution.feeds.playable import span_of
from dataflow.execution.ports import Emitter
from dataflow.execution.recorded import RecordedRunner
from dataflow.execution.threads import limit_threads
from dataflow.graph.model import Graph
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.recording.streams.diff import differences
from dataflow.records.cuts import ResumePoint, cut_record
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.records.repetition import Repetition, look_at
from dataflow.records.window import records_from
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.reexecution.recorded_run import ReplayError, graph_that_is_here, recorded_message, seeding_of
from dataflow.sync import Entry, Firing

AHEAD = 2 * 10**9
"""Span (ns) behind a call that is gone to in which records are read: those that follow are gone to as well."""
REACH = 3 * 10**9
"""Span (ns) before a call in which a state is looked for at first."""
NEAR = 16
"""Calls to a state further on, beyond which an operator is set up anew and begins there."""
MOST_BYTES = 2**28
"""Of the states that are kept; beyond it every other one is let go."""


class DebugError(ReplayError):
    """Raised for a call that cannot be gone to; the message has the reason, and what there is."""


@dataclass(frozen=True, slots=True)
class UnrepeatableCalls:
    """Calls that a search has passed by, as they cannot be made again: how many, the number of the first, and why."""

    count: int
    first: int
    why: str

    def __str__(self) -> str:
        calls = f"{self.count:,} call{'' if self.count == 1 else 's'}"
        return f"{calls} could not be made again (the first is call {self.first}: {self.why})"


class Debugger:
    """One operator of a recorded run. `calls` are its recorded calls, in order; `at` is the one that was made last.
    `make_effects`: a call outside that is not recorded is made. `most_bytes`: of the messages of calls that are kept.

    Runs the operator in this process, which should have the environment of operators (`threads.environment`): what
    depends on the hashes of strings else repeats only by chance. Raises `DebugError`, `ReplayError`, `RecordingError`,
    `GraphError`.
    """

    def __init__(
        self,
        recording: Recording,
        operator: str,
        graph: Graph | None = None,
        *,
        make_effects: bool = False,
        most_bytes: int = MOST_HELD,
    ) -> None:
        self._recording, self._make_effects = recording, make_effects
        self.graph = graph_that_is_here(recording)[0] if graph is None else graph
        log = FiringLog.read(recording)
        self.node = node = self.graph.nodes[_named(operator, self.graph, log)]
        headings = log.headings(node)
        self.calls: Sequence[Call] = [Call(*heading) for heading in headings if heading.kind in CALLS]
        made = accumulate(heading.kind in CALLS for heading in headings)
        self._snapshots = [n for n, heading in zip(made, headings, strict=True) if heading.kind == "snapshot"]
        self._recorded: Sequence[int] = self._snapshots
        """The numbers of the calls in front of which a state is recorded, in order."""
        self._feeding = plan_feeding(recording, self.graph, [node.name])
        self._fit = True
        """False once a state did not fit the class as it is now, which has other fields: then calls are made from the
        beginning."""
        self._kept: dict[int, FiringRecord] = {}
        """States before calls, by the call's number, as `cut` records."""
        self._sources = Sources(node.operator)
        self._work: Recomputation | None = None
        self._end: int | None = None
        """The stamp up to which records are read; None for all of them."""
        self._setup: FiringRecord | None = None
        """The record of the first `setup()`."""
        self._ring = Ring(most_bytes)
        self._probe: Probe | None = None
        self._reached = -1
        self.at: RepeatedCall | None = None
        self.unmade: UnrepeatableCalls | None = None
        """Calls that the last search (`until`, `first_difference`) has passed by; None where it made all on its way."""
        self.between: Callable[[], object] = lambda: None
        """Called behind each call that is made on the way to another; what it raises ends the way there."""

    # ------------------------------------------------------------------------------------------------- going

    def goto(
        self, number: int, through: Through | None = None, touched: Callable[[], bool] = lambda: True
    ) -> RepeatedCall:
        """Goes to the call of that number, counted from 0 (from the end if negative): makes it, and those that it needs
        before. One of the last calls that were made here is not made again, unless by `through`, which then makes it.
        `touched` returns whether `through` may have changed something by hand: then nothing goes on from that call.

        Raises `DebugError` where there is none, or where it cannot be made again; `OperatorFailure`.
        """
        number = self.number(number)
        held = self._ring.get(number)
        if held is None or held.stale or through is not None:
            held = self._made_again(number, through) or self._made_on_the_way(number, through)
            if through not in (None, _plainly) and touched():
                held.stale = True
                if self._reached == number:
                    self._leave()
        self.at = self._fired(held)
        return self.at

    def each(self, first: int, last: int, through: Through) -> Iterator[RepeatedCall]:
        """Makes the calls from one to another by `through`, one after the other. Raises as `goto` does."""
        for number in range(first, last + 1):
            held = self._made_again(number, through) if first == last else None
            yield self._fired(held or self._made_on_the_way(number, through))

    def begins(self, number: int) -> int:
        """The number of the last call at or before `number` that needs none before."""
        return number if self.node.operator.stateless else max(0, self._nearest_kept(number), self._nearest(number))

    def _made_on_the_way(self, number: int, through: Through | None) -> CachedCall:
        """Makes a call by the records before it, going on from the last one where that lies near."""
        state = number if self.node.operator.stateless else max(self._nearest_kept(number), self._nearest(number))
        stamp = self.calls[number].stamp
        behind = self._end is not None and stamp > self._end
        if self._work is None or behind or number <= self._reached or state > self._reached + NEAR:
            self._begin(number, stamp + AHEAD)
        if self._reach(number, through) != number and self._end is not None:
            self._begin(number)
            self._reach(number, through)
        held = self._ring.get(number)
        if self._reached != number or held is None:
            raise DebugError(f"call {number} of {self.node.name} cannot be made again: {self._why_not()}")
        if held.stale:
            self._leave()
        return held

    def _made_again(self, number: int, through: Through | None) -> CachedCall | None:
        """Makes a call from what is kept of it and of those before; None where that does not suffice."""
        stateless = self.node.operator.stateless
        way = self._ring.way_to(number, [number] if stateless else self._kept)
        if not way or self._setup is None:
            return None
        cut = self._cut(way[0].call, way[0].changed, None) if stateless else self._kept[way[0].number]
        records = [self._setup, cut, *(held.record for held in way)]
        repetition = Repetition(lambda: iter(records), begin=cut.stamp, stateless=stateless)
        look_at([repetition])
        limit_threads(self.graph.threads)
        runner = RecordedRunner(
            self.node,
            _Nowhere(),
            static=self.graph.static,
            repetition=repetition,
            inputs={},
            seed=self.graph.seed,
            seeding=seeding_of(self._recording),
            make_effects=self._make_effects,
        )
        probe = runner.calls = Probe(runner)
        probe.target, probe.through = way[-1].call, through
        try:
            if not self._sets_up(runner):
                return None
            entries = {(e.stream, e.incarnation, e.seq): e for held in way for e in held.entries()}
            for _, entry in sorted(entries.items()):
                runner.push(entry.stream, entry)
            counts = [0]
            while runner.step() and runner.record is not way[-1].record:
                counts.append(runner.result.differing - runner.result.states)
        finally:
            runner.close()
        if isinstance(probe.raised, KeyboardInterrupt):
            raise KeyboardInterrupt
        if runner.record is not way[-1].record:
            return None
        held = self._held(number, runner, same=runner.result.differing - runner.result.states == counts[-1])
        self._take(held, probe)
        return held

    def _sets_up(self, runner: RecordedRunner) -> bool:
        """Sets an operator up with a state that is kept; returns whether that fits its class."""
        try:
            runner.setup()
        except OperatorFailure as failure:
            if failure.when != RESTORE:
                raise
            self._misfits()
        return self._fit

    def _misfits(self) -> None:
        self._fit = False
        self._kept.clear()
        self._recorded = []

    def _reach(self, number: int, through: Through | None = None) -> int:
        """Goes on to a call; returns the number of the one that was made last."""
        assert self._probe is not None
        self._probe.target, self._probe.through = self.calls[number], through
        for held in self._onwards():
            if held.number >= number:
                break
            self.between()
        return self._reached

    def no_state(self) -> str:
        """Returns why an operator whose states are None has none to be shown."""
        if self.node.operator.stateless:
            return f"{self.node.name} has no state: it is declared stateless"
        return (
            f"{self.node.name} declares no state, so what it keeps in attributes is not seen: declare it "
            "(`state: State`, a dataclass), or give it by snapshot() and restore()"
        )

    @property
    def path(self) -> Path:
        """Returns the recording's file."""
        return self._recording.path

    @property
    def origin(self) -> int:
        """Returns the stamp (ns) of the recording's first message, from which seconds are counted."""
        return (span_of(self._recording, self._recording.streams) or (0, 0))[0]

    @property
    def reached(self) -> int:
        """Returns the number of the call that was made last on a way; -1 where none was."""
        return self._reached

    def _nearest_kept(self, number: int) -> int:
        """The number of the call at or before `number` in front of which a state is kept; -1 where none is."""
        return max((n for n in self._kept if n <= number), default=-1)

    def _nearest(self, number: int) -> int:
        """The same, in front of which a state is recorded."""
        place = bisect.bisect_right(self._recorded, number)
        return self._recorded[place - 1] if place else -1

    def number(self, number: int) -> int:
        """The number of a call counted from 0, of one that may be counted from the end. Raises `DebugError` where there
        is none."""
        count = len(self.calls)
        if not count:
            raise DebugError(f"{self.node.name} was not called in this recording")
        if not -count <= number < count:
            raise DebugError(f"{self.node.name} has calls 0 to {count - 1}, there is no {number}")
        return range(count)[number]

    def number_at(self, stamp: int) -> int:
        """The number of the last call at or before a stamp (ns). Raises `DebugError` where there is none.

        Where the clock went back, of the last incarnation that has such a call.
        """
        for number in range(len(self.calls) - 1, -1, -1):
            if self.calls[number].stamp <= stamp:
                return number
        later = (self.calls[self.number(0)].stamp - stamp) * 1e-9
        raise DebugError(f"{self.node.name} was not called by then: its first call is {later:.3f} s later")

    def until(
        self, condition: Callable[[RepeatedCall], bool], *, first: int | None = None, last: int | None = None
    ) -> RepeatedCall | None:
        """Goes on to the next call for which `condition` is true, of those from the number `first` (by default the one
        behind the call where we are) to `last`; None where none is: then `at` stays. `unmade` has those that it has
        passed by, of which nothing is known.
        """
        self.unmade = None
        number = first if first is not None else 0 if self.at is None else self.at.number + 1
        end = len(self.calls) - 1 if last is None else last
        while number <= end and (held := self._ring.get(number)) is not None and not held.stale:
            number += 1
            if self._goes_to(held, condition):
                return self.at
        if number > end:
            return None
        if self._work is None or self._end is not None or self._reached >= number:
            self._begin(number)
        for held in self._onwards():
            if held.number < number:
                continue
            self._pass_by(number, min(held.number, end + 1))
            number = held.number + 1
            if held.number > end:
                return None
            if self._goes_to(held, condition):
                return self.at
            if held.number == end:
                return None
        self._pass_by(number, end + 1)
        self._leave()
        return None

    def _pass_by(self, number: int, behind: int) -> None:
        """Notes that a search has made none of the calls from `number` to before `behind`."""
        if number < behind:
            was = self.unmade or UnrepeatableCalls(0, number, self._why_not())
            self.unmade = replace(was, count=was.count + behind - number)

    def _goes_to(self, held: CachedCall, condition: Callable[[RepeatedCall], bool]) -> bool:
        fired = self._fired(held)
        if found := condition(fired):
            self.at = fired
        return found

    def first_difference(self) -> RepeatedCall | None:
        """Goes to the first call of all whose outputs or error are not the recorded ones."""
        self._leave()
        self.at = None
        return self.until(lambda fired: not fired.same)

    # ------------------------------------------------------------------------------------------------- again

    def again(self, through: Through | None = None) -> RepeatedCall:
        """Makes the call where we are once more, from the same state; `through` makes the call, if given.

        Raises `DebugError` where there is no call yet.
        """
        if self.at is None:
            raise DebugError("no call was made yet: goto one")
        return self.goto(self.at.number, through or _plainly)

    def step_into(self) -> RepeatedCall:
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
        return self.again() if isinstance(fired.raised, BdbQuit) else fired

    def reload(self) -> Sequence[str]:
        """Takes over the modules whose source has changed; returns their names. The call where we are is not made
        again. Raises `DebugError` for source that does not compile or has no such operator any more."""
        if self.at is not None:
            self.at.packed()
        try:
            changed = self._sources.reload()
        except Exception as error:
            raise DebugError(f"the changed source cannot be used, the old one is: {readable(error)}") from error
        if changed:
            at = None if self.at is None else self.at.number
            self._kept = {n: r for n, r in self._kept.items() if n == at}
            self._ring.leave_only(at)
            self._fit, self._recorded = True, self._snapshots
            self._leave()
        return changed

    def close(self) -> None:
        """Closes the operator."""
        self._leave()

    # ------------------------------------------------------------------------------------------------- inside

    def _begin(self, number: int, end: int | None = None) -> None:
        """Sets the operator up for a call that lies behind the nearest state in front of it, or at the beginning where
        that state does not fit. `end`: the stamp (ns) up to which records are read."""
        try:
            self._begin_near(number, end)
        except OperatorFailure as failure:
            if failure.when != RESTORE or not self._fit:
                raise
            self._misfits()
            self._begin_near(number, None)

    def _begin_near(self, number: int, end: int | None) -> None:
        self._leave()
        call = self.calls[number]
        stateless = self.node.operator.stateless
        kept = self._nearest_kept(number)
        begin: int | None = call.stamp if stateless else call.stamp - 1
        if not self._fit or any(c.stamp >= call.stamp for c in self.calls[:number]):
            begin = None  # stamps went back: they do not show where it is
        cut = self._kept[kept] if kept >= max(0, self._nearest(number)) and not stateless else None
        if cut is not None:
            begin = cut.stamp
        self._end = None if begin is None else end
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
            make_effects=self._make_effects,
        )
        runner = work.runners[self.node.name]
        self._probe = runner.calls = Probe(runner)
        self._work, self._reached, self._setup = work, -1, runner.record
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
        return records_from(
            self._recording, makers.values(), begin, stateless=stateless, stateful=stateful, end=end, reach=REACH
        )

    def _onwards(self) -> Iterator[CachedCall]:
        """Makes one call after the other; yields them."""
        assert self._work is not None
        assert self._probe is not None
        runner, probe = self._work.runners[self.node.name], self._probe
        result = runner.result
        done, differing = result.verified, result.differing - result.states
        while self._work.turn():
            if result.verified == done:
                continue
            done = result.verified
            same = result.differing - result.states == differing
            differing = result.differing - result.states
            if isinstance(probe.raised, KeyboardInterrupt):
                self._leave()
                raise KeyboardInterrupt
            self._reached = self._number(call_of(runner.record))
            held = self._held(self._reached, runner, same=same)
            self._take(held, probe)
            yield held

    def _number(self, call: Call) -> int:
        return bisect.bisect_left(self.calls, (call.incarnation, call.record), key=lambda c: (c.incarnation, c.record))

    def _held(self, number: int, runner: RecordedRunner, *, same: bool) -> CachedCall:
        """The call that a runner has made just now."""
        record, probe = runner.record, runner.calls
        assert record is not None
        assert isinstance(probe, Probe)
        changed = dict(runner.changed)
        if record.detail.get("injected"):
            return CachedCall(number, record, None, {}, None, same, changed, (None, None))
        states = (probe.before, probe.after) if probe.aimed or self.node.operator.stateless else None
        if stale := isinstance(probe.raised, (BdbQuit, Abandoned)):
            probe.raised.__traceback__ = None
        return CachedCall(number, record, probe.firing, probe.outputs, probe.raised, same, changed, states, stale)

    def _take(self, held: CachedCall, probe: Probe) -> None:
        """Keeps a call, and the state before it, if that was taken."""
        self._ring.add(held)
        if held.firing is None or probe.before is None or probe.call != held.call:
            return
        self._kept[held.number] = self._cut(held.call, held.changed, probe.before)
        if sum(len(record.detail["state"]) for record in self._kept.values()) > MOST_BYTES:
            for number in sorted(self._kept)[1:-1:2]:
                del self._kept[number]

    def _cut(self, call: Call, changed: Mapping[str, Any], state: bytes | None) -> FiringRecord:
        """The record by which an operator begins in front of a call."""
        place = FiringRecord(self.node.name, call.incarnation, call.record - 1, "fire", call.stamp - 1)
        taken = ResumePoint(again=False, at_setup={}, since=changed, state=state)
        return cut_record(place, left_out=0, taken=taken, held=(), stamp=place.stamp)

    def _fired(self, held: CachedCall) -> RepeatedCall:
        record = held.record
        raised = held.raised
        return RepeatedCall(
            number=held.number,
            call=held.call,
            inputs={} if held.firing is None else {n: value_of(given) for n, given in held.firing.inputs.items()},
            made=tuple(self._made(record, held.outputs)),
            packed=partial(self._states, held),
            error=None if raised is None else "".join(traceback.format_exception(raised)),
            recorded_error=record.detail.get("error", "") if record.outcome == "error" else None,
            injected=held.firing is None,
            record=record,
            firing=held.firing,
            raised=raised,
            ports=tuple(self.node.outputs),
            same=held.same,
            takes=tuple(self.node.inputs),
            kept=self.node.operator.spec.state,
        )

    def _states(self, held: CachedCall) -> States:
        """The states before and after a call, which is made again if they were not taken."""
        if held.states is None:
            again = self._made_again(held.number, _plainly) or self._made_on_the_way(held.number, _plainly)
            held.states = again.states
        assert held.states is not None
        return held.states

    def _made(self, record: FiringRecord, outputs: Mapping[str, Message]) -> Iterator[RepeatedOutput]:
        ports = self.node.outputs
        emissions = record.outputs or (None,) * len(ports)
        for (port, stream), emission in zip(ports.items(), emissions, strict=True):
            here = outputs.get(port)
            if here is None and emission is None:
                continue
            if here is not None and emission is not None and here.digest() == emission.digest:
                yield RepeatedOutput(port, stream, same=True, here=here, recorded=here)
                continue
            then = None
            if emission is not None:
                place = record.incarnation, emission.seq
                then = recorded_message(self._recording, stream, place, emission.stamp)
            fields = () if here is None or then is None else tuple(differences(then, here, None)[0])
            yield RepeatedOutput(port, stream, same=False, here=here, recorded=then, fields=fields)

    def _why_not(self) -> str:
        """Returns why the calls behind the last one that was made cannot be."""
        assert self._work is not None
        result = self._work.runners[self.node.name].result
        if result.missing:
            return f"{result.missing} is not recorded"
        return "the state before it is not known" if result.unknown else "records before it are missing"

    def _leave(self) -> None:
        if self._work is not None:
            self._work.close()
        self._work, self._reached = None, -1


def _plainly(process: Process, firing: Firing) -> dict[str, Message]:
    """Makes a call as it is."""
    return process(firing)


class _Nowhere(Emitter):
    """Takes what an operator emits that is made again alone."""

    def message(self, stream: str, entry: Entry) -> None:
        """No operator is given it."""

    def frontier(self, stream: str, frontier: int) -> None:
        """No operator is given it."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """No operator is given it."""

    def record(self, record: FiringRecord) -> None:
        """It is made by a record."""


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
    if not there:
        raise DebugError(
            f"no calls of {operator!r} are recorded, nor of any other operator: the recording holds what sources gave. "
            "Replay it through a graph with operators (dataflow replay --graph GRAPH --record RUN.mcap), and debug that"
        )
    what = f"{operator!r} is several operators" if found else f"no calls of {operator!r} are recorded"
    raise DebugError(f"{what}; there are: {', '.join(found or there)}")
