"""Feedback: whether a graph's cycles can always make progress.

The *demand* of an edge is how far ahead of its next firing a consumer needs the producer's stream. An
operator's output frontier advances to t - 1 once its inputs' frontiers reach t + demand; round a cycle this
gets ahead only if the demands sum to less than zero.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from dataflow.sync.stamps import format_duration


@dataclass(frozen=True, slots=True)
class Edge:
    """A stream from operator `producer` to input `input` of operator `consumer`.

    before: of a Sampled input, as in `SampledSpec`. tolerance: of the join a trigger takes part in, as its
    `anchor` or not. lag: of the producer's port. static: the stream carries one message, sent before anything
    fires: no demand.
    """

    producer: str
    consumer: str
    input: str
    kind: Literal["trigger", "sampled", "batch"] = "trigger"
    before: int | None = None
    tolerance: int = 0
    anchor: bool = False
    lag: int = 0
    static: bool = False

    @property
    def demand(self) -> int:
        """Nanoseconds of the producer's future that the consumer needs; negative if its past is enough."""
        wanted = self.lag
        if self.kind == "trigger":
            wanted += 2 * self.tolerance if self.anchor else self.tolerance
        if self.kind == "sampled" and self.before is not None:
            wanted -= self.before
        return wanted


@dataclass(frozen=True, slots=True)
class Cycle:
    """A cycle that cannot make progress: each edge's consumer is the next edge's producer."""

    edges: tuple[Edge, ...]

    @property
    def demand(self) -> int:
        """The sum of the edges' demands, which is zero or more."""
        return sum(edge.demand for edge in self.edges)

    def __str__(self) -> str:
        way = " -> ".join([self.edges[0].producer, *(f"{edge.consumer}.{edge.input}" for edge in self.edges)])
        cure = "Sampled(before=True)"
        if self.demand > 0:
            cure = f"Sampled with a `before` more than {format_duration(self.demand)} longer"
        return (
            f"cycle {way} would wait for itself: its demands sum to {format_duration(self.demand)} and must "
            f"be below 0; declare one of its inputs {cure}"
        )


def stuck_cycle(edges: Iterable[Edge]) -> Cycle | None:
    """A cycle whose demands sum to zero or more, or None if every cycle of the graph makes progress."""
    live = [edge for edge in edges if not edge.static]
    nodes = sorted({node for edge in live for node in (edge.producer, edge.consumer)})
    scale = (
        len(nodes) + 1
    )  # turns "sum >= 0" into "sum > 0": a cycle without a repeated node has at most len(nodes) edges
    distance = dict.fromkeys(nodes, 0)
    via: dict[str, Edge] = {}
    improved = ""
    for _ in range(scale):  # the longest path from anywhere; what still grows after len(nodes) rounds hangs on a cycle
        improved = ""
        for edge in live:
            longer = distance[edge.producer] + edge.demand * scale + 1
            if longer > distance[edge.consumer]:
                distance[edge.consumer] = longer
                via[edge.consumer] = edge
                improved = edge.consumer
        if not improved:
            return None
    for _ in nodes:  # back far enough to stand on the cycle itself
        improved = via[improved].producer
    return Cycle(tuple(_walk_back(via, improved)))


def _walk_back(via: dict[str, Edge], start: str) -> Sequence[Edge]:
    walk = [via[start]]
    while walk[-1].producer != start:
        walk.append(via[walk[-1].producer])
    return walk[::-1]
