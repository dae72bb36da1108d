"""The operating system of a simulated machine, as modules of the standard library show it.

The engine's own modules reach clock, threads, sockets, pipes and files through the names `time`, `threading`, `queue`,
`select`, `selectors`, `socket`, `os`. For a run in a world these names stand for what is defined here; nothing else of
the code that ships is replaced, but for the network, the nursery and what a run asks of the real machine.
"""

from __future__ import annotations

import math
import os
import queue
import select
import selectors
import signal
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

from dataflow.process.stacks import ASK
from simulation.world import EPOCH, Process, Task, World

FIRST = 1_000_000
"""Descriptors from here on are the simulated machine's."""
PIPE_BYTES = 212_992
"""Bytes that a socket holds by Linux's defaults."""
OVERHEAD = 704
"""Bytes that Linux adds to each message, however small."""
T = TypeVar("T")


class Waiters:
    """The tasks that wait for one thing to change."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._tasks: list[Task] = []

    def wait(self, timeout: float | None = None) -> bool:
        task = self._world.task
        assert task is not None
        self._tasks.append(task)
        try:
            return self._world.wait(timeout)
        finally:
            if task in self._tasks:
                self._tasks.remove(task)

    def wait_until(self, ready: Callable[[], T], timeout: float | None = None) -> T:
        """Waits until something is true, or the time is up; returns it."""
        until = math.inf if timeout is None else self._world.now + timeout
        while not (found := ready()) and self._world.now < until:
            self.wait(None if until == math.inf else until - self._world.now)
        return found

    def add(self, task: Task) -> None:
        self._tasks.append(task)

    def discard(self, task: Task) -> None:
        if task in self._tasks:
            self._tasks.remove(task)

    def notify(self) -> None:
        for task in self._tasks:
            self._world.wake(task)


class Time:
    """The module `time`."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.monotonic = self.perf_counter = world.clock

    def time(self) -> float:
        task = self._world.task
        return EPOCH + self._world.clock() + (0.0 if task is None else task.process.ahead)

    def time_ns(self) -> int:
        return round(self.time() * 1e9)

    def monotonic_ns(self) -> int:
        return round(self._world.clock() * 1e9)

    def perf_counter_ns(self) -> int:
        return round(self._world.now * 1e9)

    thread_time_ns = perf_counter_ns

    def process_time(self) -> float:
        """Calls take time here, but no CPU's."""
        return 0.0

    def sleep(self, seconds: float) -> None:
        self._world.call()
        until = self._world.now + seconds
        while self._world.now < until:
            self._world.wait(until - self._world.now)


class Lock:
    """`threading.Lock`: held across a wait, others wait for it."""

    def __init__(self, world: World) -> None:
        self._held = False
        self._waiters = Waiters(world)

    def acquire(self, blocking: bool = True) -> bool:
        while self._held:
            if not blocking:
                return False
            self._waiters.wait()
        self._held = True
        return True

    def release(self) -> None:
        self._held = False
        self._waiters.notify()

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, *error: object) -> None:
        self.release()


class Event:
    """`threading.Event`."""

    def __init__(self, world: World) -> None:
        self._world, self._set = world, False
        self._waiters = Waiters(world)

    def is_set(self) -> bool:
        return self._set

    def set(self) -> None:
        self._set = True
        self._waiters.notify()

    def wait(self, timeout: float | None = None) -> bool:
        self._world.call()
        return self._waiters.wait_until(self.is_set, timeout)


class Condition:
    """`threading.Condition`, with a lock that its holder may take again."""

    def __init__(self, world: World) -> None:
        self._world, self._lock, self._changed = world, Lock(world), Waiters(world)
        self._holder: Task | None = None
        self._depth = 0

    def __enter__(self) -> None:
        self._world.call()
        if self._holder is not self._world.task:
            self._lock.acquire()
            self._holder = self._world.task
        self._depth += 1

    def __exit__(self, *error: object) -> None:
        self._depth -= 1
        if not self._depth:
            self._holder = None
            self._lock.release()

    def wait_for(self, predicate: Callable[[], bool], timeout: float | None = None) -> bool:
        until = None if timeout is None else self._world.now + timeout
        while not (found := predicate()) and (until is None or self._world.now < until):
            depth, self._depth, self._holder = self._depth, 0, None
            self._lock.release()
            self._changed.wait(None if until is None else until - self._world.now)
            self._lock.acquire()
            self._depth, self._holder = depth, self._world.task
        return found

    def notify_all(self) -> None:
        self._changed.notify()


