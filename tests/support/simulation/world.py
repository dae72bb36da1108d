"""Simulated time, and the tasks that share it: one runs at a time, and a seed decides which is next.

A task is a thread of a simulated process: code that ships, on a stack of its own (a greenlet), so that it may wait in
the middle of a function. It gives way where it waits, and now and then where it calls the operating system. There, too,
its process may be killed: what it has done so far has happened, and what follows has not.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from typing import Any

from greenlet import getcurrent, greenlet

EPOCH = 1_700_000_000.0
"""The wall clock (s) when a world begins."""
MOST_CALLS = 1_700_000
"""Calls that a task may make without ever waiting: one that makes more spins. The longest pause leaves 160,000 ticks of
the quickest timer to be dropped or made up for, at some ten calls each."""
READING = 1e-6
"""Seconds that pass when a task looks at the clock: a loop that only waits for it comes to an end."""


class Killed(BaseException):
    """Unwinds the tasks of a process that was killed; nothing that they do on the way has any effect."""


class Violation(AssertionError):
    """The engine has broken a promise."""


class Process:
    """A process as the machine knows it. What belongs to it and ends with it is closed by `closers`."""

    def __init__(self, label: str, pid: int) -> None:
        self.label, self.pid = label, pid
        self.tasks: list[Task] = []
        self.closers: list[Callable[[], None]] = []
        self.thawed: list[Callable[[], None]] = []
        self.dead = False
        self.frozen = False
        self.ahead = 0.0
        """Seconds by which its machine's wall clock is ahead."""
        self.effects = 0
        """Calls that others can see: what it has sent, written, or put where it outlives it."""
        self.dies_at: int | None = None
        """The one of those before which it is killed."""
        self.on_line: Callable[[str], None] = lambda text: None
        """Takes what it prints."""
        self.on_end: Callable[[int], None] = lambda code: None


class Task:
    """A thread of a process. `turn` numbers its waits: what would end an earlier one comes too late."""

    __slots__ = ("calls", "due", "name", "process", "stack", "turn", "waits", "woken")

    def __init__(self, name: str, process: Process, stack: greenlet) -> None:
        self.name, self.process, self.stack = name, process, stack
        self.turn = self.calls = 0
        self.waits = True
        self.woken = False
        self.due = False

    @property
    def over(self) -> bool:
        return bool(self.stack.dead)


