"""The supervisor's core: events in, commands out.

It has no clock, socket, file or thread: time comes with each event, and what is to be done goes out as commands. So a
whole run, with every timeout in it, is a play that a test can write down, and the same events always give the same
commands. It starts the processes of a run behind a barrier, watches over them through its parts, and ends them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dataflow.supervision.core import events
from dataflow.supervision.core.barrier import Barrier
from dataflow.supervision.core.closing import LEAVE_TIMEOUT, Closing
from dataflow.supervision.core.commands import Announce, Command, RunEnded, Withdraw
from dataflow.supervision.core.life import ON_ITS_WAY, Life, Step, how_it_ended
from dataflow.supervision.core.log_keeper import LogKeeper
from dataflow.supervision.core.report import RunFailed, RunReport, Status
from dataflow.supervision.core.run_state import Phase, Release, RunState
from dataflow.supervision.core.stack_traces import shortened
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.restarts import RestartPolicy
from dataflow.supervision.core.watchers.watcher import Watcher
from dataflow.sync import FOREVER, NEVER


class Core:
    """One run. Which parts watch over it, and what becomes of those that die, is chosen where it is made."""

    def __init__(self, run: RunState, parts: Sequence[Watcher], restarts: RestartPolicy) -> None:
        self.run, self._parts, self._restarts = run, tuple(parts), restarts
        self._barrier = Barrier(run)
        self._logs = LogKeeper(run)
        self._closing: Closing | None = None
        self._triggers: set[str] = set()
        self._stops = 0
        self._interrupted = False
        self._ended_at = 0.0

    @property
    def status(self) -> Status:
        return self.run.status

    def handle(self, event: events.Event, now: events.Moment) -> list[Command]:
        """Takes in what happened and returns what is to be done. Nothing happens any more after `RunEnded`."""
        self.run.now = now
        if self.run.phase is not Phase.OVER:
            try:
                self._handle(event)
                if _decides(event):
                    self._go_on()
            except RunFailed as failure:
                self._fail(failure)
        return self.run.take_commands()

    def _handle(self, event: events.Event) -> None:
        run = self.run
        match event:
            case events.RunStarted():
                self._barrier.begin()
            case events.Tick():
                self._tick()
            case events.Paused(seconds, uncounted):
                run.paused += uncounted if run.under_way else 0.0
                run.event("paused", f"the supervisor did not run for {seconds:.1f} s, which count against no process")
            case events.StopRequested():
                self._stop()
            case events.PlaybackRequested(action, steps, speed) if run.under_way:
                run.send_all("playback", action=action, steps=steps, speed=speed)
            case events.TriggerRequested(text) if run.under_way:
                run.trigger(text)
            case events.Aborted(why, interrupted):
                raise RunFailed(why, interrupted=interrupted)
            case events.Received(label, kind, fields):
                self._said(run.processes[label], kind, fields)
            case events.Printed(label, line, log):
                run.processes[label].words.append(line)
                if log is not None:
                    self._logs.take(log)
                    if self._closing is not None:
                        self._logs.hand_on_all()
            case events.NotReading(label, seconds, _, overflowed):
                for part in self._parts:
                    part.not_reading(run.processes[label], seconds, overflowed=overflowed)
            case events.Disconnected(label):
                run.processes[label].hung_up = run.steady
            case events.OrphansKilled(labels, processes):
                who = " or ".join(map(repr, labels))
                run.note(f"process {who} left processes behind, which were killed: {', '.join(processes)}")
            case events.RecordsRecovered(label, remains):
                for part in self._parts:
                    part.remained(run.processes[label], remains)
            case events.LinkChanged(machine, labels, up):
                run.link_changed(machine, labels, up=up)
            case events.ClockMeasured(machine, offset, delay):
                run.clock_measured(machine, offset, delay)
            case events.Exited(label, code):
                self._died(run.processes[label], code)

    # Time

    def _tick(self) -> None:
        self._logs.hand_on()
        for process in self.run.processes.values():
            self._see_to_death(process)
        if self.run.phase is Phase.STARTING:
            self._restarts.tick()
        elif self.run.under_way:
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
        """A process that closed its channel, or failed and was asked to leave, has so much time to end."""
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
            case "trigger" if fields["id"] not in self._triggers:  # every process hands on what it is asked
                self._triggers.add(fields["id"])
                self.run.trigger(fields["text"])
            case "failed":
                self._failed(process, fields)
                return
        for part in self._parts:
            part.said(process, kind, fields)

    def _failed(self, process: Supervised, fields: Mapping[str, Any]) -> None:
        """Takes the report of a process that one of its operators, or it itself, has failed; it waits to be asked to
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
        outcome, hand_over = "interrupted" if self._interrupted else "complete", self._restarts.hand_over_all
        self._closing = Closing(run, outcome=outcome, failure=failure, at_once=self._stops > 1, hand_over=hand_over)

    def _over(self, closing: Closing) -> None:
        run = self.run
        run.enter(Phase.OVER)
        report = None if closing.failure is not None else _report_of(run, self._ended_at, self._interrupted)
        run.command(RunEnded(report, closing.failure))


def _decides(event: events.Event) -> bool:
    """Returns whether a run may go on at once because of this event: a process has reached what others wait for."""
    match event:
        case events.Received(_, "ready" | "seen" | "ended" | "closed", _) | events.Exited():
            return True
    return False


def _report_of(run: RunState, ended_at: float, interrupted: bool) -> RunReport:
    """Returns the report of a run that has ended in order; `ended_at` is when everything was drained (steady s).

    One that was interrupted while starting has done nothing, for 0 s.
    """
    status = run.status
    reports = {p.label: p.report or {} for p in run.processes.values()}
    streams = {s: (n, d) for r in reports.values() for s, (n, d) in r.get("streams", {}).items()}
    reached = [c.done for c in status.operators.values() if c.done not in (NEVER, FOREVER)]
    drops = {node: status.drops[node] for node in status.operators if status.drops.get(node)}
    waits = {node: found for node, found in status.waits.items() if found}
    return RunReport(
        graph=run.graph.name,
        streams=dict(sorted(streams.items())),
        operators=dict(status.operators),
        drops={node: tuple((i, why, n) for (i, why), n in sorted(found.items())) for node, found in drops.items()},
        summaries=run.summaries(),
        transport={label: r["transport"] for label, r in reports.items() if "transport" in r},
        files={p.label: p.facts for p in run.processes.values() if p.is_sink},
        first=status.began if status.first is None else status.first,
        last=max(reached, default=None),
        wall=0.0 if run.release is None else ended_at - run.release.at.steady + run.paused,
        interrupted=interrupted,
        notes=tuple(status.notes),
        sources=tuple(node.name for node in run.graph.sources() if node.name in status.operators),
        restarts=dict(status.restarts),
        waits={node: tuple((i, what, n) for (i, what), n in sorted(found.items())) for node, found in waits.items()},
        namespace=run.graph.namespace,
    )
