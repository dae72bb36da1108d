"""Plans what is to be run, and where: the pure part of the supervisor."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dataflow.environments import EnvError
from dataflow.graph.model import Graph, Placement
from dataflow.graph.sections import PLACE_FRAMES
from dataflow.names import firings_key
from dataflow.recording.parts import Storage

if TYPE_CHECKING:  # runs without faults read no fault plan
    from dataflow.chaos.plan import Fault

LOG_PROCESS = "@log"
RECORDER = "@recorder"
FLIGHT_SETTLES = 0.75
"""Seconds after which the firing records of what a flight recorder is to keep have come: batches wait a quarter of
one."""
VIEWER_FILE = "@view"
LINK = "@link"
"""The process that carries what passes between this machine and others."""


@dataclass(frozen=True, slots=True)
class LogPlan:
    """Recorded streams that stand in for sources: stream names, the stamps they ended with, and the span (ns).

    `first`: the stamp that `--start` counts from. `bag`: how the bag of another system is opened as such streams; None
    for a recording.
    """

    path: Path
    streams: tuple[str, ...]
    finals: Mapping[str, int] = field(default_factory=dict)
    first: int = 0
    start: int | None = None
    end: int | None = None
    bag: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Rendezvous:
    """The endpoint at which other machines join a run, and the folder of this machine's keys; see `machines.keys`."""

    endpoint: str
    keys: Path | None = None


@dataclass(frozen=True, slots=True)
class RunPlan:
    """One execution of a graph.

    - `placement`: see `Graph.processes`.
    - `log`: a recording instead of the sources (a replay); None runs the sources themselves.
    - `flight`: the folder of the graph's flight recorder; None, or a `record`: there is none.
    - `record`, `view_file`: files to write; None for none; an existing recording only with `overwrite`. `metadata` goes
      into the recording; `storage`: how its files are split, kept, and who may read them.
    - `live`: time does not wait: every source is read on its own thread, at the pace of the clock, and the operators'
      `live:` policies apply.
    - `machines`: where the machines that the graph names join; None: everything runs on this one.
    - `faults`: what is to go wrong on purpose, by time (live runs only).
    - `rate`: pace of event time against the clock (1.0 is real time); None: as fast as the graph goes.
    - `paused`: sources, or the recording in their place, wait at their beginning until they are let go on, or step
      by step (no live run).
    - `window`: messages and bytes that feeds may be ahead of the graph.
    - `paranoid`: re-digest inputs after each firing to catch operators that write into them.
    - `start_timeout`, `stall_timeout`: seconds allowed for all processes to become ready, and without any progress.
    """

    graph: Graph
    placement: Placement | Mapping[str, str] = "graph"
    log: LogPlan | None = None
    record: Path | None = None
    flight: Path | None = None
    view_file: Path | None = None
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    live: bool = False
    machines: Rendezvous | None = None
    faults: Iterator[Fault] | None = None
    rate: float | None = None
    paused: bool = False
    window: tuple[int, int] = (256, 64 << 20)
    paranoid: bool = False
    start_timeout: float = 120.0
    stall_timeout: float = 120.0
    compression: str = "zstd"
    overwrite: bool = False
    storage: Storage = field(default_factory=Storage)

    def __post_init__(self) -> None:
        on_failure = self.storage.on_failure or ("go_on" if self.live else "end")
        object.__setattr__(self, "storage", replace(self.storage, on_failure=on_failure))

    @property
    def keeps_records(self) -> bool:
        """Returns whether the operators' firing records are taken by a sink."""
        return self.record is not None or self.flight is not None


@dataclass(frozen=True, slots=True)
class ProcessPlan:
    """One process: which operators it runs, what it sends to and takes from the others, and whom it connects to.

    `firings`: of a recorder, the operators whose firing records it takes: those that run, or whose streams a log has.
    """

    label: str
    nodes: tuple[str, ...]
    publish: Mapping[str, int]
    subscribe: tuple[str, ...]
    has_log: bool = False
    sink: str | None = None
    streams: tuple[str, ...] = ()
    firings: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    machine: str | None = None
    """The machine that it runs on; None: that of the supervisor."""
    env: str | None = None
    """The environment of its operators; None: this installation."""


def replaced_in(graph: Graph, log: LogPlan | None) -> set[str]:
    """Returns the operators that do not run where a log is played: those whose streams it has, and external ones that
    give nothing, which would act on the world again."""
    if log is None:
        return set()
    return {graph.streams[s].node for s in log.streams} | {node.name for node in graph.sinks() if node.external}


