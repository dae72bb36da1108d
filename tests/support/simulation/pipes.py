"""Two machines and the link between them, on simulated time: the pipe that ships, over a link that a seed delays,
throttles, stalls and resets. What stands for Zenoh here keeps what that promises: order on a link that lives.
"""

from __future__ import annotations

import contextlib
import functools
import random
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import zenoh

from dataflow.machines.pipe import Pipe
from simulation import machine
from simulation.bindings import Bindings, bound, clocks
from simulation.shrink import smallest
from simulation.world import Violation, World

SETTLES = 60.0
"""Seconds after the last event within which everything that was sent has been taken."""
SMALL: Bindings = {
    ("dataflow.machines.pipe", "IN_FLIGHT"): 16,
    ("dataflow.machines.pipe", "IN_FLIGHT_BYTES"): 8_000,
    ("dataflow.machines.pipe", "PIECE"): 1_000,
    ("dataflow.machines.pipe", "ACKNOWLEDGE_AFTER"): 4,
    ("dataflow.machines.pipe", "MOST_WAITING"): 20_000,
}
"""Bounds of a pipe that carries gigabytes: here it carries some hundred frames."""
QUEUE = 6_000
"""Bytes that the link takes before a sender waits for it."""


@dataclass(frozen=True, slots=True)
class Event:
    """What happens to the link `at` so many seconds: `stall` (nothing passes for `span` s), `reset` (what was on it is
    lost; nothing can be sent for `span` s), `throttle` (bytes a second)."""

    at: float
    kind: str
    span: float = 0.0
    rate: float = 0.0


@dataclass(frozen=True, slots=True)
class Journey:
    """What two machines say to each other: (seconds, bytes, whether it may be dropped), from each end."""

    seed: int
    sent: tuple[tuple[tuple[float, int, bool], ...], ...]
    events: tuple[Event, ...]
    delay: float
    ahead: float
    bounded: bool

    def __str__(self) -> str:
        lines = [
            f"seed {self.seed}: {' and '.join(str(len(each)) for each in self.sent)} frames, delay {self.delay:g} s, "
            f"clocks {self.ahead:g} s apart" + (", bounded" if self.bounded else "")
        ]
        return "\n".join([*lines, *(f"  {event}" for event in self.events)])


def journey_of(seed: int) -> Journey:
    """Returns the journey of a seed."""
    r = random.Random(f"journey {seed}")
    span = r.choice((1.0, 5.0, 20.0))
    sent = []
    for _ in range(2):
        times = sorted(r.random() * span * (0.1 if r.random() < 0.3 else 1.0) for _ in range(r.choice((0, 5, 60, 200))))
        sent.append(tuple((at, r.choice((1, 40, 40, 400, 3_000)), r.random() < 0.5) for at in times))
    events = []
    for _ in range(r.choice((0, 1, 2, 4, 8))):
        kind = r.choice(("stall", "reset", "reset", "throttle"))
        span_of = r.choice((0.0, 0.05, 0.5, 2.0, 8.0))
        events.append(Event(round(r.random() * span, 4), kind, span_of, r.choice((1e3, 2e4, 1e6))))
    events.sort(key=lambda event: event.at)
    delay = r.choice((0.0002, 0.02, 0.3))
    return Journey(seed, tuple(sent), tuple(events), delay, r.choice((0.0, -3.0, 1e4)), r.random() < 0.3)


@dataclass(slots=True)
class Way:
    """One direction of the link. Beats have the higher priority: they pass what waits, and are dropped, not waited
    for."""

    waiting: dict[str, deque[bytes]] = field(default_factory=lambda: {"beats": deque(), "frames": deque()})
    size: int = 0
    flying: deque[tuple[float, str, bytes]] = field(default_factory=deque)
    """What is on its way: when it arrives, what it is, and its bytes."""
    takers: dict[str, Callable[[Any], None]] = field(default_factory=dict)


