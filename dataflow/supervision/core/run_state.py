"""State that all parts of the supervisor's core share: the processes, the status, the time, and the commands to be
given."""

from __future__ import annotations

import signal
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from dataflow.process.stacks import ASK
from dataflow.supervision.core.commands import Command, Send, Signal, Spawn
from dataflow.supervision.core.events import Moment
from dataflow.supervision.core.life import WORKS, Life, Step
from dataflow.supervision.core.report import OperatorCounts, Status
from dataflow.supervision.core.stack_traces import shortened
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.plan import ProcessPlan, RunPlan, taken_keys

CLOCK_EVERY = 10.0
"""Seconds between two events that store the offset of a machine's clock."""
ASK_BEFORE = 1.0
"""Seconds before the time of a process is up at which it is asked where it is; of a short time, a fifth."""


class Phase(Enum):
    """Phases of a run, which only goes forward."""

    STARTING = "starting"
    RUNNING = "running"
    STOPPING = "stopping"
    CLOSING = "closing"
    OVER = "over"


@dataclass(frozen=True, slots=True)
class Release:
    """Release of the sources: its moment, and the stamp that then was now (None: unknown)."""

    first: int | None
    at: Moment


class RunState:
    """The run as far as it is known. Parts read it, and act through its methods."""

    def __init__(
        self, plan: RunPlan, plans: Mapping[str, ProcessPlan], configs: Mapping[str, tuple[str, dict[str, Any]]]
    ) -> None:
        self.plan, self.configs = plan, configs
        self.graph = plan.graph
        self.processes = {label: Supervised(one) for label, one in plans.items()}
        self.status = Status()
        self.now = Moment(0.0, 0.0)
        self.release: Release | None = None
        self.paused = 0.0
        """Seconds of the run for which the supervisor did not run, and `steady` stood still."""
        self._clocks: dict[str, float] = {}
        self.unreachable: dict[str, str] = {}
        """By process on an unreachable machine, that machine."""
        self.unheard: dict[str, float] = {}
        """By unreachable machine, since when (s)."""
        self._phase = Phase.STARTING
        self._commands: list[Command] = []
        for label, process in self.processes.items():
            for node in process.nodes or ((label,) if process.is_sink or process.plan.has_log else ()):
                self.status.operators[node] = OperatorCounts()
                self.status.process_of[node] = label

    # Phase and time

    @property
    def phase(self) -> Phase:
        return self._phase

    def enter(self, phase: Phase) -> None:
        order = list(Phase)
        assert order.index(phase) > order.index(self._phase), f"{self._phase} → {phase}"
        self._phase = phase
        if phase is not Phase.OVER:
            self.status.phase = phase.value

    @property
    def under_way(self) -> bool:
        """Returns whether sources are released and nothing is being closed yet."""
        return self._phase in (Phase.RUNNING, Phase.STOPPING)

    @property
    def steady(self) -> float:
        return self.now.steady

    def event_time(self) -> int:
        """Returns event time now (ns), as far as the supervisor has it."""
        first = self.status.first
        if first is None:
            return round(self.now.wall * 1e9)
        since = 0.0 if self.release is None else self.now.wall - self.release.at.wall
        return first + round(since * 1e9 * (self.plan.rate or 1.0))

    # Processes

    def working(self) -> Iterator[Supervised]:
        """Yields the processes that work, or have handed in their report."""
        return (p for p in self.processes.values() if p.life in WORKS)

    def consumers(self, process: Supervised) -> tuple[str, ...]:
        """Returns what a process counts for in flow control: its operators with inputs, or itself if it is a sink."""
        if process.is_sink:
            return (process.label,)
        return tuple(n for n in process.nodes if not self.graph.nodes[n].source)

    def sources(self, process: Supervised) -> tuple[str, ...]:
        return tuple(n for n in process.nodes if self.graph.nodes[n].source)

    def takes(self, process: Supervised) -> set[str]:
        """Returns the keys that a process takes from others."""
        return taken_keys(self.graph, process.plan)

    def last_words(self, late: Collection[Supervised] = ()) -> str:
        """Returns what processes said last, stacks shortened; of those that are `late` all that is kept."""
        said = ((p, line) for p in self.processes.values() for line in shortened(p.words)[0 if p in late else -5 :])
        lines = [f"[{p.label}] {line}" for p, line in said]
        return "\n".join(lines)

    def summaries(self) -> dict[str, Mapping[str, Any]]:
        """Returns what operators summed up at their end, as far as their processes have reported it."""
        reports = [process.report or {} for process in self.processes.values()]
        return {node: found for report in reports for node, found in report.get("summaries", {}).items()}

    # Acting

    def take_commands(self) -> list[Command]:
        commands, self._commands = self._commands, []
        return commands

    def command(self, command: Command) -> None:
        self._commands.append(command)

    def spawn(self, process: Supervised, **more: Any) -> None:
        """Starts a process by its configuration, `more` on top of it."""
        process.since = self.steady
        kind, config = self.configs[process.label]
        self.command(Spawn(process.label))
        self.command(Send(process.label, kind, config | {"life": process.life_number} | more))

    def send(self, process: Supervised, kind: str, /, *, replaces: bool = False, **fields: Any) -> None:
        """Sends to a process, if there is one."""
        if process.reachable:
            self.command(Send(process.label, kind, fields, replaces))

    def send_all(self, kind: str, /, *, replaces: bool = False, **fields: Any) -> None:
        for process in self.processes.values():
            self.send(process, kind, replaces=replaces, **fields)

    def kill(self, process: Supervised, cause: str = "") -> None:
        """Kills a process, if there is one that was not killed before; `cause` is the reason, in words that follow its
        name."""
        if process.take(Step.KILL, self.steady):
            process.cause = cause or process.cause
            self.signal(process, signal.SIGKILL)

    def signal(self, process: Supervised, number: int) -> None:
        if process.life is not Life.AWAY:
            self.command(Signal(process.label, number))

    def note(self, text: str) -> None:
        """Shows a message to the user, at once and in the report."""
        self.status.notes.append(text)

    def link_changed(self, machine: str, labels: Collection[str], *, up: bool) -> None:
        """Notes that processes on another machine are out of reach, or no longer: none of them need have ended."""
        for label in labels:
            self.unreachable.pop(label, None)
        self.unheard.pop(machine, None)
        if not up:
            self.unheard[machine] = self.steady
            self.unreachable |= dict.fromkeys(labels, machine)
        what = "is back" if up else "is down: that machine does not answer, and its operators go on"
        self.event("link", f"the link to machine {machine!r} {what}", machine=machine, up=up)

    def clock_measured(self, machine: str, offset: int, delay: int) -> None:
        """Stores by how much the clock of another machine is ahead (ns), now and then, and shows it the first time."""
        if self.release is None or self.steady - self._clocks.get(machine, -CLOCK_EVERY) < CLOCK_EVERY:
            return
        text = f"the clock of machine {machine!r} is {offset / 1e6:+.3f} ms ahead, ± {delay / 2e6:.3f} ms"
        if machine not in self._clocks:
            self.note(text)
        self._clocks[machine] = self.steady
        data = {"text": text, "machine": machine, "offset": offset, "delay": delay}
        self.tell_recorder("event", name="clock", stamp=self.event_time(), data=data)

    def tell_recorder(self, kind: str, /, **fields: Any) -> None:
        for process in self.processes.values():
            if process.plan.sink == "record":
                self.send(process, kind, **fields)

    def trigger(self, text: str) -> None:
        """Has the flight recorder save its history."""
        self.tell_recorder("event", name="trigger", stamp=self.event_time(), data={"text": text})

    def event(self, name: str, text: str, /, **data: Any) -> None:
        """Shows a message to the user and stores it in the recording."""
        self.note(text)
        self.tell_recorder("event", name=name, stamp=self.event_time(), data={"text": text, **data})


def notice(timeout: float) -> float:
    """Returns how many seconds before the end of a time, which is so long, to ask."""
    return min(ASK_BEFORE, timeout / 5)


class StackTraceRequests:
    """Asks each process where it is, once for each time that it is stuck, before it is given up: what its threads are
    at becomes part of its last words."""

    def __init__(self, run: RunState) -> None:
        self._run = run
        self._asked: dict[str, object] = {}

    def ask(self, late: Iterable[Supervised], since: object) -> None:
        """Asks processes; `since` is something that changes when they go on."""
        for process in late:
            if self._asked.get(process.label) != since:
                self._asked[process.label] = since
                self._run.signal(process, ASK)