def process_plans(plan: RunPlan) -> dict[str, ProcessPlan]:
    """Returns the processes of a run by label: those of operators in graph order, the recorder, the viewer file."""
    graph = plan.graph
    replaced = replaced_in(graph, plan.log)
    labels = {node: label for label, nodes in graph.processes(plan.placement).items() for node in nodes}
    if plan.log is not None:
        log_process = "all" if plan.placement == "one_process" else LOG_PROCESS
        labels |= dict.fromkeys(replaced, log_process)

    processes: dict[str, list[str]] = {}
    for node in graph.nodes:
        processes.setdefault(labels[node], []).append(node)

    streams = set(graph.streams)
    if plan.log is not None:
        streams -= {s for s in streams if graph.streams[s].node in replaced} - set(plan.log.streams)

    made_in = {stream: labels[graph.streams[stream].node] for stream in streams}
    taken_in: dict[str, set[str]] = {stream: set() for stream in streams}
    for edge in graph.edges():
        if edge.stream in streams and edge.consumer not in replaced:
            taken_in[edge.stream].add(labels[edge.consumer])

    sinks = _sinks_of(plan, streams)
    for label, (_, taken, _) in sinks.items():
        for stream in taken:
            taken_in[stream].add(label)

    plans: dict[str, ProcessPlan] = {}
    firings = tuple(node.name for node in graph.nodes.values() if node.outputs or node.name not in replaced)
    for label, nodes in processes.items():
        publish = {
            s: len(taken_in[s] - {label}) for s in sorted(streams) if made_in[s] == label and taken_in[s] - {label}
        }
        if plan.keeps_records:
            publish |= {firings_key(graph.namespace, node): 1 for node in nodes if node in firings}
        subscribe = tuple(s for s in sorted(streams) if label in taken_in[s] and made_in[s] != label)
        running = tuple(node for node in nodes if node not in replaced)
        machine, env = _machine_of(plan, label, nodes), _env_of(graph, label, running)
        has_log = not replaced.isdisjoint(nodes)
        plans[label] = ProcessPlan(label, running, publish, subscribe, has_log=has_log, machine=machine, env=env)
    for label, (kind, taken, chosen) in sinks.items():
        process = ProcessPlan(label, (), {}, (), sink=kind, streams=tuple(sorted(taken)), options=chosen)
        plans[label] = replace(process, firings=firings) if kind == "record" else process
    return plans


def _sinks_of(plan: RunPlan, streams: set[str]) -> dict[str, tuple[str, tuple[str, ...], Mapping[str, Any]]]:
    """Returns the recorder and the viewer file of a run by label: their kind, the streams that they take, options."""
    graph, storage = plan.graph, plan.storage.to_json()
    sinks: dict[str, tuple[str, tuple[str, ...], Mapping[str, Any]]] = {}
    recorded = tuple(s for s in graph.record.streams if s in streams)
    options: dict[str, Any] = {
        "metadata": {name: dict(values) for name, values in plan.metadata.items()},
        "compression": plan.compression,
        "storage": storage,
    }
    if plan.record is not None:
        options |= {"path": str(plan.record), "overwrite": plan.overwrite}
        sinks[RECORDER] = ("record", recorded, options)
    elif plan.flight is not None:
        options |= {"flight": str(plan.flight), "overwrite": True}
        options |= {"label": f"{graph.name}-{os.getpid()}", "settle": FLIGHT_SETTLES}
        sinks[RECORDER] = ("record", recorded, options)
    if plan.view_file is not None:
        hidden = {s for s in graph.view.hide if not set(graph.streams[s].types) & set(PLACE_FRAMES)}
        shown = tuple(sorted(streams - hidden))
        sinks[VIEWER_FILE] = ("view", shown, {"path": str(plan.view_file), "storage": storage})
    return sinks


def _machine_of(plan: RunPlan, label: str, nodes: list[str]) -> str | None:
    """Returns the machine of a process. Raises `NetworkError` where the placement puts operators of two into it."""
    if plan.machines is None:
        return None
    found = {plan.graph.nodes[node].machine for node in nodes}
    if len(found) > 1:
        from dataflow.transport import NetworkError

        raise NetworkError(_apart(label, "on several machines", found))
    return found.pop()


def _env_of(graph: Graph, label: str, nodes: tuple[str, ...]) -> str | None:
    """Returns the environment of a process. Raises `EnvError` where the placement puts operators of two into it."""
    found = {graph.nodes[node].env for node in nodes}
    if len(found) > 1:
        raise EnvError(_apart(label, "in several environments", found))
    return found.pop() if found else None


def _apart(label: str, where: str, found: set[str | None]) -> str:
    named = ", ".join(sorted(each or "this one" for each in found))
    return f"process {label!r} would be {where} ({named}): place its operators apart"


def taken_keys(graph: Graph, process: ProcessPlan) -> set[str]:
    """Returns the keys that a process takes: on each it must have seen a probe before sources are released."""
    if process.sink is None:
        return set(process.subscribe)
    return {*process.streams, *(firings_key(graph.namespace, node) for node in process.firings)}