class Thread:
    """`threading.Thread`: a task of the process that starts it."""

    def __init__(
        self,
        world: World,
        *,
        target: Callable[..., Any],
        args: tuple[Any, ...] = (),
        name: str = "thread",
        daemon: bool = True,
    ) -> None:
        self._world, self._target, self._args, self.name, self.daemon = world, target, args, name, daemon
        self._over = Event(world)

    def start(self) -> None:
        task = self._world.task
        assert task is not None
        self._world.start(self.name, task.process, self._run)

    def _run(self) -> None:
        try:
            self._target(*self._args)
        finally:
            self._over.set()

    def join(self, timeout: float | None = None) -> None:
        self._over.wait(timeout)

    def is_alive(self) -> bool:
        return not self._over.is_set()


class Threading:
    """The module `threading`."""

    TIMEOUT_MAX = threading.TIMEOUT_MAX

    def __init__(self, world: World) -> None:
        self.Lock = lambda: Lock(world)
        self.Event = lambda: Event(world)
        self.Condition = lambda: Condition(world)
        self.Thread = lambda **fields: Thread(world, **fields)


class SimpleQueue:
    """`queue.SimpleQueue`, and with `most` items `queue.Queue`."""

    def __init__(self, world: World, most: float = math.inf) -> None:
        self._world, self._most = world, most
        self._items: deque[Any] = deque()
        self._waiters = Waiters(world)

    def put(self, item: Any) -> None:
        self._world.call()
        while len(self._items) >= self._most:
            self._waiters.wait()
        self._items.append(item)
        self._waiters.notify()

    def get(self, timeout: float | None = None) -> Any:
        self._world.call()
        if not self._waiters.wait_until(lambda: self._items, timeout):
            raise queue.Empty
        item = self._items.popleft()
        if self._most < math.inf:
            self._waiters.notify()
        return item

    def get_nowait(self) -> Any:
        self._world.call()
        if not self._items:
            raise queue.Empty
        return self._items.popleft()

    def empty(self) -> bool:
        return not self._items

    def qsize(self) -> int:
        return len(self._items)


class Queue:
    """The module `queue`."""

    Empty = queue.Empty

    def __init__(self, world: World) -> None:
        self.SimpleQueue = lambda: SimpleQueue(world)
        self.Queue = lambda most: SimpleQueue(world, most)


class Pipe:
    """Bytes on their way from one process to another, in order; `room` bytes fit into it."""

    def __init__(self, world: World, room: int = PIPE_BYTES) -> None:
        self._world, self._room = world, room
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._size = 0
        self._due = 0.0
        self.written_out = self.read_out = False
        """Whether the end that writes, or the one that reads, is closed."""
        self.changed = Waiters(world)

    @property
    def free(self) -> int:
        return max(0, self._room - self._size - OVERHEAD)

    @property
    def readable(self) -> bool:
        if self._chunks:
            return self._chunks[0][0] <= self._world.now
        return self.written_out

    def write(self, data: bytes) -> None:
        self._due = max(self._due, self._world.now + self._world.latency())
        self._chunks.append((self._due, data))
        self._size += len(data) + OVERHEAD
        self._world.at(self._due, self.changed.notify)

    def read(self, most: int) -> bytes:
        """Returns what has arrived; nothing where nothing has, or at the end."""
        parts: list[bytes] = []
        while most and self._chunks and self._chunks[0][0] <= self._world.now:
            due, data = self._chunks.popleft()
            self._size -= OVERHEAD
            if len(data) > most:
                self._chunks.appendleft((due, data[most:]))
                self._size += OVERHEAD
                data = data[:most]
            parts.append(data)
            most -= len(data)
            self._size -= len(data)
        if parts:
            self.changed.notify()
        return b"".join(parts)

    def end_writing(self) -> None:
        """Nothing more comes; what was written can be read by now."""
        self.written_out = True
        self._chunks = deque((self._world.now, data) for _, data in self._chunks)
        self._world.after(self._world.latency(), self.changed.notify)

    def end_reading(self) -> None:
        self.read_out = True
        self.changed.notify()


