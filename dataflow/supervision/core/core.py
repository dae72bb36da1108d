"""The supervisor's core: events in, commands out.

It has no clock, socket, file or thread: time comes with each event, and what is to be done goes out as commands. So a
whole run, with every timeout in it, is a play that a test can write down, and the same events always give the same
commands. It starts the processes of a run behind a barrier, watches over them through its parts, and ends them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dataflow.supervision.core.barrier import Barrier
from dataflow.supervision.core.closing import LEAVE_TIMEOUT, Closing
from dataflow.supervision.core.commands import Announce, Command, Over, Withdraw
from dataflow.supervision.core.events import (
    Aborted,
    Begin,
    ClockMeasured,
    Died,
    Event,
    HungUp,
    LeftBehind,
    LinkChanged,
    Moment,
    NotReading,
    Paused,
    PlaybackAsked,
    Printed,
    Remained,
    Said,
    StopAsked,
    Tick,
    TriggerAsked,
)
from dataflow.supervision.core.life import ON_ITS_WAY, Life, Step
from dataflow.supervision.core.log_keeper import LogKeeper
from dataflow.supervision.core.outcome import report_of
from dataflow.supervision.core.report import RunFailed, Status
from dataflow.supervision.core.run_state import Phase, Release, RunState
from dataflow.supervision.core.stack_traces import shortened
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.restarts import RestartPolicy
from dataflow.supervision.core.watchers.watcher import Watcher
from dataflow.supervision.core.wording import how_it_ended


class Core:
    """One run. Which parts watch over it, and what becomes of those that die, is chosen where it is made."""

    def __init__(self, run: RunState, parts: Sequence[Watcher], restarts: RestartPolicy) -> None:
        self.run, self._parts, self._restarts = run, tuple(parts), restarts
        self._barrier = Barrier(run)
        self._logs = LogKeeper(run)
        self._closing: Closing | None = None
        self._stops = 0
        self._interrupted = False
        self._ended_at = 0.0

    @property
    def status(self) -> Status:
        return self.run.status

    def handle(self, event: Event, now: Moment) -> list[Command]:
        """Takes in what happened and returns what is to be done. Nothing happens any more after `Over`."""
        self.run.now = now
        if self.run.phase is not Phase.OVER:
            try:
                self._handle(event)
                if _decides(event):
                    self._go_on()
            except RunFailed as failure:
                self._fail(failure)
        return self.run.take_commands()

    def _handle(self, event: Event) -> None:
        match event:
            case Begin():
                self._barrier.begin()
            case Tick():
                self._tick()
            case Paused(seconds, uncounted):
                if self.run.under_way:
                    self.run.paused += uncounted
                self.run.event(
                    "paused", f"the supervisor did not run for {seconds:.1f} s, which count against no process"
                )
            case StopAsked():
                self._stop()
            case PlaybackAsked(action, steps, speed):
                if self._closing is None and self.run.phase is not Phase.STARTING:
                    self.run.send_all("playback", action=action, steps=steps, speed=speed)
            case TriggerAsked(text):
                if self._closing is None and self.run.phase is not Phase.STARTING:
                    self.run.trigger(text)
            case Aborted(why, interrupted):
                raise RunFailed(why, interrupted=interrupted)
            case Said(label, kind, fields):
                self._said(self.run.processes[label], kind, fields)
            case Printed(label, line, log):
                self.run.processes[label].words.append(line)
                if log is not None:
                    self._logs.take(log)
                    if self._closing is not None:
                        self._logs.hand_on_all()
            case NotReading(label, seconds, _, overflowed):
                for part in self._parts:
                    part.not_reading(self.run.processes[label], seconds, overflowed=overflowed)
            case HungUp(label):
                self.run.processes[label].hung_up = self.run.steady
            case LeftBehind(labels, processes):
                who = " or ".join(map(repr, labels))
                self.run.note(f"process {who} left processes behind, which were killed: {', '.join(processes)}")
            case Remained(label, remains):
                for part in self._parts:
                    part.remained(self.run.processes[label], remains)
            case LinkChanged(machine, labels, up):
                self.run.link_changed(machine, labels, up=up)
            case ClockMeasured(machine, offset, delay):
                self.run.clock_measured(machine, offset, delay)
            case Died(label, code):
                self._died(self.run.processes[label], code)

    # Time

    def _tick(self) -> None:
        self._logs.hand_on()
        for process in self.run.processes.values():
            self._see_to_death(process)
        if self._closing is None and self.run.phase is Phase.STARTING:
            self._restarts.tick()
        elif self._closing is None:
            for part in self._parts:
                part.tick()
        self._go_on()

    def _go_on(self) -> None:
        """Begins what nothing more stands in the way of: the probes, the run, its end."""
        run = self.run
        if self._closing is not None:
            self._closing.tick()
            if self._closing.over:
                self._over(self._closing)
        elif run.phase is Phase.STARTING:
            if self._barrier.tick():
                self._release()
        elif all(p.life is Life.ENDED for p in run.processes.values()):
            self._close(None)

    def _see_to_death(self, process: Supervised) -> None:
        """A process that closed its channel, or failed and was told to leave, has so much time to end."""
        now = self.run.steady
        if process.hung_up is not None and now - process.hung_up > LEAVE_TIMEOUT:
            self.run.kill(process, process.cause or "closed its channel and did not end")
        elif process.life is Life.FAILED and now - process.since > LEAVE_TIMEOUT:
            self.run.kill(process)
        elif process.life is Life.KILLED and now - process.since > LEAVE_TIMEOUT and self._closing is None:
            raise RunFailed(f"{process.describe()} {process.cause}; it was killed and did not end")

    def _release(self) -> None:
        run = self.run
        run.enter(Phase.RUNNING)
        run.release = Release(run.status.first, run.now)
        run.command(Announce(tuple(p.label for p in run.processes.values() if not p.is_sink)))
        for process in run.processes.values():
            process.take(Step.GO, run.steady)
        run.send_all("go", first=run.release.first, at=run.now.wall)
        for part in self._parts:
            part.released()

    def _stop(self) -> None:
        self._stops += 1
        if self._closing is not None:
            if self._stops > 1:
                self._closing.hurry()
        elif self.run.phase is Phase.STARTING:
            self._interrupted = True
            self._close(None)
        elif self._stops > 1:
            raise RunFailed("stopped before everything was drained", interrupted=True)
        else:
            self._interrupted = True
            self.run.enter(Phase.STOPPING)
            self.run.send_all("stop")

    # Processes

    def _said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        now = self.run.steady
        match kind:
            case "joined":
                process.take(Step.JOIN, now)
            case "ready":
                if process.take(Step.GET_READY, now):
                    self._barrier.ready(process, fields)
            case "seen":
                process.unseen.discard(fields["stream"])
            case "ended":
                if not process.end(fields["report"], now):
                    return
            case "closed":
                if process.take(Step.CLOSE, now):
                    process.facts = fields["facts"]
            case "failed":
                self._failed(process, fields)
                return
        for part in self._parts:
            part.said(process, kind, fields)

    def _failed(self, process: Supervised, fields: Mapping[str, Any]) -> None:
        """Takes the report of a process that one of its operators, or it itself, has failed; it waits to be told to
        leave."""
        if process.life in (Life.KILLED, Life.FAILED):
            return  # its end is decided
        operator, summary = fields["operator"], fields["summary"]
        what = f"operator {operator!r} failed in {fields['when']}: {summary}" if operator else f"failed: {summary}"
        by_policy = operator is None or process.life in ON_ITS_WAY  # at work its process has restarted it by it
        if by_policy and self._closing is None and self._restarts.grant(process):
            process.take(Step.LEAVE_FAILED, self.run.steady)
            where = fields["where"]
            process.cause = (f"has left: {what}" if operator else what) + (f" ({where})" if where else "")
            process.failed_in = {"where": where, "traceback": fields["traceback"]}
            self.run.send(process, "leave", outcome=f"failed: {what}", again=True)
            return
        raise RunFailed(what if operator else f"{process.describe()} {what}", fields["traceback"], operator)

    def _died(self, process: Supervised, code: int | None) -> None:
        run, before = self.run, process.life
        if not process.take(Step.DIE, run.steady) or before is Life.CLOSED:
            return
        how = process.cause or how_it_ended(code)
        if self._closing is None and (before is Life.FAILED or self._restarts.grant(process)):
            self._restarts.await_turn(process, how)
            return
        if self._closing is not None and before is Life.KILLED:
            return  # it was late, which was said
        reached = process.reached()
        phase = f" while {run.status.phase}" + (f" ({reached})" if reached else "")
        raise RunFailed(f"{process.describe()} {how}{phase}", "\n".join(shortened(process.words)[-20:]))

    # End

    def _fail(self, failure: RunFailed) -> None:
        if self._closing is None:
            self._close(failure)
        else:
            self._closing.fail(failure)

    def _close(self, failure: RunFailed | None) -> None:
        run = self.run
        self._ended_at = run.steady
        self._logs.hand_on_all()
        if run.under_way:
            for part in self._parts:
                part.closing()
        run.command(Withdraw())
        self._closing = Closing(
            run,
            outcome="interrupted" if self._interrupted else "complete",
            failure=failure,
            at_once=self._stops > 1,
            hand_over=self._restarts.hand_over_all,
        )

    def _over(self, closing: Closing) -> None:
        run = self.run
        run.enter(Phase.OVER)
        report = None if closing.failure is not None else report_of(run, self._ended_at, interrupted=self._interrupted)
        run.command(Over(report, closing.failure))


def _decides(event: Event) -> bool:
    """Returns whether a run may go on at once because of this event: a process has reached what others wait for."""
    match event:
        case Said(_, "ready" | "seen" | "ended" | "closed", _) | Died():
            return True
    return False
