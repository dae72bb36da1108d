"""Tools that follow a running graph from outside: viewers, `echo`, `hz`. They cannot delay the graph."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from functools import cached_property
from pathlib import Path
from typing import Any

import msgpack
import zenoh

from dataflow.graph.model import Graph
from dataflow.machines.keys import GRAPH_KEY, OVER_KEY, TOOLS, holder, tool_settings
from dataflow.messages.base import message_type
from dataflow.messages.declaration import known_type
from dataflow.transport import Bus, BusError, NetworkConfig, TapClient, TapWindow
from dataflow.transport.codec import TypeOf
from dataflow.transport.registry import RunningGraph, running
from dataflow.transport.tap_client import held_statics

POLL = 0.1
AGAIN_AFTER = 0.005
LOST_AFTER = 30.0
"""Seconds for which a tool waits for another machine that it had reached."""
CONNECT_WITHIN = 1.0
"""Seconds that a tool waits for processes that do not answer: they are starting again, stopped, or hang."""


class NotRunning(LookupError):
    """No running graph matches, or several do; the message lists those that run."""


class MachineUnreachable(RuntimeError):
    """A machine that runs a graph was not heard for too long; the message names it."""


class RemoteEndpoint:
    """An endpoint of another machine, which is asked over one connection as long as a tool runs."""

    def __init__(self, endpoint: str, keys: Path | None) -> None:
        self.endpoint, self.keys = endpoint, keys
        self._over: set[float] = set()
        """When the runs were started that have ended since."""
        self._heard_at = 0.0

    @cached_property
    def _settings(self) -> dict[str, Any]:
        return tool_settings(self.keys, self.endpoint)

    @cached_property
    def _bus(self) -> Bus:
        bus = Bus(NetworkConfig(connect=(self.endpoint,), zenoh=self._settings))
        ended: Any = zenoh.handlers.Callback(lambda sample: self._over.add(msgpack.unpackb(bytes(sample.payload))))
        bus.session.declare_subscriber(OVER_KEY, ended)
        return bus

    def graphs(self) -> list[RunningGraph]:
        """Returns the graph that runs there; waits (bounded) for a connection."""
        try:
            return self._ask()
        except BusError:  # nothing answers there, or these keys are not let in
            return []

    def still_runs(self, found: RunningGraph) -> bool:
        """Returns whether that run goes on, as far as is known. Raises `MachineUnreachable` after a timeout."""
        if found.started in self._over:
            return False
        if answers := self._ask():
            return any(each.started == found.started for each in answers)
        silence = time.monotonic() - self._heard_at
        if silence > LOST_AFTER:
            raise MachineUnreachable(
                f"{self.endpoint} was not heard for {silence:.0f} s: whether {found.name} goes on is not known"
            )
        return True

    def _ask(self) -> list[RunningGraph]:
        found = []
        for answer in self._bus.ask(GRAPH_KEY, timeout=1.0):
            said = msgpack.unpackb(answer, raw=False)
            graph, at = said["graph"], (self.endpoint,)
            name, space = graph["name"], graph["namespace"]
            found.append(RunningGraph(name, space, 0, 0.0, at, said["started"], graph, self._settings))
            self._heard_at = time.monotonic()
        return found

    def close(self) -> None:
        if "_bus" in vars(self):
            self._bus.close()


_elsewhere: ContextVar[RemoteEndpoint | None] = ContextVar("elsewhere", default=None)


def with_keys_of_tools() -> bool:
    """Returns whether graphs are looked for on another machine, with keys that load no code there."""
    place = _elsewhere.get()
    return place is not None and place.keys is not None and holder(place.keys) == TOOLS


@contextlib.contextmanager
def elsewhere(endpoint: str, keys: Path | None) -> Iterator[None]:
    """Looks for running graphs at an endpoint of another machine, with these keys, as long as the block runs."""
    with contextlib.closing(RemoteEndpoint(endpoint, keys)) as place:
        token = _elsewhere.set(place)
        try:
            yield
        finally:
            _elsewhere.reset(token)


def network_of(found: RunningGraph) -> NetworkConfig:
    """Returns how a tool reaches the processes of a running graph."""
    return NetworkConfig(connect=found.endpoints, zenoh=found.settings)


def listing() -> Callable[[], list[RunningGraph]]:
    """Returns what lists, on any thread, the graphs that run on this machine, or at the endpoint of `elsewhere`."""
    place = _elsewhere.get()
    return running if place is None else place.graphs


def find_running(name: str | None, *, wait: float = 0.0) -> RunningGraph:
    """The running graph of that name (or namespace), or the only one. Waits up to `wait` seconds for it."""
    deadline = time.monotonic() + wait
    while True:
        graphs = listing()()
        found = [g for g in graphs if name is None or name in (g.name, g.namespace, str(g.pid))]
        if len(found) == 1:
            return found[0]
        if len(found) > 1:
            listed = ", ".join(f"{g.name} (process {g.pid})" for g in found)
            raise NotRunning(f"several graphs run: {listed}; say which with --graph NAME or the process number")
        if time.monotonic() >= deadline:
            listed = ", ".join(g.name for g in graphs) or "none"
            place = _elsewhere.get()
            where = "on this machine" if place is None else f"at {place.endpoint}, or these keys are not let in,"
            wanted = f"no graph runs {where}" if name is None else f"no graph {name!r} runs {where}"
            raise NotRunning(f"{wanted} (running: {listed}); start one with: dataflow run GRAPH")
        time.sleep(POLL)


def graph_of(found: RunningGraph) -> Graph:
    """The resolved graph that runs."""
    return Graph.from_json(found.graph)


def types_of(graph: Graph) -> TypeOf:
    """The classes that a tool reads a graph's messages as; the graph's own types by their declarations. Nothing of the
    graph's code is imported: its modules may not even be there where the tool runs."""
    own = {schema: known_type(declaration) for schema, declaration in graph.types.items()}
    return lambda schema: own.get(schema) or message_type(schema)


def still_runs(found: RunningGraph) -> bool:
    """Returns whether that very run goes on. Raises `MachineUnreachable` after a timeout of another machine."""
    if (place := _elsewhere.get()) is not None:
        return place.still_runs(found)
    return any(g.pid == found.pid and g.started == found.started for g in running())


@contextlib.contextmanager
def tap(found: RunningGraph, expressions: Sequence[str], window: TapWindow | None = None) -> Iterator[TapClient]:
    """A lossy copy of the streams that match `expressions` (relative to the namespace, absolute with a leading `/`)."""
    absolute = [e[1:] if e.startswith("/") else f"{found.namespace}/{e}" for e in expressions]
    with Bus(network_of(found)) as bus:
        reached(bus, found)
        with TapClient(bus, found.namespace, absolute, window, types=types_of(graph_of(found))) as client:
            yield client


def reached(bus: Bus, found: RunningGraph) -> None:
    """Waits (bounded) until every process is reached, and answers for the static streams that it holds."""
    deadline = time.monotonic() + CONNECT_WITHIN
    while len(bus.peers()) < len(found.endpoints) and time.monotonic() < deadline:
        time.sleep(AGAIN_AFTER)
    held: list[set[str]] = []
    while len(held) < len(bus.peers()) and (left := deadline - time.monotonic()) > 0:
        held = held_statics(bus, found.namespace, left)
    expected = set().union(*held)
    while (left := deadline - time.monotonic()) > 0:
        if expected <= set(bus.query_static(found.namespace, timeout=left)):
            return
        time.sleep(AGAIN_AFTER)
