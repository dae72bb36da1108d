"""The supervisor of a live run: hosts that die, hang or grow are started again, and planned faults happen.

What it needs for that it keeps while the graph runs: the latest firing records of every operator, which hosts hand over
before they send a message. From them a new process learns where the old one had got to, and the recorder gets what a
dead host had not sent yet.
"""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from dataflow.chaos.plan import Fault
from dataflow.firing.restarts import Restarts
from dataflow.graph.model import Restart
from dataflow.names import firings_key
from dataflow.supervision.flow import LiveFlow
from dataflow.supervision.health import HealthMonitor, diagnostics_fields
from dataflow.supervision.held_records import HeldRecords
from dataflow.supervision.plan import HostPlan, RunPlan
from dataflow.supervision.report import OperatorCounts, RunFailed
from dataflow.supervision.supervisor import Supervised, Supervisor
from dataflow.sync import FOREVER, NEVER

DIAGNOSE_EVERY = 1.0
EDGES_WITHIN = 5.0
BEAT_WITHIN = 3.0
HUNG_AFTER = 5.0
"""Seconds that a firing may take, at least, when sources drop because of it."""


class LiveSupervisor(Supervisor):
    """Runs one plan live."""

    def __init__(self, plan: RunPlan, *, on_output: Callable[[str, str], None] | None = None) -> None:
        super().__init__(plan, on_output=on_output)
        self._held = {name: HeldRecords(tuple(node.outputs)) for name, node in plan.graph.nodes.items()}
        self._flow = LiveFlow(plan.graph, [host.nodes for host in self._plans.values()])
        self._frontiers: dict[str, tuple[int, int]] = {}
        self._base: dict[str, OperatorCounts] = {}
        self._base_drops: dict[str, Counter[tuple[str, str]]] = {}
        self._base_waits: dict[str, Counter[tuple[str, str]]] = {}
        self._away: dict[str, str] = {}
        self._ended_streams: dict[str, str] = {}
        self._restarted = False
        self._monitor = HealthMonitor()
        self._diagnose_due = 0.0
        self._next_fault = next(plan.faults, None) if plan.faults is not None else None
        self._thaws: list[tuple[float, Supervised]] = []

    def _watch_more(self) -> None:
        """Restarts, heartbeats, planned faults, diagnostics."""
        now = time.monotonic()
        for process in list(self._processes.values()):
            if process.rejoining is not None:
                self._rejoin(process, now)
            elif process.gone and process.restarts is not None and process.restarts.pending:
                if process.restarts.due_in() <= 0 and not self._stop_asked:
                    self._respawn(process)
                elif self._stop_asked:
                    raise RunFailed(f"interrupted while {process.describe()} was to be started again", interrupted=True)
            elif (
                process.beat is not None
                and now - process.beat > BEAT_WITHIN
                and process.report is None
                and not process.gone
                and self._may_restart(process)
            ):
                self._kill(process, f"gave no sign of life for {now - process.beat:.1f} s")
        self._do_faults(now)
        if now >= self._diagnose_due:
            self._diagnose_due = now + DIAGNOSE_EVERY
            self._diagnose(now)

    def _diagnose(self, now: float) -> None:
        counts = {
            name: (c.firings, c.emitted, c.dropped, c.busy_ns, c.done)
            for name, c in self.status.operators.items()
            if not name.startswith("@")
        }
        ended = frozenset(n for p in self._processes.values() if p.report is not None for n in p.nodes)
        self.status.health = self._monitor.update(
            counts,
            now,
            away=self._away,
            ended=ended,
            restarts=self.status.restarts,
            drops=self.status.drops,
            waits=self.status.waits,
        )
        self._tell_recorder("diagnostics", **diagnostics_fields(self.status.health, self._event_time()))

    def _event_time(self) -> int:
        """Event time now, as far as the supervisor can tell."""
        first = self.status.first
        if first is None:
            return time.time_ns()
        since = time.time() - float(self._released["at"])
        return first + round(since * 1e9 * (self.plan.rate or 1.0))

    def _tell_recorder(self, kind: str, /, **fields: Any) -> None:
        for process in self._processes.values():
            if process.kind == "sink" and process.config["kind"] == "record":
                self._send(process, kind, **fields)

    def _event(self, name: str, text: str, **data: Any) -> None:
        """Something that the user and the recording must know."""
        self.status.notes.append(text)
        self._tell_recorder("event", name=name, stamp=self._event_time(), data={"text": text, **data})

    # Planned faults

    def _do_faults(self, now: float) -> None:
        since = now - self._released_at
        while self._next_fault is not None and self._next_fault.at <= since:
            fault, self._next_fault = self._next_fault, next(self.plan.faults or iter(()), None)
            self._do_fault(fault, now)
        for due, process in list(self._thaws):
            if now >= due:
                self._thaws.remove((due, process))
                process.child.signal(signal.SIGCONT)

    def _do_fault(self, fault: Fault, now: float) -> None:
        process = next(p for p in self._processes.values() if fault.operator in p.nodes)
        if process.gone or not process.back or process.report is not None:
            return  # it is away already
        self._event(
            "fault",
            f"planned fault at {fault.at:.2f} s: {fault.kind} {fault.operator}",
            kind=fault.kind,
            operator=fault.operator,
            fields=dict(fault.fields),
        )
        match fault.kind:
            case "kill":
                process.child.signal(signal.SIGKILL)
            case "freeze":
                process.child.signal(signal.SIGSTOP)
                self._thaws.append((now + fault.fields["span"], process))
            case _:
                self._send(process, "fault", fault=fault.kind, operator=fault.operator, fields=dict(fault.fields))

    # Restarts

    def _may_restart(self, process: Supervised) -> bool:
        running = self.plan.live and self.status.phase == "running" and process.kind == "host"
        policies = [self.plan.graph.nodes[n].live.restart for n in process.nodes]
        return running and bool(policies) and min(p.max for p in policies) > 0

    def _kill(self, process: Supervised, cause: str) -> None:
        if not process.cause:
            process.cause = cause
            process.child.kill()

    def _outlives(self, process: Supervised, how: str) -> bool:
        """Notes that a host died and is to be started again; False where its policy does not allow it (any more)."""
        if not self._may_restart(process):
            return False
        if process.restarts is None:
            policies = [self.plan.graph.nodes[n].live.restart for n in process.nodes]
            process.restarts = Restarts(
                Restart(min(p.max for p in policies), max(p.backoff for p in policies)), time.monotonic
            )
        if not process.restarts.failed():
            return False
        self._restarted = True
        process.back, process.rejoining = False, None
        self._thaws = [(due, p) for due, p in self._thaws if p is not process]
        pause = process.restarts.due_in()
        for name in process.nodes:
            self._away[name] = how
            self.status.restarts[name] = self.status.restarts.get(name, 0) + 1
            if name in self.status.operators:
                self._base[name] = self.status.operators[name]
            self._base_drops[name] = Counter(self.status.drops.get(name, {}))
            self._base_waits[name] = Counter(self.status.waits.get(name, {}))
        self._hand_over_records(process.nodes)
        self._tell_consumers(process, absent=True)
        self._cover()
        self._event(
            "restart",
            f"{process.describe()} {how}; started again in {pause:.2g} s",
            operators=list(process.nodes),
            cause=how,
        )
        return True

    def _tell_consumers(self, process: Supervised, *, absent: bool) -> None:
        made = set(self._plans[process.label].publish)
        for other in self._processes.values():
            taken = made & _taken(self.plan, self._plans[other.label])
            if other is process or not taken or other.gone:
                continue
            if other.kind == "host":
                self._send(other, "absent", streams=sorted(taken), absent=absent)
            elif not absent:
                self._send(other, "expect", streams=sorted(taken))
            if not absent:
                other.unseen |= taken

    def _respawn(self, old: Supervised) -> None:
        """A new process in the place of one that died: the same operators, streams and endpoint."""
        assert old.restarts is not None
        old.restarts.begun()
        self._close_process(old)
        resume = {
            name: self._held[name].resumed() | {"restarts": self.status.restarts.get(name, 0)} for name in old.nodes
        }
        self._spawn(old.label, old.nodes, old.kind, {**old.config, "resume": resume})
        new = self._processes[old.label]
        new.restarts, new.back, new.rejoining = old.restarts, False, time.monotonic()
        new.done = dict(old.done)

    def _rejoin(self, process: Supervised, now: float) -> None:
        """Lets a host that was started again take part once its edges are known to work."""
        assert process.rejoining is not None
        if process.gone:
            return
        consumers = [p for p in self._processes.values() if p is not process and not p.gone]
        made = set(self._plans[process.label].publish)
        if process.ready and not process.probing:
            process.probing, process.rejoining = True, now
            self._tell_consumers(process, absent=False)
            self._send(process, "probe")
            return
        unproven = {s for p in consumers for s in p.unseen & made}
        if process.probing and (not unproven or now - process.rejoining > EDGES_WITHIN):
            if unproven:
                self.status.notes.append(f"{process.describe()} goes on without: {', '.join(sorted(unproven))}")
            taken = set(self._plans[process.label].subscribe)
            self._send(process, "go", **self._released)
            for reason in set(self._ended_streams.values()):
                over = sorted(s for s in taken if self._ended_streams.get(s) == reason)
                self._send(process, "ended_elsewhere", streams=over, reason=reason)
            process.rejoining, process.back, process.beat = None, True, None
            process.done = {name: self._flow.given(name) for name in self._consumers(process)}
            for name in process.nodes:
                self._away.pop(name, None)
            self._event("restarted", f"{process.describe()} is back", operators=list(process.nodes))
        elif not process.probing and now - process.rejoining > self.plan.start_timeout:
            self._kill(process, f"was not ready again within {self.plan.start_timeout:g} s")

    def _hand_over_records(self, operators: Iterable[str] | None = None) -> None:
        """Gives the recorder the firing records held of some operators, or of all; it leaves out what it has."""
        for name in self._held if operators is None else operators:
            self._tell_recorder("records", batches=list(self._held[name].batches))

    # Flow control

    def _counted(self) -> Iterator[tuple[Supervised, str]]:
        """The operators that take part at the moment, with their processes."""
        for process in self._processes.values():
            if process.kind == "host" and process.report is None and process.back:
                for name in self._consumers(process):
                    yield process, name

    def _cover(self) -> None:
        """Tells each host with sources how far everything is done: by all for whom they wait, and by all."""
        for name, node in self.plan.graph.nodes.items():
            if node.source and name in self.status.operators:
                self._flow.reached(name, self.status.operators[name].done)
        strict = [
            max((self._flow.lag(source, stamp) for source, stamp in process.done.items()), default=0)
            for process in self._processes.values()
            if process.kind == "sink" and process.report is None
        ]
        loose = list(strict)
        for process, name in self._counted():
            behind_last, behind_foremost = self._flow.lags(name, process.done.get(name, NEVER))
            loose.append(behind_foremost)
            if name in self._flow.waited_for:
                strict.append(behind_last)
        for process in self._processes.values():
            sources = [name for name in process.nodes if self.plan.graph.nodes[name].source]
            if sources and process.report is None:
                covered, backlog = (
                    self._flow.covered(sources, max(lags)) if lags else FOREVER for lags in (strict, loose)
                )
                if self._frontiers.get(process.label) != (covered, backlog):
                    self._frontiers[process.label] = covered, backlog
                    self._send(process, "covered", frontier=covered, backlog=backlog)

    # What hosts say

    def _counts_agree(self) -> bool:
        return not self._restarted

    def _count(self, counts: Mapping[str, list[int]]) -> None:
        super()._count(counts)
        for name in counts:
            if (base := self._base.get(name)) is not None:
                self.status.operators[name] = self.status.operators[name].after(base)

    def _count_drops(self, drops: Mapping[str, list[tuple[str, str, int]]]) -> None:
        super()._count_drops(drops)
        for name in drops:
            self.status.drops[name] += self._base_drops.get(name, Counter())

    def _count_waits(self, waits: Mapping[str, list[tuple[str, str, int]]]) -> None:
        super()._count_waits(waits)
        for name in waits:
            self.status.waits[name] += self._base_waits.get(name, Counter())

    def _on_message(self, process: Supervised, kind: str, fields: dict[str, Any]) -> None:
        if kind == "progress" and process.kind == "host":  # one that was started again has not decided anything yet
            fields["done"] = {name: stamp for name, stamp in fields["done"].items() if stamp != NEVER}
        super()._on_message(process, kind, fields)
        match kind:
            case "record":
                self._held[fields["operator"]].add(fields["data"])
            case "lacks":
                self._hand_over_records([fields["operator"]])
            case "beat":
                self._check_memory(process, fields["memory"])
            case "overdue":
                self._overdue(process, fields["operator"], fields["stamp"], fields["seconds"])
            case "backlog":
                self._look_for_hang(fields["messages"], fields["bytes"])
            case "restarting":
                name = fields["operator"]
                self.status.restarts[name] = self.status.restarts.get(name, 0) + 1
                self._event(
                    "restart",
                    f"operator {name!r} failed in {fields['when']}: {fields['summary']}; "
                    f"made anew in {fields['pause']:.2g} s",
                    operators=[name],
                    cause=fields["summary"],
                )
            case "gap":
                stream, first, following = fields["stream"], fields["first"], fields["following"]
                self._event(
                    "gap",
                    f"{process.label} did not get {stream} {first} to {following - 1}",
                    taker=process.label,
                    stream=stream,
                    first=first,
                    following=following,
                )
            case "stream_ended":
                self._ended_streams[fields["stream"]] = fields["reason"]
            case "jumped":
                name, stamp = fields["operator"], fields["stamp"]
                self._frontiers.clear()
                for other in self._processes.values():
                    other.done = {n: min(f, stamp - 1) for n, f in other.done.items() if f != FOREVER}
                self._event("clock_jump", f"the clock of {name!r} jumped back to {stamp}", operator=name, stamp=stamp)

    def _check_memory(self, process: Supervised, taken: int) -> None:
        limits = [m for n in process.nodes if (m := self.plan.graph.nodes[n].live.memory) is not None]
        if limits and taken > min(limits):
            cause = f"took {taken / 1e6:.0f} MB of memory (limit {min(limits) / 1e6:.0f} MB)"
            if not self._may_restart(process):
                raise RunFailed(f"{process.describe()} {cause}", self._last_words(), process.nodes[0])
            self._kill(process, cause)

    def _overdue(self, process: Supervised, operator: str, stamp: int, seconds: float) -> None:
        deadline = self.plan.graph.nodes[operator].live.deadline or 0
        what = f"its firing at stamp {stamp} has taken {seconds:.2f} s (deadline {deadline * 1e-9:g} s)"
        self._end_hang(process, operator, f"missed the deadline of {operator!r}: {what}")

    def _look_for_hang(self, messages: int, nbytes: int) -> None:
        """Sources drop because so much waits for operators that no source waits for: one of those may hang."""
        lags = {name: self._flow.lags(name, process.done.get(name, NEVER))[1] for process, name in self._counted()}
        for process in self._processes.values():
            if process.work is None or process.gone or not process.back or process.cause:
                continue
            operator, stamp, seconds = process.work
            late = 2 * lags.get(operator, 0) >= max(lags.values(), default=0)  # not just another one that is slow
            if seconds > HUNG_AFTER and late and self.plan.graph.nodes[operator].live.queue != "block":
                cause = (
                    f"hangs in {operator!r}: its firing at stamp {stamp} has taken {seconds:.1f} s, "
                    f"and {messages} messages ({nbytes / 1e6:.1f} MB) wait"
                )
                self._end_hang(process, operator, cause, advice=": give it a `deadline` or a restart policy")
                return

    def _end_hang(self, process: Supervised, operator: str, cause: str, *, advice: str = "") -> None:
        if not self._may_restart(process):
            process.child.kill()
            raise RunFailed(f"{process.describe()} {cause}{advice}", self._last_words(), operator)
        self._kill(process, cause)


def supervisor_of(plan: RunPlan, *, on_output: Callable[[str, str], None] | None = None) -> Supervisor:
    """The supervisor that a plan needs."""
    return (LiveSupervisor if plan.live else Supervisor)(plan, on_output=on_output)


def _taken(plan: RunPlan, host: HostPlan) -> set[str]:
    """The keys that a process takes from others."""
    if host.sink is None:
        return set(host.subscribe)
    firings = {firings_key(plan.graph.namespace, node) for node in plan.graph.nodes} if host.sink == "record" else set()
    return set(host.streams) | firings
