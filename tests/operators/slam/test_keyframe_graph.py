"""The graph of keyframes: what settles, what stays, and what retired keyframes leave behind."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.slam.keyframe_graph import KeyframeGraph, Node, composed, turned
from operators.slam.pose_graph import Edge

SMALL = np.diag([1e-4] * 3 + [1e-5] * 3)


def node(stamp: int, T: Matrix) -> Node:
    return Node(stamp, T, np.zeros((6, 6)), T, np.zeros((6, 6)), 0.0, 0, None)


def row(count: int, error: float = 0.0) -> tuple[KeyframeGraph, list[Matrix]]:
    """A chain of nodes, each turned a little from the last; every measured step errs alike."""
    step = se3.exp(np.array([0.3, 0.0, 0.1, 0.0, 0.2, 0.0]))
    measured = step @ se3.exp(np.array([error, 0, 0, 0, error, 0]))
    graph, truth, T = KeyframeGraph(), [np.eye(4)], np.eye(4)
    graph.add(node(0, T))
    for k in range(1, count):
        T = T @ measured
        truth.append(truth[-1] @ step)
        graph.add(node(k, T))
        graph.join(k - 1, k, measured, SMALL, loop=False)
    return graph, truth


def off(graph: KeyframeGraph, truth: list[Matrix]) -> list[float]:
    return [float(np.linalg.norm((invert(truth[k]) @ n.T)[:3, 3])) for k, n in graph.nodes.items()]


def test_a_loop_moves_all_but_the_first_and_a_window_only_the_newest() -> None:
    for window in (None, 4):
        graph, truth = row(12, 0.01)
        before = {k: n.T.copy() for k, n in graph.nodes.items()}
        drifted = off(graph, truth)
        graph.join(0, 11, truth[11], 1e-3 * SMALL, loop=True)
        graph.settle(window)
        moved = [k for k, n in graph.nodes.items() if np.abs(n.T - before[k]).max() > 0]
        assert moved == (list(range(1, 12)) if window is None else [8, 9, 10, 11])
        assert off(graph, truth)[11] < 0.2 * drifted[11]


def test_loaded_nodes_never_move() -> None:
    graph = KeyframeGraph()
    graph.begin_with([node(0, np.eye(4)), node(1, se3.exp(np.array([1.0, 0, 0, 0, 0, 0])))])
    number = graph.add(node(2, np.eye(4)))
    assert number == 2
    graph.join(1, 2, np.eye(4), SMALL, loop=True)
    graph.join(0, 1, np.eye(4), SMALL, loop=False)  # contradicts where node 1 is
    graph.settle()
    assert graph.nodes[1].T[0, 3] == 1.0
    np.testing.assert_allclose(graph.nodes[2].T[:3, 3], [1.0, 0, 0], atol=1e-9)


def test_a_retired_node_leaves_its_chain_and_its_loops_between_its_neighbours() -> None:
    graph, truth = row(6)
    graph.join(0, 3, truth[3], SMALL, loop=True)
    graph.join(1, 3, invert(truth[1]) @ truth[3], SMALL, loop=True)
    graph.edges = [e for e in graph.edges if (e.first, e.last) != (0, 1)]
    graph.retire(3)
    assert sorted(graph.nodes) == [0, 1, 2, 4, 5]
    ends = {(e.first, e.last): e for e in graph.edges}
    assert set(ends) == {(1, 2), (2, 4), (4, 5), (0, 1)}
    for (a, b), edge in ends.items():
        np.testing.assert_allclose(edge.T, invert(truth[a]) @ truth[b], atol=1e-9)
    # Two steps are less certain than one.
    assert np.trace(np.linalg.inv(ends[2, 4].information)) > np.trace(np.linalg.inv(ends[1, 2].information))
    assert not ends[2, 4].loop
    assert ends[0, 1].loop
    assert graph.add(node(9, np.eye(4))) == 6


twists = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array)


@settings(deadline=None)
@given(twists, twists, st.integers(0, 10**6))
def test_edges_compose_and_turn_as_drawn_measurements_do(a: np.ndarray, b: np.ndarray, seed: int) -> None:
    """The covariances are those of many drawn errors, to first order."""
    rng = np.random.default_rng(seed)
    C_one, C_two = np.diag(rng.uniform(0.5, 2, 6)) * 1e-6, np.diag(rng.uniform(0.5, 2, 6)) * 1e-6
    one = Edge(0, 1, se3.exp(a), np.linalg.inv(C_one), True)
    two = Edge(1, 2, se3.exp(b), np.linalg.inv(C_two), True)
    T, covariance = composed(one, two)
    np.testing.assert_allclose(T, one.T @ two.T, atol=1e-12)
    J = se3.adjoint(invert(two.T))
    np.testing.assert_allclose(covariance, J @ C_one @ J.T + C_two, atol=1e-12)
    back = turned(one)
    assert (back.first, back.last) == (1, 0)
    np.testing.assert_allclose(back.T, invert(one.T), atol=1e-12)
    x = 1e-6 * rng.standard_normal(6)
    moved = se3.log(invert(back.T) @ invert(one.T @ se3.exp(x)))
    np.testing.assert_allclose(moved, -se3.adjoint(one.T) @ x, atol=1e-9)
    J = se3.adjoint(one.T)
    np.testing.assert_allclose(np.linalg.inv(back.information), J @ C_one @ J.T, atol=1e-10)
