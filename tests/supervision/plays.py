"""Plays of the supervisor's core: processes that answer as real ones do, a clock that the test moves, no I/O."""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Mapping
from typing import Any

from dataflow.graph import load_text
from dataflow.process.stacks import ASK
from dataflow.records.black_box import OperatorProgress, RecoveredRecords
from dataflow.records.firing import FiringRecord, encode_batch
from dataflow.supervision.configs import configurations
from dataflow.supervision.core.commands import Command, RunEnded, Send, Signal, Spawn
from dataflow.supervision.core.compose import core_of
from dataflow.supervision.core.events import (
    Event,
    Exited,
    Moment,
    Received,
    RecordsRecovered,
    RunStarted,
    StopRequested,
    Tick,
)
from dataflow.supervision.core.report import RunFailed, RunReport
from dataflow.supervision.plan import RunPlan, process_plans

WALL = 1_700_000_000.0
STEP = 0.05


def graph_of(*operators: str) -> Any:
    lines = "\n  ".join(operators)
    return load_text(f"graph: robot\nnamespace: test\noperators:\n  {lines}\n")


IDLE = {"idle": True, "sent": 0, "received": 0, "full": False, "waiting": {}, "due": None}
LEFT = "left: {use: runtime_operators:Counter}"
SUM = "sum: {use: runtime_operators:Sum, inputs: {x: left/fast}}"