class World:
    """One simulated machine. `pace` stretches how long everything takes to be noticed."""

    def __init__(self, seed: int, *, pace: float = 1.0, preempt: float = 0.02) -> None:
        self.random = random.Random(seed)
        self.now = 0.0
        self.calls = self.turns = 0
        self.task: Task | None = None
        self.violation: Violation | None = None
        self.processes: list[Process] = []
        self._pace, self._preempt = pace, preempt
        self._events: list[tuple[float, int, Callable[[], Any]]] = []
        self._number = 0
        self._hub = getcurrent()
        self._chance = self.random.random

    # Events

    def at(self, when: float, action: Callable[[], Any]) -> None:
        """Does something at a time."""
        self._number += 1
        heapq.heappush(self._events, (when, self._number, action))

    def after(self, delay: float, action: Callable[[], Any]) -> None:
        self.at(self.now + delay, action)

    def run(self, over: Callable[[], bool], limit: float) -> None:
        """Lets time pass until `over`. Raises `Violation` when nothing ever happens again, or not within `limit` s."""
        while not over():
            if not self._events:
                raise Violation(f"nothing happens any more at {self.now:.3f} s")
            when, _, action = heapq.heappop(self._events)
            if when > self.now:
                self.now = when
            if self.now > limit:
                raise Violation(f"not over within {limit:g} s")
            action()
            if self.violation is not None:
                raise self.violation

    def latency(self) -> float:
        """How long it takes until something is noticed (s): mostly little, now and then long."""
        chance = self._chance()
        if chance < 0.97:
            return self._pace * 1e-4 * chance * chance
        return self._pace * 0.02 * self._chance() ** 3

    # Tasks

    def start(self, name: str, process: Process, function: Callable[[], Any]) -> Task:
        """Starts a thread of a process, soon."""
        task = Task(name, process, greenlet(lambda: _guarded(process, name, function), parent=self._hub))
        process.tasks.append(task)
        self._resume_after(task, self.latency())
        return task

    def wait(self, timeout: float | None = None) -> bool:
        """Waits, in a task, until it is woken (True) or so many seconds have passed."""
        task = self._running()
        task.calls = 0
        return self._park(task, timeout)

    def wake(self, task: Task) -> None:
        """Ends the wait of a task, soon."""
        if task.waits and not task.woken:
            task.woken = True
            self._resume_after(task, self.latency())

    def call(self) -> None:
        """To be called where a task calls the operating system: here it may give way, or be killed."""
        task = self.task
        if task is None:
            return
        process = task.process
        if process.dead:
            raise Killed
        self.calls += 1
        task.calls += 1
        if task.calls > MOST_CALLS:
            self.violation = Violation(f"{process.label}: its task {task.name!r} spins")
            self.kill(process)
            raise Killed
        if self._chance() < self._preempt:
            self._park(task, self.latency())

    def effect(self) -> None:
        """To be called before a task does what others can see: here its process may be killed."""
        task = self.task
        if task is None:
            return
        self.call()
        process = task.process
        process.effects += 1
        if process.effects == process.dies_at:
            self.kill(process)
            raise Killed

    def clock(self) -> float:
        """The time, as a task reads it."""
        self.call()
        self.now += READING
        return self.now

    def _running(self) -> Task:
        task = self.task
        assert task is not None, "only a task can wait"
        if task.process.dead:
            raise Killed
        return task

    def _park(self, task: Task, timeout: float | None) -> bool:
        task.turn += 1
        task.waits, task.woken = True, False
        if timeout is not None:
            self._resume_after(task, max(0.0, timeout))
        self._hub.switch()
        if task.process.dead:
            raise Killed
        return task.woken

    def _resume_after(self, task: Task, delay: float) -> None:
        turn = task.turn
        self.at(self.now + delay, lambda: self._resume(task, turn))

    def _resume(self, task: Task, turn: int) -> None:
        if task.turn != turn or not task.waits or task.over:
            return
        if task.process.frozen:
            task.due = True
            return
        self.turns += 1
        task.waits = task.due = False
        before, self.task = self.task, task
        try:
            task.stack.switch()
        finally:
            self.task = before

    # Processes

    def process(self, label: str) -> Process:
        process = Process(label, 1000 + len(self.processes))
        self.processes.append(process)
        return process

    def freeze(self, process: Process) -> None:
        process.frozen = True

    def thaw(self, process: Process) -> None:
        """Lets a process go on: what would have happened meanwhile happens now."""
        if not process.frozen:
            return
        process.frozen = False
        for task in process.tasks:
            if task.due:
                self._resume_after(task, self.latency())
        for action in process.thawed:
            action()

    def kill(self, process: Process) -> None:
        """Kills a process, as SIGKILL does."""
        self.end(process, -9)

    def end(self, process: Process, code: int) -> None:
        """A process is over, with all its threads; its parent hears of it later."""
        if process.dead:
            return
        process.dead, process.frozen = True, False
        for close in process.closers:
            close()
        self.at(self.now, lambda: self._unwind(process))
        process.on_end(code)

    def _unwind(self, process: Process) -> None:
        for task in process.tasks:
            if not task.over:
                before, self.task = self.task, task
                try:
                    task.stack.throw(Killed)
                except Killed:
                    pass
                finally:
                    self.task = before
        process.tasks.clear()

    def close(self) -> None:
        """Ends everything."""
        for process in self.processes:
            process.dead = True
            self._unwind(process)
        self._events.clear()


def _guarded(process: Process, name: str, function: Callable[[], Any]) -> None:
    """A thread's own end: an exception that nobody takes is printed."""
    try:
        function()
    except Killed:
        return
    except BaseException as error:
        if not process.dead:
            process.on_line(f"thread {name!r}: {type(error).__name__}: {error}")
