"""Restarts of processes in a live run: which may come back, how often, and how they take part again.

The rule: a process that dies, that is killed for breaking a rule, that cannot set up its operators, or that fails
itself, is restarted by its policy, the strictest of its operators', whether it works or is still being started. An
operator that raises while it works is restarted within its process, by the same policy; that used up, the run ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dataflow.execution.restarts import Restarts
from dataflow.graph.model import Restart
from dataflow.supervision.core.barrier import expect_probes, tell_consumers
from dataflow.supervision.core.life import ON_ITS_WAY, Life, Step
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.core.run_state import Phase, RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.leftover_records import LeftoverRecords
from dataflow.supervision.core.watchers.watcher import Watcher
from dataflow.supervision.links import pairs_of

EDGES_WITHIN = 5.0
RECORDER = Restart(max=5, backoff=1_000_000_000)
"""Policy of the recorder of a run that goes on without it: the next one begins another file."""


class RestartPolicy(Watcher):
    """No process is started again: the first death ends the run."""

    def may_restart(self, process: Supervised) -> bool:
        """Returns whether the policy of a process allows any restart at all."""
        return False

    def grant(self, process: Supervised) -> bool:
        """Uses up one attempt of a process that has failed; False when none is left."""
        return False

    def await_turn(self, process: Supervised, how: str) -> None:
        """A process whose restart was granted has died."""
        raise AssertionError(f"no restart was granted to {process.describe()}, which {how}")

    def hand_over_all(self) -> None:
        """Gives the recorder what it may lack of processes that are gone."""


class LiveRestarts(RestartPolicy):
    """Restarts by the operators' policies."""

    def __init__(self, run: RunState, remains: LeftoverRecords, parts: Sequence[Watcher]) -> None:
        """`parts`: all watchers of the run, which are notified of processes that go and come back."""
        super().__init__(run)
        self._remains, self._parts = remains, parts
        self._pairs = tuple(pairs_of(run.graph, {label: process.plan for label, process in run.processes.items()}))
        self._attempts: dict[str, Restarts] = {}
        self._ended_streams: dict[str, str] = {}

    # Policy

    def may_restart(self, process: Supervised) -> bool:
        return not self._closing() and self._policy(process).max > 0

    def _closing(self) -> bool:
        return self.run.phase in (Phase.CLOSING, Phase.OVER)

    def _policy(self, process: Supervised) -> Restart:
        if process.is_sink:
            goes_on = process.plan.sink == "record" and process.plan.options["storage"]["on_failure"] == "go_on"
            return RECORDER if goes_on else Restart(0)
        policies = [self.run.graph.nodes[name].live.restart for name in process.nodes]
        return Restart(min((p.max for p in policies), default=0), max((p.backoff for p in policies), default=0))

    def grant(self, process: Supervised) -> bool:
        if not self.may_restart(process):
            return False
        attempts = self._attempts.get(process.label)
        if attempts is None:
            attempts = self._attempts[process.label] = Restarts(self._policy(process), lambda: self.run.steady)
        return attempts.failed()

    # Away

    def await_turn(self, process: Supervised, how: str) -> None:
        run = self.run
        process.take(Step.AWAIT, run.steady)
        process.cause, failed_in = how, process.failed_in
        for name in process.nodes:
            run.status.restarts[name] = run.status.restarts.get(name, 0) + 1
        if run.release is not None:
            self._remains.hand_over(process.nodes)
        tell_consumers(run, process, absent=True)
        self._tell_producers(process)
        for part in self._parts:
            part.away(process)
        text = f"{process.describe()} {how}; started again in {self._attempts[process.label].due_in():.2g} s"
        run.event("restart", text, operators=list(process.nodes), cause=how, **failed_in)

    def _tell_producers(self, process: Supervised) -> None:
        """Notifies the producers of a process that it no longer takes their messages."""
        for label, producer in self.run.processes.items():
            consumers = [consumer for maker, consumer in self._pairs if maker == label]
            if process.label in consumers:
                self.run.send(producer, "gone", ring=consumers.index(process.label), life=process.life_number)

    def tick(self) -> None:
        for process in self.run.processes.values():
            if process.life is Life.AWAY:
                self._await(process)
            elif process.life in ON_ITS_WAY and process.attempt and self.run.release is not None:
                self._rejoin(process)

    def _await(self, process: Supervised) -> None:
        if self.run.phase is Phase.STOPPING:
            raise RunFailed(f"interrupted while {process.describe()} was to be started again", interrupted=True)
        attempts = self._attempts[process.label]
        if attempts.due_in() > 0:
            return
        attempts.begun()
        process.take(Step.RESTART, self.run.steady)
        process.renew()
        if self.run.release is None:  # the one before is unknown to the others
            self._remains.forget(process.nodes)
            process.begins = {}
            self.run.spawn(process)
        elif process.is_sink:
            process.done.clear()  # it owes nothing of what was before it
            self.run.spawn(process)
        else:
            restarts = self.run.status.restarts
            resume = {n: self._remains.resumed(n) | {"restarts": restarts.get(n, 0)} for n in process.nodes}
            process.begins = {name: fields["incarnation"] for name, fields in resume.items()}
            self.run.spawn(process, resume=resume)

    # Back

    def _rejoin(self, process: Supervised) -> None:
        """Lets a process that was started again take part once its edges are known to work."""
        run = self.run
        if process.life is Life.READY:
            process.take(Step.PROBE, run.steady)
            expect_probes(run, process)
            run.send(process, "probe")
        elif process.life is Life.PROBING:
            unproven = self._unproven(process)
            if not unproven or run.steady - process.since > EDGES_WITHIN:
                self._go(process, unproven)
        elif run.steady - process.since > run.plan.start_timeout:
            run.kill(process, f"was not ready again within {run.plan.start_timeout:g} s")

    def _unproven(self, process: Supervised) -> set[str]:
        made = set(process.plan.publish)
        others = (p for p in self.run.processes.values() if p is not process and p.reachable)
        return {stream for other in others for stream in other.unseen & made}

    def _go(self, process: Supervised, unproven: set[str]) -> None:
        run = self.run
        assert run.release is not None
        process.take(Step.GO, run.steady)
        if unproven:
            run.note(f"{process.describe()} goes on without: {', '.join(sorted(unproven))}")
        run.send(process, "go", first=run.release.first, at=run.release.at.wall)
        taken = run.takes(process)
        for reason in sorted(set(self._ended_streams.values())):
            over = sorted(s for s in taken if self._ended_streams.get(s) == reason)
            run.send(process, "ended_elsewhere", streams=over, reason=reason)
        if process.is_sink:  # of what the recorder before had not stored, operators have kept the records
            for each in run.working():
                for name in each.nodes:
                    run.send(each, "lacks", operator=name)
        for part in self._parts:
            part.back(process)
        run.event("restarted", f"{process.describe()} is back", operators=list(process.nodes))

    # News

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        run = self.run
        match kind:
            case "restarting":
                name = fields["operator"]
                run.status.restarts[name] = run.status.restarts.get(name, 0) + 1
                cause, where, traceback = fields["summary"], fields["where"], fields["traceback"]
                text = f"operator {name!r} failed in {fields['when']}: {cause}{f' ({where})' if where else ''}"
                text += f"; made anew in {fields['pause']:.2g} s"
                run.event("restart", text, operators=[name], cause=cause, where=where, traceback=traceback)
            case "reloaded":
                name = fields["operator"]
                which = "new code" if fields["changed"] else "the code that it had, whose files are as they were,"
                text = f"operator {name!r} goes on with {which} after {fields['seconds']:.2g} s"
                said = (text, f"its state: {fields['state']}", fields["warning"])
                run.event("reload", "; ".join(filter(None, said)), operators=[name])
            case "stream_ended":
                self._ended_streams[fields["stream"]] = fields["reason"]
            case "gap":
                stream, first, following = fields["stream"], fields["first"], fields["following"]
                text = f"{process.label} did not get {stream} {first} to {following - 1}"
                run.event("gap", text, taker=process.label, stream=stream, first=first, following=following)
            case "jumped":
                name, stamp = fields["operator"], fields["stamp"]
                run.event("clock_jump", f"the clock of {name!r} jumped back to {stamp}", operator=name, stamp=stamp)

    def hand_over_all(self) -> None:
        self._remains.hand_over(self.run.graph.nodes)