class Link:
    """What two sessions of Zenoh are to two pipes."""

    def __init__(self, world: World, journey: Journey) -> None:
        self._world, self._delay = world, journey.delay
        self._rate = 1e6
        self._epoch = 0
        self._still = self._down = 0.0
        self.ways: dict[str, Way] = {"a": Way(), "b": Way()}
        self._changed = machine.Waiters(world)
        self.session = self

    def happen(self, event: Event) -> None:
        now = self._world.now
        match event.kind:
            case "stall":
                self._still = max(self._still, now + event.span)
            case "reset":
                self._epoch += 1
                self._down = max(self._down, now + event.span)
                for way in self.ways.values():
                    way.size = 0
                    way.flying.clear()
                    for waiting in way.waiting.values():
                        waiting.clear()
                self._changed.notify()
            case "throttle":
                self._rate = event.rate

    def heal(self) -> None:
        self._rate, self._still, self._down = 1e6, 0.0, 0.0
        self._changed.notify()

    # Zenoh

    def declare_publisher(self, key: str, **options: Any) -> Any:
        to, _, what = key.partition("/")
        return SimpleNamespace(put=functools.partial(self._put, self.ways[to], what))

    def declare_subscriber(self, key: str, handler: Any) -> Any:
        to, _, what = key.partition("/")
        self.ways[to].takers[what] = handler
        return SimpleNamespace(undeclare=lambda: self.ways[to].takers.pop(what))

    def _put(self, way: Way, what: str, data: bytes) -> None:
        self._world.call()
        epoch = self._epoch
        while what == "frames" and way.size + len(data) > max(QUEUE, len(data)) and epoch == self._epoch:
            self._changed.wait()
        if epoch != self._epoch or self._world.now < self._down or (what == "beats" and len(way.waiting[what]) > 8):
            return  # it is lost with the link, or there is none, or it is one of those that are dropped
        way.waiting[what].append(data)
        way.size += len(data)
        self._changed.notify()

    def load(self, way: Way) -> None:
        """Puts what waits on the link, one after the other, as a thread of the machine that sends."""
        world = self._world
        due = 0.0
        while True:
            if self._pauses(any(way.waiting.values())):
                continue
            what = next(name for name, waiting in way.waiting.items() if waiting)
            data, epoch = way.waiting[what].popleft(), self._epoch
            world.wait(len(data) / self._rate)
            if epoch == self._epoch:
                way.size -= len(data)
                due = max(due, world.now + self._delay * (0.5 + world.random.random()))
                way.flying.append((due, what, data))
                self._changed.notify()

    def deliver(self, way: Way) -> None:
        """Hands over what has arrived, in order, as a thread of the machine that receives."""
        world = self._world
        while True:
            if self._pauses(bool(way.flying)):
                continue
            due, what, data = way.flying[0]
            if due > world.now:
                self._changed.wait(due - world.now)
                continue
            way.flying.popleft()
            if (taker := way.takers.get(what)) is not None:
                taker(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda data=data: data)))

    def _pauses(self, has_any: bool) -> bool:
        """Waits where there is nothing, or the link stands still."""
        later = max(self._still, self._down) - self._world.now
        if has_any and later <= 0:
            return False
        self._changed.wait(later if later > 0 else None)
        return True


def travel(journey: Journey) -> None:
    """Lets two pipes say what they have to. Raises `Violation`."""
    world = World(journey.seed, preempt=random.Random(journey.seed).choice((0.0, 0.05, 0.3)))
    link = Link(world, journey)
    processes = [world.process(name) for name in ("a", "b")]
    processes[1].ahead = journey.ahead
    taken: tuple[list[bytes], list[bytes]] = ([], [])
    pipes: list[Pipe] = []

    def begin(k: int) -> None:
        mine, theirs = "ab"[k], "ba"[k]
        pipes.append(Pipe(link, theirs, mine, taken[k].append, bounded=journey.bounded))  # type: ignore[arg-type]
        world.start("link", processes[1 - k], lambda: link.load(link.ways[mine]))
        world.start("link", processes[k], lambda: link.deliver(link.ways[mine]))

    with contextlib.ExitStack() as stack:
        stack.enter_context(bound(_bindings(world) | SMALL))
        stack.callback(world.close)
        for k in range(2):
            world.start("begin", processes[k], lambda k=k: begin(k))  # type: ignore[misc]
            world.run(lambda k=k: len(pipes) > k, 10.0)  # type: ignore[misc]
            world.start("main", processes[k], lambda k=k: _say(world, pipes[k], journey.sent[k]))  # type: ignore[misc]
        for event in journey.events:
            world.at(world.now + event.at, functools.partial(link.happen, event))
        last = max([event.at + event.span for event in journey.events], default=0.0)
        ends = [frames[-1][0] for frames in journey.sent if frames]
        calm = world.now + max([last, *ends])
        world.at(calm, link.heal)
        with contextlib.suppress(_Late):
            world.run(lambda: world.now > calm + 1.0 and _settled(pipes, taken, journey), calm + SETTLES)
        _check(journey, pipes, taken)


