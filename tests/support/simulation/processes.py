"""The simulated process table: a nursery whose children are processes of the world, each with the `main` that ships."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from dataflow.process.channel import QueuedChannel
from dataflow.supervision.nursery import Child, ChildExited, Orphans
from dataflow.supervision.process_main import main
from simulation.machine import End as PipeEnd
from simulation.machine import Handle, Socket, System, Waiters
from simulation.world import Killed, Process, World

FORKING = 0.003
"""Seconds that it takes to fork, at most."""


class Nursery:
    """Starts processes and hears of their ends."""

    def __init__(self, system: System, named: Callable[[Child], str], born: Callable[[Process], None]) -> None:
        """`named` gives the label of a child, `born` is told of each process before it does anything."""
        self._system, self._world, self._named, self._born = system, system.world, named, born
        self._news: deque[Callable[[], ChildExited | None]] = deque()
        self._changed = Waiters(self._world)
        self.waiters = (self._changed,)
        self.writable = False
        self._descriptor = system.open(self)

    @property
    def readable(self) -> bool:
        return bool(self._news)

    def fileno(self) -> int:
        return self._descriptor

    def spawn(self, handed: Sequence[int] = ()) -> Child:
        channel = QueuedChannel()
        reading, writing = self._system.pipe()
        child = Child(channel, reading.descriptor)
        self._world.after(self._world.random.random() * FORKING, lambda: self._fork(child, reading, writing, handed))
        return child

    def _fork(self, child: Child, reading: PipeEnd, writing: PipeEnd, handed: Sequence[int]) -> None:
        world, theirs = self._world, self._system.things[child.channel.theirs]
        process = world.process(self._named(child))
        handle = Handle(self._system, process)
        assert isinstance(theirs, Socket)
        process.closers += [theirs.close, lambda: self._system.close(writing.descriptor)]
        process.on_line = lambda text: writing.pipe.write(f"{text}\n".encode())
        process.on_end = lambda code: self._tell(lambda: ChildExited(child, code))
        self._tell(lambda: child.born(process.pid, handle.descriptor))
        self._born(process)
        world.start("main", process, lambda: _live(world, process, child.channel.theirs, handed))

    def _tell(self, news: Callable[[], Any]) -> None:
        """Sends the supervisor a message, in order."""

        def arrive() -> None:
            self._news.append(news)
            self._changed.notify()

        self._due = max(getattr(self, "_due", 0.0), self._world.now + self._world.latency())
        self._world.at(self._due, arrive)

    def receive(self) -> list[ChildExited | Orphans]:
        self._world.call()
        found: list[ChildExited | Orphans] = []
        while self._news:
            if (end := self._news.popleft()()) is not None:
                found.append(end)
        return found

    def close(self) -> None:
        for process in self._world.processes:
            if process.label != SUPERVISOR and not process.dead:
                self._world.kill(process)


SUPERVISOR = "supervisor"


def _live(world: World, process: Process, descriptor: int, handed: Sequence[int]) -> None:
    """A process from its first to its last moment."""
    try:
        code = main(descriptor, handed)
    except Killed:
        raise
    except BaseException as error:
        process.on_line(f"{type(error).__name__}: {error}")
        code = 1
    world.end(process, code)
