"""Rule 4: the cycles that are accepted do make progress when wired up, and those that cannot are refused."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field
from hashlib import blake2b
from itertools import permutations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.sync import (
    NEVER,
    Aligner,
    AlignSpec,
    BatchSpec,
    Edge,
    Entry,
    Firing,
    SampledSpec,
    TriggerSpec,
    refs_of,
    stuck_cycle,
    trail,
)

from .scenarios import Step, entries, tell

PATIENCE = 20_000


@dataclass
class Graph:
    """Operators by name, each with one output stream of the same name, and sources with what they say."""

    specs: dict[str, AlignSpec]
    sources: dict[str, list[Step]]
    lags: dict[str, int] = field(default_factory=dict)

    def edges(self) -> list[Edge]:
        found = []
        for consumer, spec in self.specs.items():
            for i, trigger in enumerate(spec.triggers):
                for s in trigger.streams:
                    found.append(
                        Edge(s, consumer, trigger.name, "trigger", None, spec.tolerance, i == 0, self.lags.get(s, 0))
                    )
            for sampled in spec.sampled:
                for s in sampled.streams:
                    found.append(Edge(s, consumer, sampled.name, "sampled", sampled.before, lag=self.lags.get(s, 0)))
            for batch in spec.batches:
                for s in batch.streams:
                    found.append(Edge(s, consumer, batch.name, "batch", lag=self.lags.get(s, 0)))
        return found


def execute(graph: Graph, seed: int) -> tuple[dict[str, list[object]], bool]:
    """Wires the operators up and delivers in a random order: all firings, and whether all operators ended."""
    rng = random.Random(seed)
    aligners = {name: Aligner(spec) for name, spec in graph.specs.items()}
    ports = {name: [NEVER, NEVER, 0] for name in aligners}  # last stamp, last frontier sent, seq
    queues: dict[tuple[str, str], deque[Step]] = {}
    for name, spec in graph.specs.items():
        for stream in spec.streams:
            queues[stream, name] = deque(graph.sources.get(stream, ()))
    log: dict[str, list[object]] = {name: [] for name in aligners}

    def send(name: str, step: Step) -> None:
        for (stream, _), queue in queues.items():
            if stream == name:
                queue.append(step)

    def emit(name: str, firing: Firing) -> None:
        last, _, seq = ports[name]
        content = blake2b(repr((name, refs_of(firing))).encode(), digest_size=4).digest()
        stamp = firing.stamp - content[0] % (graph.lags.get(name, 0) + 1)
        if content[1] % 4 and stamp > last:
            ports[name] = [stamp, max(stamp, ports[name][1]), seq + 1]
            send(name, ("push", name, Entry(stamp, None, seq, stream=name)))

    def turn(name: str) -> None:
        aligner = aligners[name]
        while not aligner.ended():
            firing = aligner.poll()
            if firing is not None:
                log[name].append(refs_of(firing))
                emit(name, firing)
                if firing.kind == "finish":
                    final = aligner.final_stamp()
                    assert final is not None
                    send(name, ("end", name, max(final, *ports[name][:2])))
                    return
            frontier = trail(aligner.output_frontier(), graph.lags.get(name, 0))
            if frontier > ports[name][1]:
                ports[name][1] = frontier
                send(name, ("advance", name, frontier))
            if firing is None:
                return

    for name in aligners:
        turn(name)
    for _ in range(PATIENCE):
        waiting = [key for key, queue in queues.items() if queue]
        if not waiting:
            return log, all(aligner.ended() for aligner in aligners.values())
        stream, name = rng.choice(waiting)
        for _ in range(rng.choice((1, 1, 5))):
            if queues[stream, name]:
                tell(aligners[name], queues[stream, name].popleft())
        turn(name)
    return log, False


def source(name: str, *stamps: int) -> list[Step]:
    return [*(("push", name, e) for e in entries(name, *stamps)), ("end", name, stamps[-1])]


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    names = [f"n{i}" for i in range(draw(st.integers(1, 4)))]
    sources = {
        name: source(name, *draw(st.lists(st.integers(0, 40), unique=True, min_size=1, max_size=6).map(sorted)))
        for name in ("s0", "s1")
    }
    anywhere = st.sampled_from([*names, "s0", "s1"])
    mostly_sources = st.sampled_from(["s0", "s1", "s0", "s1", *names])
    specs = {}
    for name in names:
        before = st.sampled_from([None, 1, 1, 3, 12])
        triggers = tuple(TriggerSpec(f"t{i}", (draw(mostly_sources),)) for i in range(draw(st.integers(0, 2))))
        sampled = tuple(
            SampledSpec(f"x{i}", (draw(anywhere),), draw(st.none() | st.integers(0, 20)), False, draw(before))
            for i in range(draw(st.integers(0, 2)))
        )
        batches = tuple(BatchSpec("b0", (draw(mostly_sources),)) for _ in range(draw(st.integers(0, 1))))
        mode = draw(st.sampled_from(["join", "merge"]))
        every = draw(st.none() | st.integers(4, 15))
        if every is None and not triggers:
            triggers = (TriggerSpec("t0", ("s0",)),)
        if not triggers and not batches and all(x.before for x in sampled):
            batches = (BatchSpec("b0", ("s1",)),)
        tolerance = draw(st.sampled_from([0, 0, 2, 5])) if mode == "join" and len(triggers) > 1 else 0
        specs[name] = AlignSpec(triggers, sampled, batches, mode, tolerance, every)
    lags = {name: draw(st.sampled_from([0, 0, 0, 1, 4])) for name in names}
    return Graph(specs, sources, lags)


@settings(max_examples=150, deadline=None)
@given(graphs(), st.integers(0, 2**32 - 1))
def test_accepted_graphs_run_to_their_end_the_same_way_in_any_order_of_delivery(graph: Graph, seed: int) -> None:
    if stuck_cycle(graph.edges()) is not None:
        return
    log, ended = execute(graph, seed)
    assert ended, "every operator ends: no deadlock"
    assert execute(graph, seed + 1) == (log, True)


def worst_simple_cycle(edges: list[Edge]) -> int | None:
    """The largest sum of demands over simple cycles, by trying them all."""
    nodes = sorted({n for e in edges for n in (e.producer, e.consumer)})
    best: dict[tuple[str, str], int] = {}
    for edge in edges:
        way = (edge.producer, edge.consumer)
        best[way] = max(best.get(way, edge.demand), edge.demand)
    sums = []
    for size in range(1, len(nodes) + 1):
        for order in permutations(nodes, size):
            ways = list(zip(order, (*order[1:], order[0]), strict=True))
            if all(way in best for way in ways):
                sums.append(sum(best[way] for way in ways))
    return max(sums, default=None)


nodes = st.sampled_from("pqrst")


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.builds(
            Edge,
            nodes,
            nodes,
            st.sampled_from("xyz"),
            st.sampled_from(["trigger", "sampled", "batch"]),
            st.none() | st.integers(1, 4),
            st.integers(0, 3),
            st.booleans(),
            st.integers(0, 3),
        ),
        max_size=9,
    )
)
def test_exactly_the_graphs_with_a_cycle_of_demand_zero_or_more_are_refused(edges: list[Edge]) -> None:
    worst = worst_simple_cycle(edges)
    cycle = stuck_cycle(edges)
    assert (cycle is not None) == (worst is not None and worst >= 0)
    if cycle is not None:
        assert cycle.demand >= 0
        for edge, following in zip(cycle.edges, [*cycle.edges[1:], cycle.edges[0]], strict=True):
            assert edge.consumer == following.producer
            assert edge in edges


def feedback(before: int | None, lag: int = 0) -> Graph:
    """A filter that corrects itself by its own controller's last output."""
    specs = {
        "filter": AlignSpec(
            (TriggerSpec("scan", ("s0",)),), (SampledSpec("hint", ("plan",), required=False, before=before),)
        ),
        "plan": AlignSpec((TriggerSpec("state", ("filter",)),)),
    }
    return Graph(specs, {"s0": source("s0", 3, 10, 17)}, {"plan": lag})


