"""Neighbouring keyframes measured against each other, by eyes that may mistake a pattern for its repetition."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
import pytest

from dataflow.messages.geometry import invert
from operators.geometry.se3 import Matrix
from operators.slam.keyframe_graph import Node
from operators.slam.place_graph import PlaceGraph
from operators.slam.visual.graph import GraphSettings
from operators.slam.visual.view import ViewMatch


class Eyes:
    """Sees neighbours where they are, or one `period` further on."""

    def __init__(self, period: float) -> None:
        self._off = at(period)

    def distance(self, T_a: Matrix, T_b: Matrix) -> float:
        return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]))

    def sight(self, nodes: Mapping[int, Node[str]], known: int, seen: int, expected: bool) -> ViewMatch:
        T = invert(nodes[known].T_odom) @ nodes[seen].T_odom @ self._off
        return ViewMatch(T, 1e-6 * np.eye(6), 90, 60, 30, 0.8, 0.95)


class NoLooks:
    def add(self, key: int, view: str) -> None: ...

    def likeness(self, view: str) -> dict[int, float]:
        return defaultdict(float)


def at(x: float) -> Matrix:
    T = np.eye(4)
    T[0, 3] = x
    return T


@pytest.mark.parametrize(("period", "joined"), [(0.0, True), (0.02, True), (1.4, False)])
def test_a_neighbour_seen_far_from_where_odometry_has_it_is_no_measurement(period: float, joined: bool) -> None:
    graph = PlaceGraph[str](GraphSettings(), NoLooks, lambda node, T, covariance: 1e-6 * np.eye(6))
    for k in range(6):
        graph.grow(k, at(0.25 * k), 1e-6 * np.eye(6), 0, False, Eyes(period), lambda: "view")
    assert any(edge.loop for edge in graph.graph.edges) == joined


def test_withdrawn_nodes_leave_the_map_unchanged() -> None:
    graph = PlaceGraph[str](GraphSettings(), NoLooks, lambda node, T, covariance: 1e-6 * np.eye(6))
    for k in range(6):
        graph.grow(k, at(0.25 * k), 1e-6 * np.eye(6), 0, False, Eyes(0.0), lambda: "view")
    before = {k: node.T.copy() for k, node in graph.nodes.items()}
    for k in range(6, 9):
        graph.grow(k, at(5.0 + 0.25 * k), 1e-6 * np.eye(6), 0, k == 6, Eyes(0.0), lambda: "view")
    graph.withdraw(6)
    assert sorted(graph.nodes) == sorted(before)
    assert all(edge.first in before and edge.last in before for edge in graph.graph.edges)
    assert all(np.allclose(graph.nodes[k].T, T, atol=1e-6) for k, T in before.items())
    graph.grow(9, at(1.6), 1e-6 * np.eye(6), 1, False, Eyes(0.0), lambda: "view")
    assert not graph.located
