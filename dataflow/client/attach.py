"""Tools that follow a running graph from outside: viewers, `echo`, `hz`. They cannot delay the graph."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path

import msgpack

from dataflow.graph.model import Graph
from dataflow.machines.keys import GRAPH_KEY, settings
from dataflow.messages.base import message_type
from dataflow.messages.declaration import known_type
from dataflow.transport import Bus, NetworkConfig, TapClient, TapWindow
from dataflow.transport.codec import TypeOf
from dataflow.transport.registry import RunningGraph, running
from dataflow.transport.tap_client import held_statics

POLL = 0.1
AGAIN_AFTER = 0.005
ELSEWHERE_WITHIN = 3.0
"""Seconds that a tool tries to reach another machine."""
CONNECT_WITHIN = 1.0
"""Seconds that a tool waits for processes that do not answer: they are starting again, stopped, or hang."""


class NotRunning(LookupError):
    """No running graph matches, or several do; the message lists those that run."""


_elsewhere: ContextVar[tuple[str, Path | None] | None] = ContextVar("elsewhere", default=None)


@contextlib.contextmanager
def elsewhere(endpoint: str, keys: Path | None) -> Iterator[None]:
    """Looks for running graphs at an endpoint of another machine, with these keys, as long as the block runs."""
    token = _elsewhere.set((endpoint, keys))
    try:
        yield
    finally:
        _elsewhere.reset(token)


def network_of(found: RunningGraph) -> NetworkConfig:
    """Returns how a tool reaches the processes of a running graph."""
    return NetworkConfig(connect=found.endpoints, zenoh=found.settings)


def _graphs() -> list[RunningGraph]:
    """Returns the graphs that run on this machine, or at the endpoint of `elsewhere`."""
    place = _elsewhere.get()
    if place is None:
        return running()
    endpoint, keys = place
    reached = settings(keys, endpoint)
    with Bus(NetworkConfig(connect=(endpoint,), zenoh=reached)) as bus:
        deadline = time.monotonic() + ELSEWHERE_WITHIN
        while not (answers := bus.ask(GRAPH_KEY, timeout=1.0)) and time.monotonic() < deadline:
            time.sleep(POLL)
    found = []
    for answer in answers:
        said = msgpack.unpackb(answer, raw=False)
        graph = said["graph"]
        at = (endpoint,)
        found.append(RunningGraph(graph["name"], graph["namespace"], 0, 0.0, at, said["started"], graph, reached))
    return found


def find_running(name: str | None, *, wait: float = 0.0) -> RunningGraph:
    """The running graph of that name (or namespace), or the only one. Waits up to `wait` seconds for it."""
    deadline = time.monotonic() + wait
    while True:
        graphs = _graphs()
        found = [g for g in graphs if name is None or name in (g.name, g.namespace, str(g.pid))]
        if len(found) == 1:
            return found[0]
        if len(found) > 1:
            listed = ", ".join(f"{g.name} (process {g.pid})" for g in found)
            raise NotRunning(f"several graphs run: {listed}; say which with --graph NAME or the process number")
        if time.monotonic() >= deadline:
            listed = ", ".join(g.name for g in graphs) or "none"
            place = _elsewhere.get()
            where = "on this machine" if place is None else f"at {place[0]}, or these keys are not let in,"
            wanted = f"no graph runs {where}" if name is None else f"no graph {name!r} runs {where}"
            raise NotRunning(f"{wanted} (running: {listed}); start one with: dataflow run GRAPH")
        time.sleep(POLL)


def graph_of(found: RunningGraph) -> Graph:
    """The resolved graph that runs."""
    return Graph.from_json(found.graph)


def types_of(graph: Graph) -> TypeOf:
    """The classes that a tool reads a graph's messages as; the graph's own types by their declarations.

    Nothing of the graph's code is imported: its modules may not even be there where the tool runs.
    """
    own = {schema: known_type(declaration) for schema, declaration in graph.types.items()}
    return lambda schema: own.get(schema) or message_type(schema)


def still_runs(found: RunningGraph) -> bool:
    """Tells whether that very run goes on."""
    return any(g.pid == found.pid and g.started == found.started for g in _graphs())


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
