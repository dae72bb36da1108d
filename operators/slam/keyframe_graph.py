"""Keyframes and the measured motions between them; all their poses, or those of the newest, are corrected at once."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry.se3 import Matrix
from operators.odometry.tracking import moved_covariance
from operators.slam.pose_graph import Edge, optimised

V = TypeVar("V")  # what a keyframe keeps of its place

SAVED = -1  # the island of nodes that were loaded


@dataclass(eq=False)
class Node(Generic[V]):
    """A keyframe in the graph: `T_odom` and `T` (4, 4) pose the sensor in the odometry frame, as it was said, and in
    the map; `covariance_odom` and `covariance` (6, 6) are theirs. A place that has a view already has no second one.
    """

    stamp: int
    T_odom: Matrix
    covariance_odom: Matrix
    T: Matrix
    covariance: Matrix
    travel: float  # change of view on the way here
    island: int  # one number for all that one unbroken chain of odometry joins
    view: V | None


@dataclass(eq=False)
class KeyframeGraph(Generic[V]):
    """Nodes by number, which ascends with time, and edges between them. Fixed nodes are never moved."""

    nodes: dict[int, Node[V]] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    fixed: set[int] = field(default_factory=set)

    def begin_with(self, nodes: Iterable[Node[V]]) -> None:
        """Begins with nodes that never move."""
        self.nodes = dict(enumerate(nodes))
        self.edges, self.fixed = [], set(self.nodes)

    def add(self, node: Node[V]) -> int:
        """Returns the number of the new node; the first one is fixed."""
        number = 1 + max(self.nodes, default=-1)
        self.nodes[number] = node
        if not self.fixed:
            self.fixed.add(number)
        return number

    @property
    def newest(self) -> int:
        return max(self.nodes)

    def join(self, first: int, last: int, T: Matrix, covariance: Matrix, *, loop: bool) -> None:
        """Adds an edge: the pose of `last` in `first`, with the covariance (6, 6) of its right perturbation."""
        self.edges.append(Edge(first, last, T, np.asarray(np.linalg.inv(covariance), np.float64), loop))

    def joined(self, a: int, b: int) -> bool:
        return any({edge.first, edge.last} == {a, b} for edge in self.edges)

    def settle(self, newest: int | None = None) -> None:
        """Moves the nodes, or only so many of the newest, to where the edges have them."""
        free = [k for k in self.nodes if k not in self.fixed][-newest if newest else 0 :]
        chosen = set(free)
        edges = [edge for edge in self.edges if edge.first in chosen or edge.last in chosen]
        held = sorted({end for edge in edges for end in (edge.first, edge.last)} - chosen)
        if not free or not held:
            return
        place = {k: i for i, k in enumerate([*held, *free])}
        renumbered = [Edge(place[e.first], place[e.last], e.T, e.information, e.loop) for e in edges]
        poses = optimised([self.nodes[k].T for k in place], renumbered, len(held)).poses
        for k in free:
            self.nodes[k].T = poses[place[k]]

    def retire(self, number: int) -> None:
        """Removes a node; what its edges said of its neighbours, edges between those say.

        The chain is closed over it, and of two loops to it one is made where there is none yet.
        """
        before = [e for e in self.edges if e.last == number]
        after = [e for e in self.edges if e.first == number]
        self.remove({number})
        chain = [e for e in before if not e.loop]
        for one in chain[-1:]:
            for two in after:
                T, covariance = composed(one, two)
                self.join(one.first, two.last, T, covariance, loop=two.loop)
        loops = [e for e in before if e.loop]
        for i, one in enumerate(loops):
            for two in loops[i + 1 :]:
                if not self.joined(one.first, two.first):
                    back = turned(two)
                    T, covariance = composed(one, back)
                    self.join(one.first, back.last, T, covariance, loop=True)

    def remove(self, numbers: Collection[int]) -> None:
        """Removes nodes and all edges to them."""
        self.nodes = {k: node for k, node in self.nodes.items() if k not in numbers}
        self.edges = [e for e in self.edges if e.first not in numbers and e.last not in numbers]


def turned(edge: Edge) -> Edge:
    """Returns the same measurement from the other end."""
    covariance = moved_covariance(np.asarray(np.linalg.inv(edge.information)), edge.T, np.eye(4))
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    return Edge(edge.last, edge.first, invert(edge.T), information, edge.loop)


def composed(one: Edge, two: Edge) -> tuple[Matrix, Matrix]:
    """Returns the pose (4, 4) and covariance (6, 6) of one edge after another."""
    carried = moved_covariance(np.asarray(np.linalg.inv(one.information)), np.eye(4), two.T)
    return one.T @ two.T, np.asarray(carried + np.linalg.inv(two.information), np.float64)
