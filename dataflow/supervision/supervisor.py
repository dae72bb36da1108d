"""The supervisor of one run: the program around the core. It owns sockets, processes, signals, registry and the clock.

It turns what happens into events, and does what the core commands. No data passes through it, and it waits for no
single process: all it waits for is the next event, or the next tick.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from dataflow.environments import EnvError
from dataflow.execution.feeds.playback import Action
from dataflow.execution.threads import environment
from dataflow.process.awake_clock import LONGEST_STEP, AwakeClock
from dataflow.process.log_pipe import heard, shown
from dataflow.supervision.black_boxes import Boxes
from dataflow.supervision.children import Children
from dataflow.supervision.configs import configurations
from dataflow.supervision.console import Console
from dataflow.supervision.core import commands, events
from dataflow.supervision.core.compose import core_of
from dataflow.supervision.core.report import RunFailed, RunReport, Status
from dataflow.supervision.early_nursery import EarlyNursery
from dataflow.supervision.links import Links, Pairs, pairs_of
from dataflow.supervision.nursery import Nursery, adopting, nurseries_of
from dataflow.supervision.plan import LINK, RECORDER, RunPlan, process_plans
from dataflow.transport import Reservation, registry
from dataflow.transport.log_file import LogFile

if TYPE_CHECKING:
    from dataflow.supervision.remote import Remote

TICK = 0.05
PART_WITHIN = 4.0
"""Seconds for which other machines are notified that the run is over."""
PAUSE = 1.0
"""Seconds for which the supervisor did not run, at once, that are worth saying."""


class Supervisor:
    """Runs one plan. `stop()` may be called from a signal handler; `status` may be read at any time."""

    def __init__(
        self, plan: RunPlan, *, on_output: Callable[[str, str], None] | None = None, early: EarlyNursery | None = None
    ) -> None:
        self.plan = plan
        self._early = early
        self._processes = process_plans(plan)
        labels = [*self._processes, *([LINK] if any(p.machine for p in self._processes.values()) else ())]
        self._reserved = Reservation(len(labels))
        self._endpoints = dict(zip(labels, self._reserved.endpoints, strict=True))
        self.core = core_of(plan, self._processes, configurations(plan, self._processes, self._endpoints))
        self._on_output = on_output or (lambda label, line: print(f"[{label}] {line}", file=sys.stderr))
        self._announced = contextlib.ExitStack()
        self._over: commands.RunEnded | None = None
        self._woken, self._waking = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._boxes = Boxes(plan.graph, self._processes, live=plan.live)
        self._remote: Remote | None = None
        self._stops = 0
        self._asked: deque[events.PlaybackRequested | events.TriggerRequested] = deque()

    @property
    def status(self) -> Status:
        return self.core.status

    def stop(self) -> None:
        """Asks for an orderly end: sources stop, everything drains. A second call ends at once."""
        self._stops += 1
        self._wake_up()

    def play(self, action: Action, steps: int = 1, speed: float | None = None) -> None:
        """Pauses, resumes, steps what is not live, or changes its speed; on any thread."""
        self._asked.append(events.PlaybackRequested(action, steps, speed))
        self._wake_up()

    def trigger(self, text: str) -> None:
        """Has the flight recorder save its history; on any thread."""
        self._asked.append(events.TriggerRequested(text))
        self._wake_up()

    def _wake_up(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):  # full: it will wake up; closed: it is over
            os.write(self._waking, b"!")

    def pid_of(self, label: str) -> int:
        """Returns the process number of a process of the run that is there."""
        return self._here.pid_of(label)

    def run(self) -> RunReport:
        """Runs to the end. Raises `RunFailed` with the first cause; no process is left in either case."""
        with adopting(), contextlib.ExitStack() as stack:
            stack.callback(self._close_pipe)
            stack.callback(self._reserved.close)
            stack.enter_context(self._announced)
            pairs = pairs_of(self.plan.graph, self._processes)
            here = [label for label in self._endpoints if label == LINK or self._processes[label].machine is None]
            links = self._make_links(here, pairs)
            stack.callback(links.close)
            self._log_file = stack.enter_context(contextlib.closing(LogFile()))
            self._words = Console(self._on_output)
            stack.callback(self._words.close)
            self._selector = stack.enter_context(selectors.DefaultSelector())
            self._clock = AwakeClock()
            apart = self._nurseries_apart(here)
            self._here = Children(
                self._start_nursery(),
                apart,
                self._selector,
                links,
                self._boxes,
                self._clock,
                self._feed_here,
                self._heard,
            )
            stack.callback(self._here.bury)
            self._selector.register(self._woken, selectors.EVENT_READ, None)
            if LINK in self._endpoints:
                stack.callback(self._part)  # machines that were shown what they need are notified of any end
                self._meet(pairs)
            over = self._loop()
        if over.failure is not None:
            raise over.failure
        assert over.report is not None
        return over.report

    def _make_links(self, here: list[str], pairs: Pairs) -> Links:
        try:
            return Links(here, {pair: keys for pair, keys in pairs.items() if set(pair) <= set(here)})
        except OSError as error:
            raise RunFailed(f"cannot link the processes: {error}; raise the limit of open files (ulimit -n)") from error

    def _start_nursery(self) -> Nursery:
        threads = self.plan.graph.threads
        if self._early is not None and (nursery := self._early.take(threads)) is not None:
            return nursery
        try:
            return Nursery(environment(threads))
        except OSError as error:
            raise RunFailed(f"cannot start a process: {error}") from error

    def _nurseries_apart(self, here: list[str]) -> dict[str, Nursery]:
        envs = {label: self._processes[label].env for label in here if label != LINK}
        try:
            return nurseries_of(envs, environment(self.plan.graph.threads))
        except (OSError, EnvError) as error:
            raise RunFailed(f"cannot start a process: {error}") from error

    def _meet(self, pairs: Pairs) -> None:
        """Waits (bounded) until the other machines of the graph are there and have what they need."""
        from dataflow.supervision.remote import Remote  # most runs need no network

        rendezvous = self.plan.machines
        assert rendezvous is not None
        self._remote = Remote(
            self.plan,
            rendezvous,
            self._processes,
            pairs,
            self._endpoints,
            self._here,
            self._feed,
            self._heard,
            self.core.run.note,
        )
        self.core.run.note(f"waits for {', '.join(self._remote.waits_for)}; on each: {self._remote.advice()}")
        deadline, taken = self._clock() + self.plan.start_timeout, 0
        while self._remote.waits_for:
            self.status.waiting = self._remote.waits_for
            self._wait(TICK)
            self._here.tick()
            self._here.flush()
            if self._remote.taken != taken:  # files may take longer than machines get to join
                deadline, taken = self._clock() + self.plan.start_timeout, self._remote.taken
            if self._stops:
                raise RunFailed("stopped while other machines were awaited", interrupted=True)
            if self._clock() > deadline:
                raise self._remote.not_ready(self.plan.start_timeout)
        if RECORDER in self.core.run.configs:
            self.core.run.configs[RECORDER][1]["options"]["metadata"].update(self._remote.facts)

    def _part(self) -> None:
        """Lets the other machines go (bounded)."""
        if self._remote is None:
            return
        self._remote.close()
        deadline = self._clock() + PART_WITHIN
        while not self._remote.ended and self._clock() < deadline:
            self._here.flush()
            self._wait(TICK)

    def _hand(self, label: str) -> Children | Remote:
        """Returns what starts, reaches and ends a process."""
        return self._remote if self._remote is not None and label in self._remote.machine_of else self._here

    def _loop(self) -> commands.RunEnded:
        interrupted: BaseException | None = None
        seen_stops = 0
        self._feed(events.RunStarted())
        due = 0.0
        while self._over is None:
            try:
                self._wait(max(0.0, due - self._clock()))
                while seen_stops < self._stops:
                    seen_stops += 1
                    self._feed(events.StopRequested())
                while self._asked:
                    self._feed(self._asked.popleft())
                if self._clock() >= due:
                    due = self._clock() + TICK
                    self._tick()
                self._here.flush()
            except BaseException as error:  # Ctrl-C without a handler, or a fault of the core: end in order, once
                if interrupted is not None:
                    raise
                interrupted = error
                self._feed(events.Aborted("the supervisor was interrupted"))
        if interrupted is not None:
            raise interrupted
        return self._over

    # Events

    def _feed(self, event: events.Event) -> None:
        for command in self.core.handle(event, events.Moment(self._clock(), time.time())):
            self._do(command)

    def _feed_here(self, event: events.Event) -> None:
        """Feeds an event of this machine's processes; the link's are about others."""
        if self._remote is None or getattr(event, "label", "") != LINK:
            self._feed(event)
            return
        try:
            self._remote.take(event)
        except RunFailed as failure:
            if self._remote.ending:
                return
            if self.core.run.release is None and self._remote.waits_for:
                raise
            self._feed(events.Aborted(str(failure)))

    def _wait(self, timeout: float) -> None:
        """Waits for the next events and feeds them, at most one look at each process."""
        for key, mask in self._selector.select(timeout):
            if key.data is None:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._woken, 4096)
            else:
                self._here.look(key, mask)

    def _heard(self, label: str, line: str) -> None:
        if label == LINK:
            self._words.put(label, line)
            return
        said = heard(line, label, self._processes[label].nodes)
        self._log_file.add(said)
        first, *more = shown(said)
        self._words.put(label, first)
        self._feed(events.Printed(label, first, said))
        for each in more:
            self._words.put(label, each)
            self._feed(events.Printed(label, each))

    def _tick(self) -> None:
        if (lost := self._clock.take_lost()) > PAUSE:
            self._feed(events.Paused(lost + LONGEST_STEP, lost))
        self._here.tick()
        self._feed(events.Tick())

    # Commands

    def _do(self, command: commands.Command) -> None:
        match command:
            case commands.Send(label, kind, fields, replaces):
                self._hand(label).send(label, kind, dict(fields), replaces=replaces)
            case commands.Spawn(label):
                self._hand(label).spawn(label)
            case commands.Signal(label, number):
                self._hand(label).signal(label, number)
            case commands.Announce(labels):
                graph = self.plan.graph
                reached = [LINK] if self._remote is not None else labels
                endpoints = [self._endpoints[label] for label in reached]
                self._announced.enter_context(
                    registry.register(graph.name, graph.namespace, endpoints, graph=graph.to_json())
                )
            case commands.Withdraw():
                self._announced.close()
            case commands.RunEnded():
                self._over = command

    # End

    def _close_pipe(self) -> None:
        os.close(self._woken)
        os.close(self._waking)