_Late = Violation


def _say(world: World, pipe: Pipe, frames: tuple[tuple[float, int, bool], ...]) -> None:
    begun = world.now
    for number, (at, size, droppable) in enumerate(frames):
        while world.now < begun + at:
            world.wait(begun + at - world.now)
        pipe.send(_frame(number, size), droppable=droppable)


def _frame(number: int, size: int) -> bytes:
    return number.to_bytes(4, "big") + bytes(size)


def _settled(pipes: list[Pipe], taken: tuple[list[bytes], list[bytes]], journey: Journey) -> bool:
    there = [len(taken[1 - k]) + pipes[k].dropped == len(journey.sent[k]) for k in range(2)]
    measured = all(pipe.clocks.best is not None for pipe in pipes)
    return all(there) and measured and not any(pipe._sent or pipe._waiting for pipe in pipes)


def _check(journey: Journey, pipes: list[Pipe], taken: tuple[list[bytes], list[bytes]]) -> None:
    for k in range(2):
        sent, got = journey.sent[k], taken[1 - k]
        numbers = [int.from_bytes(frame[:4], "big") for frame in got]
        where = f"from machine {'ab'[k]}"
        if numbers != sorted(set(numbers)):
            raise Violation(f"{where}, frames came twice or out of order: {numbers[:20]}")
        if any(frame != _frame(number, sent[number][1]) for number, frame in zip(numbers, got, strict=True)):
            raise Violation(f"{where}, a frame was changed")
        lost = set(range(len(sent))) - set(numbers)
        if kept := [number for number in lost if not (journey.bounded and sent[number][2])]:
            raise Violation(f"{where}, frames that must not be dropped did not come within {SETTLES:g} s: {kept[:5]}")
        if len(lost) != pipes[k].dropped:
            raise Violation(f"{where}, {len(lost)} frames are lost and {pipes[k].dropped} are counted as dropped")
        if pipes[k]._sent or pipes[k]._waiting:
            raise Violation(f"{where}, everything was taken, and the sender does not notice")
        delay, offset = pipes[k].clocks.best or (0, 0)
        ahead = round((journey.ahead if k == 0 else -journey.ahead) * 1e9)
        if abs(offset - ahead) > delay / 2 + 2e6:
            raise Violation(f"{where}, the other clock is {ahead} ns ahead and measured as {offset}, delay {delay}")


def _bindings(world: World) -> Bindings:
    symbols = SimpleNamespace(
        CongestionControl=zenoh.CongestionControl,
        Priority=zenoh.Priority,
        ZError=zenoh.ZError,
        handlers=SimpleNamespace(Callback=lambda callback, indirect: callback),
    )
    return {
        **dict.fromkeys(clocks(), machine.Time(world)),
        ("dataflow.machines.pipe", "threading"): machine.Threading(world),
        ("dataflow.machines.pipe", "zenoh"): symbols,
    }


def shrunk(journey: Journey, violation: Violation, *, most: int = 100) -> tuple[Journey, str]:
    """Returns the smallest journey found that breaks a promise, and which."""
    return smallest(journey, violation, _smaller, travel, most)


def _smaller(journey: Journey) -> Iterator[Journey]:
    """Yields what is a little plainer."""
    for k in range(len(journey.events)):
        yield replace(journey, events=journey.events[:k] + journey.events[k + 1 :])
    for k in range(2):
        frames = journey.sent[k]
        for half in (frames[: len(frames) // 2], frames[len(frames) // 2 :]):
            if half != frames:
                yield replace(journey, sent=(half, journey.sent[1]) if k == 0 else (journey.sent[0], half))
