"""The pose graph on made loops with known truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.slam import motions
from operators.slam.pose_graph import Edge, optimised

NOISE = np.array([0.02] * 3 + [0.01] * 3)


def ring(seed: int, count: int = 60) -> tuple[list[Matrix], list[Matrix], list[Edge]]:
    """True poses around a circle, those of drifting odometry, and its edges."""
    rng = np.random.default_rng(seed)
    step = se3.exp(np.array([0.5, 0, 0, 0, 0, 2 * np.pi / count]))
    truth, estimate, edges = [np.eye(4)], [np.eye(4)], []
    for k in range(count):
        measured = step @ se3.exp(rng.normal(0, 1, 6) * NOISE)
        truth.append(truth[-1] @ step)
        estimate.append(estimate[-1] @ measured)
        edges.append(Edge(k, k + 1, measured, np.diag(NOISE**-2), False))
    return truth, estimate, edges


def loop(truth: list[Matrix], a: int, b: int) -> Edge:
    return Edge(a, b, invert(truth[a]) @ truth[b], np.eye(6) * 1e4, True)


def worst(poses: list[Matrix], truth: list[Matrix]) -> float:
    return max(float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in zip(poses, truth, strict=True))


twists = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array)


@given(st.lists(twists, min_size=1, max_size=5))
def test_many_motions_at_once_are_those_one_at_a_time(many: list[np.ndarray]) -> None:
    T = np.array([se3.exp(x) for x in many])
    np.testing.assert_allclose(motions.exps(np.array(many)), T, atol=1e-12)
    np.testing.assert_allclose(motions.adjoints(T), [se3.adjoint(one) for one in T], atol=1e-12)
    np.testing.assert_allclose(motions.logs(T), [se3.log(one) for one in T], atol=1e-9)
    bent = T + 1e-4
    np.testing.assert_allclose(se3.orthonormalised(bent), [se3.orthonormalised(one) for one in bent], atol=1e-9)


def test_logs_of_half_turns_and_of_no_turn_are_those_one_at_a_time() -> None:
    half = np.diag([1.0, -1.0, -1.0, 1.0])
    T = np.array([np.eye(4), half, se3.exp(np.array([1, 2, 3, 1e-8, 0, 0]))])
    np.testing.assert_allclose(motions.logs(T), [se3.log(one) for one in T], atol=1e-12)


@given(st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6).map(np.array), twists)
def test_the_right_jacobian_predicts_small_steps(e: np.ndarray, direction: np.ndarray) -> None:
    x = 1e-5 * direction
    exact = se3.log(se3.exp(e) @ se3.exp(x)) - se3.log(se3.exp(e))
    np.testing.assert_allclose(motions.right_jacobians_inverse(e[None])[0] @ x, exact, atol=2e-8)


@pytest.mark.parametrize("seed", range(3))
def test_a_loop_takes_drift_away(seed: int) -> None:
    truth, estimate, edges = ring(seed)
    found = optimised(estimate, [*edges, loop(truth, 0, 60), loop(truth, 1, 59)])
    assert worst(found.poses, truth) < 0.7 * worst(estimate, truth)
    assert np.linalg.norm(found.poses[60][:3, 3] - truth[60][:3, 3]) < 0.02
    assert (found.poses[0] == estimate[0]).all()
    assert (found.weights > 0.5).all()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6))
def test_the_optimum_has_no_gradient_and_does_not_depend_on_where_it_is_looked_for(seed: int) -> None:
    """No small step of a node makes the sum of squares less, by differences, whatever the poses were at first."""
    truth, estimate, edges = ring(seed, 8)
    edges = [*edges, Edge(0, 8, invert(truth[0]) @ truth[8], np.eye(6) * 1e4, False)]
    found = optimised(estimate, edges).poses
    np.testing.assert_allclose(optimised(truth, edges).poses, found, atol=1e-4)

    def cost(poses: list[Matrix]) -> float:
        total = 0.0
        for edge in edges:
            e = se3.log(invert(edge.T) @ invert(poses[edge.first]) @ poses[edge.last])
            total += float(e @ edge.information @ e)
        return total

    least = cost(found)
    for node in (3, 8):
        for axis in range(6):
            for way in (-1e-3, 1e-3):
                moved = list(found)
                moved[node] = found[node] @ se3.exp(way * np.eye(6)[axis])
                assert cost(moved) > least


def test_wrong_loop_closure_is_outvoted_and_down_weighted() -> None:
    truth, estimate, edges = ring(0)
    right = [*edges, loop(truth, 0, 60), loop(truth, 1, 59)]
    wrong = Edge(10, 40, np.eye(4), np.eye(6) * 1e4, True)
    with_wrong = optimised(estimate, [*right, wrong])
    assert abs(worst(with_wrong.poses, truth) - worst(optimised(estimate, right).poses, truth)) < 0.01
    assert with_wrong.weights[-1] < 0.01
    assert with_wrong.weights[:-1].min() > 0.5


def test_fixed_nodes_stay_and_hold_the_others() -> None:
    truth, estimate, edges = ring(1)
    poses = [*truth[:3], *estimate[3:]]
    found = optimised(poses, edges, fixed=3).poses
    assert all((a == b).all() for a, b in zip(found[:3], truth[:3], strict=True))
    assert worst(found, estimate) > 0


def test_without_edges_poses_stay() -> None:
    _, estimate, _ = ring(0, 4)
    found = optimised(estimate, [])
    assert all((a == b).all() for a, b in zip(found.poses, estimate, strict=True))
    assert len(optimised(estimate[:1], []).poses) == 1


def test_a_node_that_nothing_ties_stays() -> None:
    truth, estimate, edges = ring(2, 10)
    found = optimised([*estimate, truth[3]], [*edges, loop(truth, 0, 10)]).poses
    np.testing.assert_allclose(found[-1], truth[3], atol=1e-12)


def test_equal_graphs_give_equal_bytes() -> None:
    truth, estimate, edges = ring(3)
    results = {np.array(optimised(estimate, [*edges, loop(truth, 0, 60)]).poses).tobytes() for _ in range(20)}
    assert len(results) == 1
