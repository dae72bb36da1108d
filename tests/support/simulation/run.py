"""One run of the engine on a simulated machine: the supervisor, its processes and the recorder, as they ship."""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

from dataflow.supervision.core.report import RunFailed, RunReport
from dataflow.supervision.nursery import Child
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.run import _metadata
from dataflow.supervision.supervisor import Supervisor
from dataflow.transport import make_ring
from dataflow.transport.keys import local_key, runtime_key
from simulation import bindings, machine, memory, network, operators
from simulation.disk import Disk
from simulation.flights import Flown, Witness
from simulation.processes import SUPERVISOR, Nursery
from simulation.reloading import Files, imported
from simulation.sleep import watched
from simulation.world import Process, Violation, World

LIMIT = 200.0
"""Simulated seconds after which a run hangs: far above the sum of all timeouts, and of what work takes."""
MEGABYTES = 50_000_000
QUICKER = {
    ("dataflow.records.spacing", "CPU_SPACING"): 20_000_000,
    ("dataflow.sinks.flight_recorder", "SHORTEST"): 20_000_000,
    ("dataflow.sinks.outage", "FIRST_PAUSE"): 0.1,
}
"""Constants of the engine that are for longer runs than those here: between states by CPU time (ns), of a flight
recorder's files (ns of event time), before a full disk is tried again (s)."""
SPLIT_FLUSHES = {("dataflow.sinks.sink", "FLUSH_EVERY"): 0.05}
"""What is written decides when a file is full: here that has to be soon."""
DIAGNOSED = {("dataflow.supervision.core.watchers.diagnostics", "DIAGNOSE_EVERY"): 0.1}
"""How operators fare is told often enough (s) for a flight recorder that is triggered by it."""


@dataclass(frozen=True, slots=True)
class Happening:
    """What happens to a run from outside, `at` so many seconds after its sources were released.

    `pause` freezes the supervisor (for `span` s) and with it the process `target`, or all where that is "*".
    `set` changes the parameters `fields` of the operator `target`, `play` does the `action` to what is not live.
    `reload` has the operator `target` go on with the next revision of its code, `trigger` asks a flight recorder to
    keep what was, `room` gives the disk `bytes` more.
    `kill`, `freeze` (for `span` s) and `kill_before` (before the `effect`-th thing that it does and others can see, of
    the `life`-th process with that label) happen to the process `target`; `stop` asks for an orderly end.
    """

    at: float
    kind: str
    target: str = ""
    fields: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        more = " ".join(f"{name}={value}" for name, value in self.fields.items())
        return " ".join(part for part in (f"{self.at:.4f} s", self.kind, self.target, more) if part)


@dataclass(frozen=True, slots=True)
class Machine:
    """What kind of machine it is: how slow to notice anything, how often threads give way, and its disk."""

    seed: int
    pace: float = 1.0
    preempt: float = 0.02
    room: int | None = None
    slow_disk: float = 0.0
    socket_room: int = 278
    """Messages that fit into a socket pair: 278 on a real machine, with Linux's defaults."""
    ring_bytes: int = 1 << 20


@dataclass(slots=True)
class Outcome:
    """What came of a run."""

    report: RunReport | None = None
    failure: RunFailed | None = None
    seconds: float = 0.0
    """Simulated seconds that it took."""
    turns: int = 0
    calls: int = 0
    words: list[str] = field(default_factory=list)
    killed: set[str] = field(default_factory=set)
    """Processes that died before their time, whoever killed them."""
    disk_full: bool = False
    disk_busy: float = 0.0
    """Share of the time since the run was stopped in which a write to the disk was on its way."""
    flown: Flown = field(default_factory=Flown)


def simulate(
    plan: RunPlan, machine_: Machine, happenings: Sequence[Happening] = (), *, mode: str = "run", limit: float = LIMIT
) -> Outcome:
    """Runs a plan to its end. Raises `Violation` when it comes to none within `limit` s."""
    return Simulation(plan, machine_, happenings, mode, limit).run()


