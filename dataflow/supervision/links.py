"""The links between the processes of a run: a ring and a board for each pair, and an eventfd for each process.

They last as long as the run: a process that takes another's place inherits the same.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

from dataflow.graph.model import Graph
from dataflow.supervision.plan import LINK, ProcessPlan, taken_keys
from dataflow.transport import make_board, make_ring

Pairs = Mapping[tuple[str, str], tuple[str, ...]]
"""(producer, consumer) → the keys that pass between them, sorted: the number of a channel is a place in it."""


def pairs_of(graph: Graph, processes: Mapping[str, ProcessPlan]) -> dict[tuple[str, str], tuple[str, ...]]:
    """Returns which processes are linked: the recorder and the like first.

    What passes between machines goes through the gates of both. A process sends in this order: if it is killed between
    two sends, each message that another process has is recorded.
    """
    found: dict[tuple[str, str], set[str]] = {}
    for consumer, process in sorted(processes.items(), key=lambda each: each[1].sink is None):
        taken = taken_keys(graph, process)
        for producer, maker in processes.items():
            if producer != consumer and (keys := taken.intersection(maker.publish)):
                for pair in _hops(maker, process):
                    found.setdefault(pair, set()).update(keys)
    return {pair: tuple(sorted(keys)) for pair, keys in found.items()}


def _hops(maker: ProcessPlan, taker: ProcessPlan) -> list[tuple[str, str]]:
    if maker.machine == taker.machine:
        return [(maker.label, taker.label)]
    return [(maker.label, gate_of(maker.machine)), (gate_of(taker.machine), taker.label)]


def gate_of(machine: str | None) -> str:
    """Returns the label of the gate of a machine; None: that of the supervisor."""
    return LINK if machine is None else f"{LINK} {machine}"


class Links:
    """The memory and the eventfds of all links. Raises `OSError` when there are too many."""

    def __init__(self, labels: list[str], pairs: Pairs) -> None:
        self._all: list[int] = []
        self._wakes = {label: self._kept(os.eventfd(0, os.EFD_NONBLOCK)) for label in labels}
        self._links = {pair: (self._kept(make_ring()), self._kept(make_board())) for pair in pairs}

    def _kept(self, descriptor: int) -> int:
        self._all.append(descriptor)
        return descriptor

    def handed(self, label: str) -> list[int]:
        """Returns what a process inherits: see `dataflow.process.descriptors.take_descriptors`."""
        given = [self._wakes[label]]
        for (producer, consumer), (ring, board) in self._links.items():
            if producer == label:
                given += [ring, self._wakes[consumer], board]
        for (producer, consumer), (ring, board) in self._links.items():
            if consumer == label:
                given += [ring, self._wakes[producer], board]
        return given

    def close(self) -> None:
        for descriptor in self._all:
            os.close(descriptor)
        self._all.clear()
