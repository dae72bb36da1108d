"""The supervisor of one run: the program around the core. It owns sockets, processes, signals, registry and the clock.

It turns what happens into events, and does what the core commands. No data passes through it, and it waits for no
single process: all it waits for is the next event, or the next tick.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import sys
import time
from collections import deque
from collections.abc import Callable

from dataflow.execution.feeds.playback import Action
from dataflow.execution.threads import environment
from dataflow.process.awake import LONGEST_STEP, AwakeClock
from dataflow.process.channel import ChannelClosed
from dataflow.process.log_pipe import heard, shown
from dataflow.supervision.black_boxes import Boxes
from dataflow.supervision.configs import configurations
from dataflow.supervision.console import Console
from dataflow.supervision.core import commands, events
from dataflow.supervision.core.compose import core_of
from dataflow.supervision.core.report import RunFailed, RunReport, Status
from dataflow.supervision.early_nursery import EarlyNursery
from dataflow.supervision.nursery import Child, End, Nursery, NurseryFailed, adopting
from dataflow.supervision.plan import RunPlan, process_plans
from dataflow.supervision.rings import Rings, pairs_of
from dataflow.transport import registry, reserve_endpoints
from dataflow.transport.log_file import LogFile

TICK = 0.05
PAUSE = 1.0
"""Seconds for which the supervisor did not run, at once, that are worth saying."""
NOT_READING_AFTER = 1.0
"""Seconds for which a process may leave what was sent to it, before the core is notified."""


class Supervisor:
    """Runs one plan. `stop()` may be called from a signal handler; `status` may be read at any time."""

    def __init__(
        self,
        plan: RunPlan,
        *,
        on_output: Callable[[str, str], None] | None = None,
        early: EarlyNursery | None = None,
    ) -> None:
        self.plan = plan
        self._early = early
        self._processes = process_plans(plan)
        self._reserved = reserve_endpoints(len(self._processes))
        self._endpoints = dict(zip(self._processes, self._reserved.endpoints, strict=True))
        self.core = core_of(plan, self._processes, configurations(plan, self._processes, self._endpoints))
        self._on_output = on_output or (lambda label, line: print(f"[{label}] {line}", file=sys.stderr))
        self._children: dict[str, Child] = {}
        self._boxes = Boxes(plan.graph, self._processes, live=plan.live)
        self._taken_at: dict[str, float] = {}  # label → when the process last took what was queued for it
        self._announced = contextlib.ExitStack()
        self._over: commands.Over | None = None
        self._woken, self._waking = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._stops = 0
        self._asked: deque[events.PlaybackAsked | events.TriggerAsked] = deque()

    @property
    def status(self) -> Status:
        return self.core.status

    def stop(self) -> None:
        """Asks for an orderly end: sources stop, everything drains. A second call ends at once."""
        self._stops += 1
        self._wake_up()

    def play(self, action: Action, steps: int = 1, speed: float | None = None) -> None:
        """Pauses, resumes, steps what is not live, or changes its speed; on any thread."""
        self._asked.append(events.PlaybackAsked(action, steps, speed))
        self._wake_up()

    def trigger(self, text: str) -> None:
        """Has the flight recorder keep what was; on any thread."""
        self._asked.append(events.TriggerAsked(text))
        self._wake_up()

    def _wake_up(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):  # full: it will wake up; closed: it is over
            os.write(self._waking, b"!")

    def pid_of(self, label: str) -> int:
        """Returns the process number of a process of the run that is there."""
        pid = self._children[label].pid
        assert pid is not None
        return pid

    def run(self) -> RunReport:
        """Runs to the end. Raises `RunFailed` with the first cause; no process is left in either case."""
        with adopting(), contextlib.ExitStack() as stack:
            stack.callback(self._close_pipe)
            stack.callback(self._reserved.close)
            stack.enter_context(self._announced)
            self._rings = self._make_rings()
            stack.callback(self._rings.close)
            self._log_file = stack.enter_context(contextlib.closing(LogFile()))
            self._words = Console(self._on_output)
            stack.callback(self._words.close)
            self._selector = stack.enter_context(selectors.DefaultSelector())
            self._nursery = self._start_nursery()
            stack.callback(self._bury)
            over = self._loop()
        if over.failure is not None:
            raise over.failure
        assert over.report is not None
        return over.report

    def _make_rings(self) -> Rings:
        try:
            return Rings(list(self._processes), pairs_of(self.plan.graph, self._processes))
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

    def _loop(self) -> commands.Over:
        self._clock = AwakeClock()
        self._selector.register(self._woken, selectors.EVENT_READ, None)
        self._selector.register(self._nursery, selectors.EVENT_READ, self._nursery)
        interrupted: BaseException | None = None
        seen_stops = 0
        self._feed(events.Begin())
        due = 0.0
        while self._over is None:
            try:
                self._wait(max(0.0, due - self._clock()))
                while seen_stops < self._stops:
                    seen_stops += 1
                    self._feed(events.StopAsked())
                while self._asked:
                    self._feed(self._asked.popleft())
                if self._clock() >= due:
                    due = self._clock() + TICK
                    self._tick()
                self._flush()
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

    def _wait(self, timeout: float) -> None:
        """Waits for the next events and feeds them, at most one look at each process."""
        for key, mask in self._selector.select(timeout):
            if key.data is None:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._woken, 4096)
            elif key.data is self._nursery:
                self._hear_nursery()
            else:
                label, what = key.data
                if what == "words":
                    self._read_words(label)
                elif mask & selectors.EVENT_READ:
                    self._read_channel(label)

    def _hear_nursery(self) -> None:
        try:
            news = self._nursery.receive()
        except NurseryFailed as failure:
            self._selector.unregister(self._nursery)
            self._feed(events.Aborted(str(failure)))
            return
        for each in news:
            if isinstance(each, End):
                self._ended(self._label(each.child), each.code)
            else:
                self._feed(events.LeftBehind(tuple(map(self._label, each.children)), each.processes))

    def _label(self, process: Child) -> str:
        return next(label for label, child in self._children.items() if child is process)

    def _ended(self, label: str, code: int | None) -> None:
        """A process has ended: what it has said and printed until then comes first."""
        child = self._children[label]
        with contextlib.suppress(ChannelClosed):
            while self._read_messages(label, child):
                pass
        self._read_words(label)
        self._unregister(child)
        for line in child.close():
            self._heard(label, line)
        del self._children[label]
        self._taken_at.pop(label, None)
        if (remains := self._boxes.read(label)) is not None:
            self._feed(events.Remained(label, remains))
        self._feed(events.Died(label, code))

    def _read_channel(self, label: str) -> None:
        child = self._children.get(label)
        if child is None:
            return
        try:
            self._read_messages(label, child)
        except ChannelClosed:
            with contextlib.suppress(KeyError):
                self._selector.unregister(child.channel)
            self._feed(events.HungUp(label))

    def _read_messages(self, label: str, child: Child) -> bool:
        """Feeds what a process has said; False when there was nothing."""
        any_read = False
        for kind, fields in child.channel.receive():
            any_read = True
            self._feed(events.Said(label, kind, fields))
        return any_read

    def _read_words(self, label: str) -> None:
        child = self._children.get(label)
        if child is None or child.words is None:
            return
        descriptor = child.words
        for line in child.lines():
            self._heard(label, line)
        if child.words is None:
            self._selector.unregister(descriptor)

    def _heard(self, label: str, line: str) -> None:
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
            self._feed(events.Paused(lost + LONGEST_STEP))
        now, deserted = self._clock(), not self._nursery_lives
        for label, child in list(self._children.items()):
            stuck = now - self._taken_at.get(label, now)
            if stuck > NOT_READING_AFTER or child.channel.overflowed:
                waiting, overflowed = child.channel.waiting, child.channel.overflowed
                self._feed(events.NotReading(label, stuck, waiting, overflowed))
            if deserted and child.dead:
                self._ended(label, child.bury())
        self._feed(events.Tick())

    @property
    def _nursery_lives(self) -> bool:
        return self._nursery in {key.fileobj for key in self._selector.get_map().values()}

    # Commands

    def _do(self, command: commands.Command) -> None:
        match command:
            case commands.Send(label, kind, fields, replaces):
                if (child := self._children.get(label)) is not None:
                    child.channel.send(kind, dict(fields), replaces=replaces)
            case commands.Spawn(label):
                self._spawn(label)
            case commands.Signal(label, number):
                if (child := self._children.get(label)) is not None:
                    child.signal(number)
            case commands.Announce(labels):
                graph = self.plan.graph
                endpoints = [self._endpoints[label] for label in labels]
                self._announced.enter_context(
                    registry.register(graph.name, graph.namespace, endpoints, graph=graph.to_json())
                )
            case commands.Withdraw():
                self._announced.close()
            case commands.Over():
                self._over = command

    def _spawn(self, label: str) -> None:
        try:
            box = self._boxes.make(label)
            child = self._nursery.spawn((*self._rings.handed(label), *box))
        except (NurseryFailed, OSError) as failure:
            self._feed(events.Aborted(str(failure)))
            return
        self._children[label] = child
        self._taken_at[label] = self._clock()
        self._selector.register(child.channel, selectors.EVENT_READ, (label, "channel"))
        assert child.words is not None
        self._selector.register(child.words, selectors.EVENT_READ, (label, "words"))

    def _flush(self) -> None:
        """Sends what processes take; who takes nothing is looked at again when it does."""
        now = self._clock()
        for label, child in self._children.items():
            channel = child.channel
            if not channel.waiting:
                self._taken_at[label] = now
                continue
            try:
                if channel.flush():
                    self._taken_at[label] = now
            except ChannelClosed:
                continue  # its end is read, with its cause
            self._watch_for_room(label, child)

    def _watch_for_room(self, label: str, child: Child) -> None:
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if child.channel.waiting else 0)
        key = self._selector.get_map().get(child.channel)
        if key is not None and key.events != wanted:
            self._selector.modify(child.channel, wanted, (label, "channel"))

    # End

    def _unregister(self, child: Child) -> None:
        for thing in (child.channel, child.words):
            if thing is not None:
                with contextlib.suppress(KeyError):
                    self._selector.unregister(thing)

    def _bury(self) -> None:
        """Leaves no process behind, however the run has ended."""
        for child in self._children.values():
            child.signal(signal.SIGKILL)
        self._nursery.close()
        for child in self._children.values():
            self._unregister(child)
            child.close()
        self._children.clear()
        self._boxes.close()

    def _close_pipe(self) -> None:
        os.close(self._woken)
        os.close(self._waking)