class Play:
    """One run. `deaf` processes do nothing any more, as stopped ones; `broken` ones fail when they are set up."""

    def __init__(self, *operators: str, live: bool = False, **options: Any) -> None:
        graph = graph_of(*(operators or (LEFT, SUM)))
        self.plan = RunPlan(graph, live=live, **{"placement": "process_each"} | options)
        self.processes = process_plans(self.plan)
        endpoints = {label: f"tcp/127.0.0.1:{7000 + k}" for k, label in enumerate(self.processes)}
        self.core = core_of(self.plan, self.processes, configurations(self.plan, self.processes, endpoints))
        self.now = 100.0
        self.stood = 0.0
        """Seconds for which the machine stood still: the clock went on, the supervisor's own did not."""
        self.commands: list[Command] = []
        self.over: RunEnded | None = None
        self.deaf: set[str] = set()
        self.broken: set[str] = set()
        self.beating = live
        self.state: Mapping[str, Any] | None = None
        """What processes answer when they are asked how they are; None: they are too busy to answer."""
        self.alive: set[str] = set()
        self.kept: dict[str, list[bytes]] = {}
        self.reached: dict[str, OperatorProgress] = {}
        self._answers: deque[Event] = deque()

    # The clock

    def tell(self, *events: Event) -> list[Command]:
        """Feeds events, and whatever the processes answer; returns the commands that they led to."""
        self._answers.extend(events)
        given: list[Command] = []
        while self._answers:
            for command in self.core.handle(self._answers.popleft(), Moment(self.now, WALL + self.now + self.stood)):
                given.append(command)
                self._do(command)
                self.commands.append(command)
        return given

    def wait(self, seconds: float) -> list[Command]:
        """Lets time pass, in ticks."""
        given: list[Command] = []
        until = self.now + seconds
        while self.now < until and self.over is None:
            self.now += STEP
            if self.beating and self.core.run.under_way:
                given += self.tell(*(self.beat(label) for label in self.processes if self.works(label)))
            given += self.tell(Tick())
        return given

    def works(self, label: str) -> bool:
        return label in self.alive and label not in self.deaf and not label.startswith("@")

    def beat(self, label: str, work: tuple[str, int, float] | None = None) -> Received:
        return Received(label, "beat", {"memory": 1, "work": work})

    # What processes do

    def _do(self, command: Command) -> None:
        match command:
            case Spawn(label):
                if label in spawned(self.commands):  # a new process, not the stopped one
                    self.deaf.discard(label)
                self.alive.add(label)
            case Signal(label, signal.SIGKILL) if label in self.alive:
                self.dies(label, -9)
            case Send(label, kind, fields) if label in self.alive and label not in self.deaf:
                self._answers.extend(self._answer(label, kind, fields))
            case RunEnded():
                assert self.over is None
                self.over = command

    def dies(self, label: str, code: int) -> None:
        self._answers.extend(self._ends(label, code))

    def _ends(self, label: str, code: int) -> list[Event]:
        """A process ends; in a live run, what it has kept of its firing records is read."""
        self.alive.discard(label)
        nodes = self.processes[label].nodes
        remains = RecoveredRecords(
            {n: self.kept.pop(n, []) for n in nodes}, {n: self.reached.get(n, OperatorProgress()) for n in nodes}
        )
        return [*([RecordsRecovered(label, remains)] if self.plan.live and nodes else []), Exited(label, code)]

    def keeps(self, *records: FiringRecord) -> None:
        """Operators write these into the black boxes of their processes."""
        for record in records:
            self.kept.setdefault(record.operator, []).append(encode_batch([record]))
            self.reached.setdefault(record.operator, OperatorProgress()).take(
                record, tuple(self.plan.graph.nodes[record.operator].outputs)
            )

    def _answer(self, label: str, kind: str, fields: Mapping[str, Any]) -> list[Event]:
        match kind:
            case "operators" | "sink" if label in self.broken:
                return [self.failed(label, "setup()")]
            case "operators" | "sink":
                return [Received(label, "joined", {}), Received(label, "ready", {"first": None, "steps": None})]
            case "probe":
                return [
                    Received(other, "seen", {"stream": stream})
                    for other in self.processes
                    if other in self.alive and other not in self.deaf
                    for stream in self.processes[label].publish
                ]
            case "poll" if self.state is not None:
                return [Received(label, "state", IDLE | self.state | {"round": fields["round"]})]
            case "leave":
                return [Received(label, "closed", {"facts": {}}), *self._ends(label, 0)]
        return []

    def failed(self, label: str, when: str) -> Received:
        fields = {"operator": label, "when": when, "summary": "RuntimeError: no camera", "traceback": "…"}
        fields["where"] = "driver.py:7"
        return Received(label, "failed", fields)

    def progress(self, label: str, done: Mapping[str, int] | None = None, **more: Any) -> Received:
        done = done or {}
        counts = {name: [1, 1, 0, 0, stamp] for name, stamp in done.items()}
        return Received(label, "progress", {"done": done, "counts": counts, **more})

    def ended(self, label: str) -> Received:
        """A process has ended, having heard everything that it was told to expect."""
        expected = self.core.run.processes[label].expected
        return Received(
            label, "ended", {"report": {"counts": {}, "streams": {}, "transport": {}, "expected": expected}}
        )

    # Scenes

    def begins(self) -> None:
        self.tell(RunStarted())

    def starts(self) -> Play:
        self.begins()
        self.wait(2 * STEP)
        assert self.core.status.phase == "running", self.over
        return self

    def stops(self) -> list[Command]:
        return self.tell(StopRequested())

    def ends(self) -> RunReport:
        """All processes hand in their reports, and the run closes."""
        self.tell(*(self.ended(label) for label in self.processes))
        self.wait(5.0)
        return self.report

    @property
    def report(self) -> RunReport:
        """The report of a run that has ended in order."""
        assert self.over is not None
        assert self.over.report is not None
        return self.over.report

    @property
    def failed_by(self) -> RunFailed:
        """The failure of a run that has ended early."""
        assert self.over is not None
        assert self.over.failure is not None
        return self.over.failure

    def failure(self) -> str:
        return str(self.failed_by)


def sent(commands: list[Command], kind: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Returns to whom messages of a kind were sent, and their fields."""
    return [(c.label, c.fields) for c in commands if isinstance(c, Send) and c.kind == kind]


def spawned(commands: list[Command]) -> list[str]:
    return [c.label for c in commands if isinstance(c, Spawn)]


def asked_where(commands: list[Command]) -> list[str]:
    return [c.label for c in commands if isinstance(c, Signal) and c.number == ASK]


def killed(commands: list[Command]) -> list[str]:
    return [c.label for c in commands if isinstance(c, Signal) and c.number == signal.SIGKILL]
