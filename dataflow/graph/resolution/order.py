"""The graph as a whole: cycles that would wait for themselves, the order of operators, which are fed by devices."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence

from dataflow.graph.drafts import WiredOperator
from dataflow.graph.model import Stream
from dataflow.graph.problems import Place, Problems
from dataflow.graph.reach import reached
from dataflow.graph.resolution.policies import sync_tolerance
from dataflow.graph.yaml.fields import Fields
from dataflow.operator import Source
from dataflow.sync.demand import Edge as DemandEdge
from dataflow.sync.demand import stuck_cycle
from dataflow.sync.stamps import format_duration

MAX_CYCLES = 8
"""Cycles that are reported at most."""


def refuse_stuck_cycles(wired: Iterable[WiredOperator], streams: Mapping[str, Stream], problems: Problems) -> None:
    """Reports cycles that would wait for themselves, at most `MAX_CYCLES` of them."""
    edges: list[DemandEdge] = []
    places: dict[DemandEdge, tuple[Place, str]] = {}
    for w in wired:
        spec = w.draft.cls.spec
        joined = len(spec.triggers) > 1 and not spec.merge
        tolerance = sync_tolerance(w.draft, Fields(Problems())) if joined else 0
        for name, taken in w.inputs.items():
            port = spec.inputs[name]
            for stream in taken:
                made = streams[stream]
                edge = DemandEdge(
                    producer=made.node,
                    consumer=w.draft.name,
                    input=name,
                    kind="trigger" if port.kind == "in" else port.kind,
                    before=port.before or None,
                    tolerance=tolerance,
                    anchor=joined and spec.triggers[0].name == name,
                    lag=made.lag,
                    static=made.static,
                )
                edges.append(edge)
                places[edge] = (w.places[name, stream], f"{w.draft.name}.{name} takes {made.node}/{made.port}")
    for _ in range(MAX_CYCLES):
        cycle = stuck_cycle(edges)
        if cycle is None:
            return
        start = cycle.edges.index(min(cycle.edges, key=edges.index))
        around = (*cycle.edges[start:], *cycle.edges[:start])
        way = " -> ".join([around[0].producer, *(e.consumer for e in around)])
        if any(e.before for e in around):
            what, hint = "cycle whose 'before' is too short", "lengthen it by more than that sum"
        else:
            what, hint = "cycle without 'before'", "declare one of these inputs Sampled(before=True)"
        sums = f"its demands sum to {format_duration(cycle.demand)}, and must be below 0"
        edge_places = [places[e] for e in around]
        problems.add(edge_places[0][0], f"{what}: {way} would wait for itself ({sums})", hint, edge_places)
        edges = [e for e in edges if e not in cycle.edges]


def fed_by_devices(wired: Sequence[WiredOperator], streams: Mapping[str, Stream], *, live: bool) -> set[str]:
    """Names of the operators that have a source upstream that cannot wait (`Source.real_time`; in a live run, any)."""
    takers: dict[str, set[str]] = {w.draft.name: set() for w in wired}
    for w in wired:
        for stream in {stream for taken in w.inputs.values() for stream in taken}:
            takers[streams[stream].node].add(w.draft.name)
    devices = {w.draft.name for w in wired if issubclass(w.draft.cls, Source) and (w.draft.cls.real_time or live)}
    return devices | reached(devices, takers.__getitem__)


def in_order(wired: Sequence[WiredOperator], streams: Mapping[str, Stream]) -> list[str]:
    """Producers before consumers, otherwise as written; edges of inputs with `before` count only where they can."""
    index = {w.draft.name: i for i, w in enumerate(wired)}
    firm: dict[str, set[str]] = {name: set() for name in index}
    for w in wired:
        for name, taken in w.inputs.items():
            if not w.draft.cls.spec.inputs[name].before:
                firm[w.draft.name] |= {streams[s].node for s in taken} - {w.draft.name}
    waiting = {name: set(before) for name, before in firm.items()}
    consumers: dict[str, list[str]] = {name: [] for name in index}
    for name, producers in firm.items():
        for producer in producers:
            consumers[producer].append(name)
    ready = [index[name] for name, before in waiting.items() if not before]
    heapq.heapify(ready)
    names = list(index)
    ordered: list[str] = []
    while ready:
        name = names[heapq.heappop(ready)]
        ordered.append(name)
        for consumer in consumers[name]:
            waiting[consumer].discard(name)
            if not waiting[consumer]:
                heapq.heappush(ready, index[consumer])
    return ordered + [name for name in names if name not in set(ordered)]  # the rest: a cycle, which is reported