class Socket:
    """One end of a socket pair."""

    def __init__(self, system: System, incoming: Pipe, outgoing: Pipe) -> None:
        self._system, self._world = system, system.world
        self.incoming, self.outgoing = incoming, outgoing
        self._blocks = True
        self._descriptor = system.open(self)

    @property
    def readable(self) -> bool:
        return self.incoming.readable

    @property
    def writable(self) -> bool:
        return self.outgoing.free > 0 or self.outgoing.read_out

    @property
    def waiters(self) -> tuple[Waiters, ...]:
        return self.incoming.changed, self.outgoing.changed

    def setblocking(self, blocks: bool) -> None:
        self._blocks = blocks

    def set_inheritable(self, inheritable: bool) -> None:
        """Every descriptor is handed down by name here."""

    def detach(self) -> int:
        return self._descriptor

    fileno = detach

    def send(self, data: memoryview | bytes) -> int:
        self._world.effect()
        while True:
            if self.outgoing.read_out:
                raise BrokenPipeError("the other end is closed")
            if room := self.outgoing.free:
                part = bytes(data[:room])
                self.outgoing.write(part)
                return len(part)
            if not self._blocks:
                raise BlockingIOError
            self.outgoing.changed.wait()

    def sendall(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[self.send(rest) :]

    def recv(self, most: int) -> bytes:
        self._world.call()
        while not (data := self.incoming.read(most)):
            if self.incoming.readable:
                return b""
            if not self._blocks:
                raise BlockingIOError
            self.incoming.changed.wait()
        return data

    def close(self) -> None:
        self._system.forget(self._descriptor)
        self.outgoing.end_writing()
        self.incoming.end_reading()


class Sockets:
    """The module `socket`."""

    def __init__(self, system: System) -> None:
        self._system = system

    def socketpair(self) -> tuple[Socket, Socket]:
        one, other = (Pipe(self._system.world, self._system.socket_bytes) for _ in range(2))
        return Socket(self._system, one, other), Socket(self._system, other, one)

    def socket(self, *, fileno: int) -> Any:
        return self._system.things[fileno]


class End:
    """The end of a pipe that is read, or that is written."""

    writable = False

    def __init__(self, system: System, pipe: Pipe, *, reads: bool) -> None:
        self.pipe, self.reads = pipe, reads
        self.descriptor = system.open(self)
        self.waiters = (pipe.changed,)

    @property
    def readable(self) -> bool:
        return self.reads and self.pipe.readable


class System:
    """Descriptors, and the module `os`: what is not here is the real one."""

    def __init__(self, world: World, *, socket_room: int = 278) -> None:
        self.world = world
        self.socket_bytes = socket_room * PIPE_BYTES // 278
        self.things: dict[int, Any] = {}
        self._next = FIRST

    def open(self, thing: Any) -> int:
        self._next += 1
        self.things[self._next] = thing
        return self._next

    def forget(self, descriptor: int) -> None:
        self.things.pop(descriptor, None)

    def pipe(self) -> tuple[End, End]:
        pipe = Pipe(self.world)
        return End(self, pipe, reads=True), End(self, pipe, reads=False)

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    def pipe2(self, flags: int) -> tuple[int, int]:
        reading, writing = self.pipe()
        return reading.descriptor, writing.descriptor

    def set_blocking(self, descriptor: int, blocking: bool) -> None:
        if descriptor < FIRST:
            os.set_blocking(descriptor, blocking)

    def set_inheritable(self, descriptor: int, inheritable: bool) -> None:
        """Every descriptor is handed down by name here."""

    def read(self, descriptor: int, most: int) -> bytes:
        if descriptor < FIRST:
            return os.read(descriptor, most)
        pipe: Pipe = self.things[descriptor].pipe
        if not pipe.readable:
            raise BlockingIOError
        return pipe.read(most)

    def write(self, descriptor: int, data: bytes) -> int:
        if descriptor < FIRST:
            return os.write(descriptor, data)
        self.things[descriptor].pipe.write(bytes(data))
        return len(data)

    def close(self, descriptor: int) -> None:
        if descriptor < FIRST:
            os.close(descriptor)
            return
        thing = self.things.pop(descriptor, None)
        if isinstance(thing, End):
            (thing.pipe.end_reading if thing.reads else thing.pipe.end_writing)()

    def eventfd(self, initial: int, flags: int = 0) -> int:
        return EventFd(self).descriptor

    def eventfd_write(self, descriptor: int, value: int) -> None:
        self.world.effect()
        if (thing := self.things.get(descriptor)) is not None:
            thing.count += value
            thing.changed.notify()

    def eventfd_read(self, descriptor: int) -> int:
        thing = self.things[descriptor]
        if not thing.count:
            raise BlockingIOError
        count, thing.count = thing.count, 0
        return int(count)

    def _exit(self, code: int) -> None:
        task = self.world.task
        assert task is not None
        self.world.end(task.process, code)
        self.world.wait()


class Selector(selectors._BaseSelectorImpl):
    """`selectors.DefaultSelector`: finds what is ready, in any order."""

    _fd_to_key: dict[int, selectors.SelectorKey]

    def __init__(self, system: System) -> None:
        super().__init__()
        self._system, self._world = system, system.world

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        world = self._world
        world.call()
        until = None if timeout is None else world.now + timeout
        while not (found := self._ready()) and (until is None or world.now < until):
            task = world.task
            assert task is not None
            things = self._system.things
            waiters = [each for fd in self._fd_to_key if fd in things for each in things[fd].waiters]
            for each in waiters:
                each.add(task)
            try:
                world.wait(None if until is None else until - world.now)
            finally:
                for each in waiters:
                    each.discard(task)
        world.random.shuffle(found)
        return found

    def _ready(self) -> list[tuple[selectors.SelectorKey, int]]:
        found, things = [], self._system.things
        for key in self._fd_to_key.values():
            fd = key.fd
            thing = things.get(fd)
            if thing is None:
                continue
            mask = selectors.EVENT_READ if thing.readable else 0
            if key.events & selectors.EVENT_WRITE and thing.writable:
                mask |= selectors.EVENT_WRITE
            if mask:
                found.append((key, mask))
        return found


class Selectors:
    """The module `selectors`."""

    EVENT_READ, EVENT_WRITE = selectors.EVENT_READ, selectors.EVENT_WRITE

    def __init__(self, system: System) -> None:
        self.DefaultSelector = lambda: Selector(system)


class Select:
    """The module `select`, for handles of processes and the one descriptor that an inbox waits for."""

    POLLIN, EPOLLIN, EPOLLET = select.POLLIN, select.EPOLLIN, select.EPOLLET

    def __init__(self, system: System) -> None:
        self.poll = lambda: Poll(system)
        self.epoll = lambda: Epoll(system)


class Poll:
    """`select.poll`, of real descriptors or of those of this machine."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._things: dict[int, Any] = {}
        self._real = select.poll()

    def register(self, descriptor: int, events: int) -> None:
        if descriptor >= FIRST:
            self._things[descriptor] = self._system.things[descriptor]
        else:
            self._real.register(descriptor, events)

    def poll(self, milliseconds: float | None = None) -> list[tuple[int, int]]:
        if not self._things:
            return self._real.poll(milliseconds)
        self._system.world.call()
        first = next(iter(self._things.values()))
        waiters: Waiters = first.changed
        return waiters.wait_until(self._ready, None if milliseconds is None else milliseconds / 1000)

    def _ready(self) -> list[tuple[int, int]]:
        return [(descriptor, select.POLLIN) for descriptor, thing in self._things.items() if thing.readable]


class Epoll:
    """`select.epoll` for counters, edge-triggered: finds those that were written to since it last did."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._seen: dict[int, int] = {}

    def register(self, descriptor: int, events: int) -> None:
        assert events == select.EPOLLIN | select.EPOLLET
        self._seen[descriptor] = 0

    def poll(self, seconds: float | None = None) -> list[tuple[int, int]]:
        things = self._system.things
        self._system.world.call()
        waiters: Waiters = things[next(iter(self._seen))].changed
        ready = waiters.wait_until(lambda: [d for d, seen in self._seen.items() if things[d].count != seen], seconds)
        for descriptor in ready:
            self._seen[descriptor] = things[descriptor].count
        return [(descriptor, select.EPOLLIN) for descriptor in ready]


class Signals:
    """The module `signal`, for the signals that a supervisor sends."""

    SIGKILL, SIGSTOP, SIGCONT = signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT

    def __init__(self, system: System) -> None:
        self._system = system

    def pidfd_send_signal(self, descriptor: int, number: int) -> None:
        world, process = self._system.world, self._system.things[descriptor].process
        if number == ASK:
            return  # what its threads are at is nothing to a simulated process
        does = {self.SIGKILL: world.kill, self.SIGSTOP: world.freeze, self.SIGCONT: world.thaw}[signal.Signals(number)]
        world.after(world.latency(), lambda: None if process.dead else does(process))


class EventFd:
    """A counter that processes wait for (eventfd)."""

    def __init__(self, system: System) -> None:
        self.count = 0
        self.writable = True
        self.changed = Waiters(system.world)
        self.waiters = (self.changed,)
        self.descriptor = system.open(self)

    @property
    def readable(self) -> bool:
        return self.count > 0


class Handle:
    """A handle of a process (pidfd): readable when it has ended."""

    def __init__(self, system: System, process: Process) -> None:
        self.process = process
        self.writable = False
        self.waiters: tuple[Waiters, ...] = ()
        self.descriptor = system.open(self)

    @property
    def readable(self) -> bool:
        return self.process.dead