class Simulation:
    """A world with one run in it."""

    def __init__(
        self, plan: RunPlan, machine_: Machine, happenings: Sequence[Happening], mode: str, limit: float
    ) -> None:
        self.world = World(machine_.seed, pace=machine_.pace, preempt=machine_.preempt)
        self.system = machine.System(self.world, socket_room=machine_.socket_room)
        self._ring_bytes = machine_.ring_bytes
        written = plan.record or plan.flight
        folder = None if written is None else written.parent
        self.disk = Disk(self.world, folder, room=machine_.room, slow=machine_.slow_disk)
        self.outcome = Outcome()
        self._plan, self._happenings, self._mode, self._limit = plan, happenings, mode, limit
        self._supervisor: Supervisor | None = None
        self._stopped: float | None = None
        self._lives: dict[str, int] = {}
        self._served: dict[str, tuple[Process, Callable[[Any], object]]] = {}

    def run(self) -> Outcome:
        interval = sys.getswitchinterval()
        with contextlib.ExitStack() as stack:
            stack.callback(sys.setswitchinterval, interval)
            stack.enter_context(bindings.bound(self._bindings()))
            if self._plan.storage.splitting.size is not None:
                stack.enter_context(bindings.bound(SPLIT_FLUSHES))
            if self._plan.flight is not None:
                stack.enter_context(bindings.bound(DIAGNOSED))
            stack.enter_context(watched(self.world))
            stack.enter_context(contextlib.redirect_stderr(_Words(self)))
            stack.enter_context(contextlib.redirect_stdout(_Words(self)))
            time = machine.Time(self.world)
            before = operators.Effort.sleep, operators.Effort.now
            operators.Effort.sleep, operators.Effort.now = time.sleep, time.time
            stack.callback(_restore_effort, *before)
            stack.callback(self.world.close)
            self._play()
        world = self.world
        self.outcome.seconds, self.outcome.turns, self.outcome.calls = world.now, world.turns, world.calls
        self.outcome.disk_full = self.disk.full
        if self._stopped is not None and world.now > self._stopped:
            self.outcome.disk_busy = self.disk.busy(self._stopped) / (world.now - self._stopped)
        return self.outcome

    def _play(self) -> None:
        plan = self._plan
        if plan.keeps_records:
            plan = replace(plan, metadata=_metadata(plan, self._mode))
        self._supervisor = Supervisor(plan, on_output=lambda label, line: self.outcome.words.append(f"{label}: {line}"))
        process = self.world.process(SUPERVISOR)
        process.on_line = lambda line: self.outcome.words.append(line)
        ended: list[bool] = []
        self.world.start("main", process, lambda: self._supervise(ended))
        self.world.run(lambda: bool(ended), self._limit)

    def _released(self, *_: Any, **__: Any) -> Any:
        """The graph is announced: its sources are released."""
        for happening in self._happenings:
            self.world.after(happening.at, functools.partial(self._happen, happening))
        return contextlib.nullcontext()

    def _supervise(self, ended: list[bool]) -> None:
        assert self._supervisor is not None
        try:
            self.outcome.report = self._supervisor.run()
        except RunFailed as failure:
            self.outcome.failure = failure
        except Exception as error:
            self.world.violation = Violation(f"the supervisor failed: {type(error).__name__}: {error}")
            self.world.violation.__cause__ = error
        ended.append(True)

    def _bindings(self) -> bindings.Bindings:
        world, system = self.world, self.system
        time, threads = machine.Time(world), machine.Threading(world)
        process, supervision = "dataflow.process", "dataflow.supervision"
        endpoints = SimpleNamespace(close=lambda: None)
        facts: dict[str, Any] = {"threads": {}}
        return {
            **dict.fromkeys(bindings.clocks(), time),
            (f"{supervision}.process_main", "threading"): threads,
            (f"{supervision}.process_main", "os"): system,
            (f"{supervision}.process_main", "show_name"): _nothing,
            ("dataflow.sinks.freed_memory", "keep_freed_memory"): _nothing,
            (f"{process}.channel", "socket"): machine.Sockets(system),
            (f"{process}.channel", "threading"): threads,
            (f"{process}.watchdog", "threading"): threads,
            (f"{process}.watchdog", "psutil"): SimpleNamespace(Process=_Resident, Error=OSError),
            (f"{process}.live_sources", "threading"): threads,
            (f"{process}.streams.inbox", "os"): system,
            (f"{process}.streams.inbox", "select"): machine.Select(system),
            (f"{process}.streams.inbox", "threading"): threads,
            (f"{process}.polling", "select"): machine.Select(system),
            (f"{process}.operator_process", "Bus"): lambda config: network.Bus(world, self._served),
            (f"{process}.operator_process", "TapServer"): network.Nobody,
            (f"{process}.operator_process", "OutsidePublisher"): network.Nobody,
            (f"{process}.operator_process", "leave_network"): _nothing,
            (f"{process}.build", "BlackBox"): memory.black_box(world),
            ("dataflow.transport.links", "RingWriter"): memory.ring_writer(world),
            ("dataflow.transport.ring", "os"): system,
            ("dataflow.transport.fanout", "os"): SimpleNamespace(sched_yield=_nothing),  # greenlets need no core
            (f"{supervision}.links", "os"): system,
            (f"{supervision}.links", "make_ring"): functools.partial(make_ring, self._ring_bytes),
            (f"{process}.operator_process", "limit_threads"): _nothing,
            ("dataflow.sinks.sink", "let_others_begin"): _nothing,
            (f"{process}.operator_process", "gc"): SimpleNamespace(freeze=lambda: None),  # processes end here
            (f"{supervision}.supervisor", "os"): system,
            (f"{supervision}.supervisor", "selectors"): machine.Selectors(system),
            (f"{supervision}.supervisor", "Nursery"): lambda environment: Nursery(system, self._named, self._born),
            (f"{supervision}.supervisor", "Console"): _Shown,
            (f"{supervision}.supervisor", "LogFile"): _NoLog,
            (f"{supervision}.supervisor", "registry"): SimpleNamespace(register=self._released),
            (f"{supervision}.supervisor", "Reservation"): lambda number: _reserved(endpoints, number),
            (f"{supervision}.supervisor", "environment"): _nothing,
            (f"{supervision}.nursery", "os"): system,
            (f"{supervision}.nursery", "signal"): machine.Signals(system),
            ("dataflow.process.descriptors", "BACKLOG"): (1, 1),
            (f"{supervision}.run", "machine_facts"): lambda environment: facts,
            ("dataflow.recording.mcap.container", "os"): self.disk,
            ("dataflow.recording.parts", "os"): self.disk,
            ("dataflow.sinks.outage", "os"): self.disk,
            ("dataflow.graph.model", "import_operator"): imported,
            ("dataflow.sinks.flight_recorder", "FlightSink"): functools.partial(Witness, self.outcome.flown),
            ("dataflow.sinks.flight_files", "queue"): machine.Queue(world),
            ("dataflow.sinks.flight_files", "threading"): threads,
            **QUICKER,
            ("dataflow.execution.source", "Tripwire"): _NoTripwire,
        }

    # Processes

    def _named(self, child: Child) -> str:
        assert self._supervisor is not None
        return next(label for label, each in self._supervisor._here._children.items() if each is child)

    def _born(self, process: Process) -> None:
        life = self._lives[process.label] = self._lives.get(process.label, 0) + 1
        for happening in self._happenings:
            fields = happening.fields
            if happening.kind == "kill_before" and happening.target == process.label and fields["life"] == life:
                process.dies_at = fields["effect"]
        end = process.on_end

        def ended(code: int) -> None:
            if code:
                self.outcome.killed.add(process.label)
            end(code)

        process.on_end = ended

    def _happen(self, happening: Happening) -> None:
        world, fields = self.world, happening.fields
        process = next((p for p in world.processes if p.label == happening.target and not p.dead), None)
        match happening.kind:
            case "stop":
                assert self._supervisor is not None
                self._stopped = world.now if self._stopped is None else self._stopped
                self._supervisor.stop()
            case "play":
                assert self._supervisor is not None
                self._supervisor.play(**fields)
            case "set":
                for name, value in fields.items():
                    key = runtime_key(self._plan.graph.namespace, "param", happening.target)
                    self._ask(key, {"name": name, "value": value})
            case "reload":
                Files.change()
                self._ask(local_key(self._plan.graph.namespace, "reload", happening.target), {"reload": True})
            case "trigger":
                assert self._supervisor is not None
                self._supervisor.trigger("asked for")
            case "room":
                self.disk.grow(fields["bytes"])
            case "kill" if process is not None:
                world.kill(process)
            case "freeze" if process is not None:
                world.freeze(process)
                world.after(fields["span"], lambda: world.thaw(process))
            case "pause":
                labels = {SUPERVISOR, happening.target}
                alive = [p for p in world.processes if not p.dead]
                for each in [p for p in alive if happening.target == "*" or p.label in labels]:
                    world.freeze(each)
                    world.after(fields["span"], functools.partial(world.thaw, each))

    def _ask(self, key: str, fields: Mapping[str, Any]) -> None:
        """Has the process that serves a key, if it lives, answer a request, as Zenoh's thread would."""
        process, answer = self._served.get(key, (None, None))
        if process is not None and not process.dead and answer is not None:
            self.world.start("zenoh", process, functools.partial(answer, network.Query(dict(fields))))


