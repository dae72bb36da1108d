"""The simulated network: a link from each process to each that takes from it.

A link keeps its order; links know nothing of each other. A process that is frozen takes nothing: its links fill, and
whoever writes to one that is full waits for so long and no longer; then the link is broken, and what was on it, and
what is sent until it stands again, is lost, but for ends and frontiers of streams. A partition breaks links, too. Only live runs
outlive that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from dataflow.transport import Envelope, Kind, NetworkConfig, encode
from dataflow.transport.counters import Counters
from simulation.machine import Waiters
from simulation.world import Process, World

ROOM = 256
"""Messages that fit on a link."""
STANDS_AGAIN = 0.3
"""Seconds after which a broken link may stand again."""

Receive = Callable[[bytes], object]


class Link:
    """From one process to another, in order."""

    def __init__(self, world: World, taker: Bus) -> None:
        self._world, self._taker = world, taker
        self._on_its_way: deque[tuple[str, bytes, bool]] = deque()
        self._due = 0.0
        self._broken_until = 0.0
        self._room = Waiters(world)
        taker.process.thawed.append(self._deliver)
        self.lost = 0

    def send(self, key: str, payload: bytes, blocked: float, *, kept: bool) -> None:
        """Sends a message; one that is `kept` outlives a broken link."""
        world = self._world
        until = world.now + blocked
        while len(self._on_its_way) >= ROOM and not self._taker.process.dead and world.now >= self._broken_until:
            if world.now >= until:
                self.cut(STANDS_AGAIN)
                break
            self._room.wait(until - world.now)
        broken = world.now < self._broken_until
        if self._taker.process.dead or (broken and not kept):
            self.lost += 1
            return
        self._on_its_way.append((key, payload, kept))
        self._due = max(self._due, self._broken_until, world.now + world.latency())
        world.at(self._due, self._deliver)

    def cut(self, span: float) -> None:
        """Breaks the link for so many seconds."""
        before, self._on_its_way = self._on_its_way, deque(each for each in self._on_its_way if each[2])
        self.lost += len(before) - len(self._on_its_way)
        self._broken_until = max(self._broken_until, self._world.now + span)
        self._due = max(self._due, self._broken_until)
        self._world.at(self._due, self._deliver)
        self._room.notify()

    def _deliver(self) -> None:
        """Hands over what has arrived; each message has its own moment, but the frozen take all at once."""
        process = self._taker.process
        if process.frozen or process.dead or self._world.now < self._broken_until or not self._on_its_way:
            return
        self._taker.take(*self._on_its_way.popleft()[:2])
        if self._due <= self._world.now:
            while self._on_its_way:
                self._taker.take(*self._on_its_way.popleft()[:2])
        self._room.notify()


class Network:
    """All buses of a run, and the links between them."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.buses: dict[str, Bus] = {}
        self._links: dict[tuple[str, int], Link] = {}

    def join(self, config: NetworkConfig) -> Bus:
        task = self.world.task
        assert task is not None
        bus = self.buses[task.process.label] = Bus(self, task.process, config)
        return bus

    @property
    def links(self) -> Iterator[Link]:
        yield from self._links.values()

    def link(self, maker: Process, taker: Bus) -> Link:
        place = maker.label, taker.process.pid
        return self._links.get(place) or self._links.setdefault(place, Link(self.world, taker))

    def partition(self, maker: str, taker: str, span: float) -> None:
        """Breaks the link between two processes for so many seconds."""
        bus = self.buses.get(taker)
        if bus is not None and (found := self._links.get((maker, bus.process.pid))) is not None:
            found.cut(span)


class Publisher:
    """Publishes one stream to every bus that takes it."""

    def __init__(self, bus: Bus, stream: str) -> None:
        self._bus, self._stream = bus, stream
        self._probes = 0
        self.matched = False

    def put(self, envelope: Envelope) -> int:
        payload = encode(envelope)
        self._bus.send(self._stream, payload, kept=envelope.kind is not Kind.MESSAGE)
        return len(payload)

    def put_bytes(self, payload: bytes) -> int:
        self._bus.send(self._stream, bytes(payload))
        return len(payload)

    def probe(self) -> int:
        self._probes += 1
        return self.put(Envelope(Kind.PROBE, self._stream, 0, self._probes, 0))


class Session:
    """What a bus shows of its session."""

    def __init__(self, bus: Bus) -> None:
        self.put = bus.send


class Bus:
    """One process's place in the network: the operations of `dataflow.transport.Bus` that a process uses."""

    def __init__(self, network: Network, process: Process, config: NetworkConfig) -> None:
        self.network, self.process, self.config = network, process, config
        self.counted = Counters()
        self.session = Session(self)
        self._taken: dict[str, Receive] = {}
        self._static: dict[str, bytes] = {}

    def publisher(self, stream: str, *, consumers: int = 0) -> Publisher:
        return Publisher(self, stream)

    def subscribe(self, stream: str, receive: Receive) -> None:
        """A publisher hears of it a moment later."""
        world = self.network.world
        world.call()
        world.after(world.latency(), lambda: self._taken.setdefault(stream, receive))

    def send(self, key: str, payload: bytes, *, kept: bool = False) -> None:
        world = self.network.world
        for bus in self._takers(key):
            world.call()
            self.network.link(self.process, bus).send(key, payload, self.config.blocked, kept=kept)
            self.counted.moved("sent", len(payload))

    def _takers(self, key: str) -> Iterator[Bus]:
        return (bus for bus in list(self.network.buses.values()) if bus is not self and bus.takes(key))

    def takes(self, key: str) -> bool:
        return not self.process.dead and key in self._taken

    def take(self, key: str, payload: bytes) -> None:
        self.counted.moved("received", len(payload))
        self._taken[key](payload)

    def declare_static(self, stream: str, envelope: bytes) -> None:
        self._static[stream] = envelope

    def fetch_statics(self, namespace: str, timeout: float = 2.0) -> dict[str, bytes]:
        world = self.network.world
        world.wait(min(timeout, world.latency() + 1e-3))
        others = [b for b in self.network.buses.values() if not (b.process.dead or b.process.frozen)]
        return {stream: envelope for bus in others for stream, envelope in bus._static.items()}

    def serve(self, key: str, answer: Callable[[Any], object]) -> None:
        """Nobody asks here."""

    def counters(self) -> dict[str, int]:
        return self.counted.as_dict()

    def close(self) -> None:
        self._taken.clear()


class NoTaps:
    """Nobody watches."""

    active = False

    def __init__(self, *_: Any) -> None:
        pass

    def close(self) -> None:
        """There is nothing to close."""