def test_feedback_without_delay_is_refused_and_does_deadlock_when_wired() -> None:
    graph = feedback(before=None)
    cycle = stuck_cycle(graph.edges())
    assert cycle is not None
    assert {edge.input for edge in cycle.edges} == {"hint", "state"}
    assert "declare one of its inputs Sampled(before=True)" in str(cycle)
    log, ended = execute(graph, 0)
    assert (log, ended) == ({"filter": [], "plan": []}, False)


@pytest.mark.parametrize(("before", "lag", "accepted"), [(1, 0, True), (1, 1, False), (5, 4, True), (5, 5, False)])
def test_feedback_must_reach_farther_back_than_the_port_lags(before: int, lag: int, accepted: bool) -> None:
    graph = feedback(before, lag)
    assert (stuck_cycle(graph.edges()) is None) == accepted
    assert execute(graph, 0)[1] == accepted


def test_a_tolerance_join_in_a_loop_needs_feedback_from_beyond_it() -> None:
    def loop(before: int) -> list[Edge]:
        return [
            Edge("join", "plan", "state"),
            Edge("filter", "join", "anchor", tolerance=5, anchor=True),
            Edge("plan", "filter", "hint", "sampled", before),
        ]

    assert stuck_cycle(loop(10)) is not None
    assert stuck_cycle(loop(11)) is None


def test_static_streams_are_no_part_of_a_cycle() -> None:
    assert stuck_cycle([Edge("a", "b", "x"), Edge("b", "a", "info", "sampled", static=True)]) is None