class _Words:
    """`sys.stdout` and `sys.stderr`: what a process prints is its own."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation

    def write(self, text: str) -> int:
        task = self._simulation.world.task
        for line in text.splitlines():
            if task is None:
                self._simulation.outcome.words.append(line)
            elif not task.process.dead:
                task.process.on_line(line)
        return len(text)

    def flush(self) -> None:
        """Nothing is kept back."""

    def fileno(self) -> int:
        raise OSError("no file")


class _NoLog:
    """Stands for the log that tools follow: nobody does."""

    def add(self, line: object) -> None:
        """Keeps nothing."""

    def close(self) -> None:
        """Has nothing to remove."""


class _Shown:
    """The supervisor's words, shown at once."""

    def __init__(self, show: Any) -> None:
        self.put = show

    def close(self) -> None:
        """Everything is shown."""


class _Resident:
    """A process as psutil shows it."""

    def memory_info(self) -> Any:
        return SimpleNamespace(rss=MEGABYTES)


class _NoTripwire:
    """Processes of a real machine do not share generators; here all do, and each call seeds them anew."""

    def set(self) -> None:
        """Nothing is compared."""

    def check(self, source: str) -> None:
        """Nothing is compared."""


def _nothing(*_: Any, **__: Any) -> dict[str, str]:
    return {}


def _reserved(reserved: Any, number: int) -> Any:
    reserved.endpoints = [f"tcp/127.0.0.1:{7000 + k}" for k in range(number)]
    return reserved


def _restore_effort(sleep: Any, now: Any) -> None:
    operators.Effort.sleep, operators.Effort.now = staticmethod(sleep), staticmethod(now)
