"""Runs one operator in a live run, where time will not wait for it.

The aligner is the same as in a replay. In front of it stand bounded queues with the operator's declared policy, and a
clock that gives up waiting: when an input's `wait` has run out, its frontier is forced. All of this only changes which
messages reach which firing; the firing records say which, so a live run can be repeated exactly.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

from dataflow.execution.admission import (
    AdmissionQueue,
    Arrival,
    Clock,
    EventClock,
    EventTime,
    Frontier,
    WaitLimits,
    dropped,
)
from dataflow.execution.calls import Calls, interrupted_after
from dataflow.execution.failure import RAISED, RESTORE, OperatorFailure
from dataflow.execution.log import FiringLog, unlisted
from dataflow.execution.ports import Emitter
from dataflow.execution.protocol import Faults
from dataflow.execution.restarts import Restarts, close_quietly
from dataflow.execution.runner import MOST_TICKS, OperatorRunner
from dataflow.graph.code import ReloadedCode, ReloadError, code_now
from dataflow.graph.model import Node, OperatorImportError
from dataflow.operator import Operator, OperatorSpec
from dataflow.records.firing import MAX_STATE_BYTES
from dataflow.records.spacing import StateSpacing
from dataflow.sync import NEVER, Drop, DropLog, Entry, Firing, StreamOrderError
from dataflow.sync.single import make_aligner

MOST_TRIED = 256
"""Messages and waits that are over, none of which decides a firing, in one step. A timer that falls behind drops its
ticks one by one, while new ones come due: its process would never look at anything else."""

KEPT_STATE = "kept"
SET_UP_WITHIN = 30.0
"""Seconds for which an operator of new code may be set up: meanwhile its process does nothing else."""


class LiveRunner(OperatorRunner):
    """One operator in a live run. It outlives its failures as its restart policy allows.

    A failed operator is restarted after the back-off and goes on with what is then in its queues; its streams begin a
    new incarnation. `on_failure` is called for every failure that is outlived.
    """

    keeps_time = True

    def __init__(
        self,
        node: Node,
        emitter: Emitter,
        *,
        static: frozenset[str],
        seed: int = 0,
        paranoid: bool = False,
        operator: Operator | None = None,
        snapshots: StateSpacing | None = None,
        clock: Clock | None = None,
        event_clock: EventClock | None = None,
        on_failure: Callable[[OperatorFailure, float], None] = lambda failure, pause: None,
        faults: Faults | None = None,
    ) -> None:
        more: dict[str, Any] = {"paranoid": paranoid, "operator": operator, "snapshots": snapshots}
        super().__init__(node, emitter, static=static, seed=seed, lossy=True, **more)
        triggers = {
            stream: port.name
            for port in self.spec.triggers
            for stream in node.inputs.get(port.name, ())
            if stream not in static
        }
        self._log = DropLog()  # of what did not reach an aligner
        self.queue = AdmissionQueue(node.live.queue, node.live.size, triggers, self._log)
        clock = clock or time.monotonic
        self._time = EventTime(event_clock or time.time_ns)
        self.patience = WaitLimits(node.live.wait, clock, self._time.until)
        self.restarts = Restarts(node.live.restart, clock)
        self._timeouts: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._earlier_drops: Counter[tuple[str, str]] = Counter()
        self._earlier_late: Counter[str] = Counter()
        """Counts of the aligners before the present one: each jump of a clock begins with a new one."""
        self._static = static
        self._statics: dict[str, Entry] = {}
        self._on_failure, self.faults = on_failure, faults
        self._seen: dict[str, tuple[int, int]] = {}  # stream → incarnation, last stamp that the aligner was given
        self._jumped: dict[str, int] = {}  # producer → incarnation since its clock jumped back
        self._changed: dict[str, Any] = {}
        self._code = code_now(type(self.operator))
        """The code that it runs: a reload of another operator of the process changes what is imported, and not this."""
        self._told = True
        """True when the aligner may have something to decide: it received something since it had not."""

    # Counts

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        withheld = {(f"→ {port}", "non_monotonic"): n for port, n in self.ports.withheld.items()}
        return self._earlier_drops + Counter(self.aligner.drops) + self._log.counts + Counter(withheld)

    @property
    def timeouts(self) -> Mapping[str, int]:
        return self._timeouts

    @property
    def late(self) -> Mapping[str, int]:
        return self._earlier_late + Counter(self.aligner.late)

    @property
    def refused(self) -> Mapping[str, int]:
        return self._refused

    @property
    def restarted(self) -> int:
        return self.restarts.total

    def take_drops(self) -> tuple[list[Drop], Mapping[tuple[str, str], int]]:
        mine, more = self._log.take(), Counter(self._log.take_unlisted())
        theirs, others = super().take_drops()
        return [*mine, *theirs], more + Counter(others)

    def has_drops(self) -> bool:
        return bool(self._log.pending or self.aligner.dropped)

    # What streams say

    def push(self, stream: str, entry: Entry) -> None:
        if stream in self._static:
            self._statics[stream] = Entry(entry.stamp, entry.value, entry.seq, entry.incarnation, entry.digest, stream)
        elif self._jumped and entry.incarnation < self._jumped.get(_producer(stream), 0):
            self._log.add(dropped(self._input_of(stream), stream, entry, "reset"))  # of the time before the jump
            return
        else:
            stamp, incarnation = entry.stamp, entry.incarnation
            seen, last = self._seen.get(stream, (incarnation, NEVER))
            if incarnation > seen and stamp <= last and not self.ended:
                self._reset(stream, entry)
            self._seen[stream] = (incarnation, stamp)
            self._time.see(stamp)
        if self.restarts.pending:
            self.done = max(self.done, entry.stamp)  # an operator that is away is not waited for
        if not self.awake:
            self.wake()
        if stream in self.queue.triggers:
            self.queue.put(stream, entry)
        else:
            self._admit(stream, entry)

    def advance(self, stream: str, frontier: int) -> None:
        self._promised(stream, Frontier(frontier))

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self._promised(stream, Frontier(NEVER if final_stamp is None else final_stamp, True, reason))

    def _promised(self, stream: str, promise: Frontier) -> None:
        self.wake()
        if stream in self.queue.triggers:
            self.queue.promise(stream, promise)
        else:
            self._admit(stream, promise)

    # Work

    def step(self) -> bool:
        """One firing: of what is decided; else of what the queues hold; else of what has waited long enough. True also
        after `MOST_TRIED` of the latter without a firing: what has arrived meanwhile is to be looked at."""
        if self.restarts.pending:
            if self.restarts.due_in() > 0:
                return False
            self._start_again()
        self._told = self._told or self.node.every is not None  # ticks may be left out since
        for _ in range(MOST_TRIED):
            if self.ended or not (self._told or self._admit_next()):
                return False
            if self._decide():
                return True
        self.wake()
        return True

    def _admit_next(self) -> bool:
        """Passes the content of the queues to the aligner, or that it need not wait; False if neither applies."""
        taken = self.queue.take()
        if taken is None:
            return self._give_up()
        self._admit(*taken)
        return True

    def _decide(self) -> bool:
        """Makes the next firing if it is decided. Its own emissions and promises may come back and decide another one:
        `_told` is cleared before."""
        self._told = False
        if not super().step():
            return False
        self._told = self._told or self.idle == NEVER
        self._wake_again()
        return True

    def _wake_again(self) -> None:
        """Asks for another step, unless nothing is left that could be decided now or later."""
        if self._told or self.restarts.pending or self.queue.holds or self.aligner.waiting() is not None:
            self.wake()

    def _bound_ticks(self, period: int) -> None:
        """Of the ticks that came due while the operator was busy, only the newest are made up for, as many as its queue
        holds; without this a slow operator would fall behind for ever. One that drops nothing is spared only what no
        operator could make up for."""
        if self.queue.policy != "block":
            patience = max((wait for wait in self.node.live.wait.values() if wait is not None), default=0)
            self.aligner.skip_ticks(self._time.now() - patience - self.queue.size * period)
        number, _, last = self.aligner.owed_ticks()
        if number > MOST_TICKS:
            self.aligner.skip_ticks(last - (self.queue.size - 1) * period)

    def next_due(self) -> float | None:
        """Seconds until a decision need not wait any longer; None when nothing waits for the clock."""
        if self.restarts.pending:
            return self.restarts.due_in()
        held = None if self.ended else self.aligner.waiting()
        return None if held is None else self.patience.due_in(held.stamp, held.needs)

    def set_parameter(self, name: str, value: Any) -> Any:
        changed = super().set_parameter(name, value)
        self._changed[name] = value
        return changed

    def resume(self, incarnation: int, last: Mapping[str, int], changed: Mapping[str, Any]) -> None:
        self.records = FiringLog(self.node.name, self.ports.emitter, incarnation)
        self.ports.resume(incarnation, last)
        self._changed = dict(changed)
        self._change_again()

    def _fire(self, firing: Firing) -> None:
        if self.absent:
            firing = without_absent(firing, self.node, self.absent)
        try:
            if self.faults is not None and (error := self.faults.before(firing)) is not None:
                self._fail_on_purpose(firing, error)
            super()._fire(firing)
        except OperatorFailure as failure:
            if firing.kind == "finish" or not self.restarts.failed():
                raise
            self._on_failure(failure, self.restarts.due_in())

    def _fail_on_purpose(self, firing: Firing, error: BaseException) -> None:
        failure = OperatorFailure(self.node.name, f"{firing.kind} at stamp {firing.stamp}", error)
        self._record(firing.kind, firing, time.time_ns(), (), failure.summary, injected=True)
        raise failure

    def _start_again(self) -> None:
        """A fresh operator in the place of the failed one, with the parameters as they were last set."""
        self.restarts.begun()
        old, self.operator = self.operator, self._code.operator(**self.node.params)
        self.calls.operator = self.operator
        self._begin_incarnation()
        try:
            close_quietly(old)
            self._change_again()
            started = time.time_ns()
            self.calls.setup()  # its static streams go on as they are
            self.records.add_setup(self.operator, started, (None,) * len(self.ports.states), self._code)
        except OperatorFailure as failure:
            if not self.restarts.failed():
                raise
            self._on_failure(failure, self.restarts.due_in())

    def reload(self) -> dict[str, Any]:
        if self.ended:
            raise ReloadError(f"{self.node.name!r} has ended")
        began, failed = time.monotonic(), self.restarts.pending
        stamp = max(self.done, NEVER + 1)
        try:
            state = None if failed else self.calls.snapshot((self.records.incarnation, stamp))
            with interrupted_after(SET_UP_WITHIN):
                code = ReloadedCode(self.node, self._code)
        except (OperatorFailure, OperatorImportError) as error:
            raise ReloadError(str(error)) from error
        try:
            if what := _declares_other_ports(self.spec, code.now.operator.spec):
                raise ReloadError(f"its {what} are declared otherwise now: end the run and start it again")
            started, calls, kept = self._set_up(code.now.operator, state, stamp)
        except Exception as error:
            code.put_back()
            raise ReloadError(str(error)) from error
        if failed:
            self.restarts.begun()
        close_quietly(self.operator)
        self.operator, self.calls, self._code = calls.operator, calls, code.now
        self._begin_incarnation()
        self.records.add_setup(self.operator, started, (None,) * len(self.ports.states), code.now)
        if kept == KEPT_STATE:
            shown = state if state is not None and len(state) <= MAX_STATE_BYTES else None
            self.records.add("restore", stamp, started, detail={"state": shown, "before": stamp})
        self.wake()
        seconds, warning = time.monotonic() - began, ""
        changed = code.now.digests != code.before.digests
        try:
            code.store_before()
        except OSError as error:
            warning = f"the code before could not be stored, so verify will not have it: {error}"
        return {"seconds": seconds, "state": kept, "changed": changed, "warning": warning}

    def _set_up(self, made: type[Operator], state: bytes | None, stamp: int) -> tuple[int, Calls, str]:
        """An operator in the place of this one, as re-execution makes it, with its state if that fits. Returns when its
        `setup()` began (ns), its calls, and what has become of the state."""
        incarnation, kept = self.records.incarnation + 1, "none" if state is None else KEPT_STATE
        while True:
            calls = Calls(self.node, made(**self.node.params), self.calls.seed, effects=self.calls.effects)
            for name, value in self._changed.items():
                calls.parameter(name, value, (incarnation, NEVER))
            started = time.time_ns()
            try:
                with interrupted_after(SET_UP_WITHIN):
                    calls.setup()
                    if state is not None:
                        calls.restore(state, (incarnation, stamp))
                return started, calls, kept
            except OperatorFailure as failure:
                close_quietly(calls.operator)
                if state is None or failure.when != RESTORE:
                    raise
                state, kept = None, f"begun anew: {failure.summary}"

    def _change_again(self) -> None:
        for name, value in self._changed.items():
            self.calls.parameter(name, value, (self.records.incarnation, NEVER))

    def _reset(self, stream: str, entry: Entry) -> None:
        """The clock behind a stream jumped back: alignment begins anew, and so do the operator's own streams.

        Once for all streams of that producer: what those still bring from before is dropped, and what other streams
        have brought counts no more, so that they may go back with it.
        """
        started = time.time_ns()
        name = self._input_of(stream)
        self.queue.clear()
        drops, more = self.take_drops()
        self._begin_alignment()
        self._jumped[_producer(stream)] = entry.incarnation
        self._seen = {other: (incarnation, NEVER) for other, (incarnation, _) in self._seen.items()}
        self._time.begin_at(entry.stamp)
        self._begin_incarnation(stamps_go_back=True)
        self.done = NEVER
        detail: dict[str, Any] = {"input": name, **unlisted(more)}
        try:
            self.calls.reset(name, (self.records.incarnation, NEVER + 1))
        except RAISED as error:
            failure = OperatorFailure(self.node.name, "on_reset()", error)
            detail["error"] = failure.summary
            self.records.add("reset", NEVER + 1, started, outcome="error", drops=tuple(drops), detail=detail)
            raise failure from error
        self.records.add("reset", NEVER + 1, started, drops=tuple(drops), detail=detail)

    def _begin_alignment(self) -> None:
        old = self.aligner
        self._earlier_drops.update(old.drops)
        self._earlier_late.update(old.late)
        for held, count in old.buffered().items():
            if count and self.spec.inputs[held].kind != "sampled":
                self._earlier_drops[held, "reset"] += count
        self.aligner = make_aligner(old.spec)
        self._told = True
        for static in self._statics.values():
            self.aligner.push(static.stream, static)
        for stream, end in old.ends.items():  # of one that begins again, its message opens it
            self.aligner.end(stream, None, end.reason)

    def _begin_incarnation(self, *, stamps_go_back: bool = False) -> None:
        incarnation = self.records.incarnation + 1
        self.records = FiringLog(self.node.name, self.ports.emitter, incarnation)
        self.ports.begin(incarnation, stamps_go_back=stamps_go_back)

    def _input_of(self, stream: str) -> str:
        return next(name for name, streams in self.node.inputs.items() if stream in streams)

    def _admit(self, stream: str, arrival: Arrival) -> None:
        """Passes an arrival to the aligner. One that breaks a promise of its stream is refused and counted; a live run
        goes on."""
        self._told = True
        try:
            if isinstance(arrival, Entry):
                self.aligner.push(stream, arrival)
            elif arrival.ends:
                self._end_at(stream, None if arrival.stamp == NEVER else arrival.stamp, arrival.reason)
            else:
                self.aligner.advance(stream, arrival.stamp)
        except StreamOrderError:
            self._refused[stream] += 1
            if isinstance(arrival, Entry):
                self._log.add(dropped(self._input_of(stream), stream, arrival, "refused"))

    def _end_at(self, stream: str, final_stamp: int | None, reason: str) -> None:
        try:
            self.aligner.end(stream, final_stamp, reason)
        except StreamOrderError:  # its clock went back, and it ended before it sent a message at its new time
            self.aligner.end(stream, None, reason)

    def _give_up(self) -> bool:
        """Forces the frontiers of inputs whose wait has run out; False when that decides nothing new."""
        held = self.aligner.waiting()
        if held is None or not held.needs:
            return False
        moved = False
        for name, frontier in self.patience.exhausted(held.stamp, held.needs).items():
            if self.aligner.force(name, frontier):
                self._timeouts[name] += 1
                self._told = moved = True
        return moved


def _declares_other_ports(before: OperatorSpec, now: OperatorSpec) -> str:
    """Returns which ports differ in anything but their descriptions; empty where none do."""
    for what in ("inputs", "outputs"):
        a, b = ({n: replace(port, doc="") for n, port in getattr(spec, what).items()} for spec in (before, now))
        if a != b:
            return what
    return "" if before.merge == now.merge else "inputs"


def _producer(stream: str) -> str:
    """The operator that emits a stream, by the stream's name."""
    return stream.rpartition("/")[0]


def without_absent(firing: Firing, node: Node, absent: Collection[str]) -> Firing:
    """Marks the Sampled inputs stale that take an `absent` stream; drops what they hold where the policy requires it.
    Required inputs, and inputs of several streams, stay."""
    ports = node.spec.inputs
    gone = frozenset(
        name
        for name, port in ports.items()
        if port.kind == "sampled" and any(stream in absent for stream in node.inputs.get(name, ()))
    )
    if not gone:
        return firing
    inputs = dict(firing.inputs)
    if node.live.on_stale == "drop":
        inputs |= {
            name: None for name in gone if not ports[name].required and not isinstance(inputs.get(name), Mapping)
        }
    return Firing(firing.stamp, firing.kind, firing.tick, inputs, firing.stale | gone, firing.late)
