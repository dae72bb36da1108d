"""Goals of made ways: what a path tells of candidates, how beliefs follow it, and the shipped network's answers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from operators.scene.goal_network import open_goal_network
from operators.scene.goals import COUNT, NAMES, NOWHERE, GoalInference, GoalPath, Places
from operators.scene.bodies import Body
from operators.weights import NetworkFileError, shipped

STILL = np.zeros(3)


def thing(id: int, label: str, x: float, y: float, z: float, size: Sequence[float], yaw: float = 0.0) -> Body:
    return Body(id, label, np.array([x, y, z]), np.array(size, np.float64), yaw, STILL)


def person(x: float, y: float) -> Body:
    return thing(9, "person", x, y, 0.85, (0.4, 0.55, 1.7))


def chair(id: int, x: float, y: float) -> Body:
    return thing(id, "chair", x, y, 0.45, (0.5, 0.5, 0.9))


def column(described: np.ndarray, name: str) -> list[float]:
    return [round(float(v), 3) for v in described[:, NAMES.index(name)]]


def walked(path: GoalPath, steps: int, speed: float = 0.6) -> None:
    for k in range(steps):
        path.add(0.25 * k, person(speed * 0.25 * k, 0.0))


def test_a_way_tells_how_much_nearer_it_brought_each_candidate() -> None:
    path = GoalPath()
    walked(path, 9)  # 1.2 m in 2 s, along x
    described = path.describe(Places.of([chair(1, 3, 0), chair(2, -1, 0)], []))
    assert described.shape == (3, COUNT)
    assert column(described, "brought nearer")[:2] == [1.2, -1.2]
    assert column(described, "away")[:2] == [1.8, 2.2]
    assert column(described, "closing")[:2] == [0.6, -0.6]
    assert column(described, "is nowhere") == [0, 0, 1]


def test_a_drink_lies_before_who_faces_the_table_that_carries_it() -> None:
    """The table's long side runs along x at y = 1; whoever stands at y = 0 faces +y and has +x at the right hand."""
    table = thing(3, "table", 0, 1, 0.45, (2, 0.6, 0.9))
    mug = thing(4, "mug", 0.2, 0.9, 0.95, (0.1, 0.1, 0.1))
    ahead, right = Places.of([mug], [table]).before(np.zeros(2))
    assert (ahead[0], right[0]) == pytest.approx((0.9, 0.2))
    ahead, right = Places.of([mug], [table]).before(np.array([0.0, 2.0]))  # from the other side
    assert (ahead[0], right[0]) == pytest.approx((1.1, -0.2))


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_ahead_and_right_are_a_rotation(x: float, y: float, yaw: float) -> None:
    places = Places.of([thing(1, "chair", x, y, 0.5, (0.5, 0.4, 1), yaw)], [])
    ahead, right = places.before(np.zeros(2))
    assert math.hypot(ahead[0], right[0]) == pytest.approx(math.hypot(x, y), abs=1e-9)
    assert ahead[0] >= -1e-9


def test_a_new_way_begins_where_somebody_has_stood_for_a_while() -> None:
    path = GoalPath()
    walked(path, 9)
    for k in range(12):
        path.add(2.0 + 0.25 * (k + 1), person(1.2, 0.0))
    described = path.describe(Places.of([chair(1, 3, 0)], []))
    assert column(described, "walked") == [0, 0]
    assert column(described, "brought nearer")[0] == 0


def test_probabilities_sum_to_one_and_follow_the_way() -> None:
    inference = GoalInference(open_goal_network(shipped("goals.onnx")), 0.4)
    places = Places.of([chair(1, 2.6, 0.5), chair(2, -1.5, 0.5)], [])
    for k in range(12):
        likely = inference.update(0.25 * k, person(0.15 * k, 0.0), places)
        assert sum(likely.values()) == pytest.approx(1)
    assert set(likely) == {1, 2, NOWHERE}
    assert likely[1] > 5 * likely[2]


def test_scores_are_averaged_over_time() -> None:
    said = iter([[0.0, 0.0], [2.0, 0.0]])
    inference = GoalInference(lambda rows: np.array(next(said), np.float32), 1.0)
    places = Places.of([chair(1, 1, 0)], [])
    assert inference.update(0.0, person(0, 0), places)[1] == pytest.approx(0.5)
    expected = 2 * (1 - math.exp(-1))
    assert inference.update(1.0, person(0, 0), places)[1] == pytest.approx(1 / (1 + math.exp(-expected)))


def test_the_state_goes_on_after_a_snapshot() -> None:
    score = open_goal_network(shipped("goals.onnx"))
    places = Places.of([chair(1, 2.6, 0.5), chair(2, 1.5, -0.5)], [])
    whole, other = GoalInference(score, 0.4), GoalInference(score, 0.4)
    for k in range(6):
        whole.update(0.25 * k, person(0.15 * k, 0.0), places)
    other.restore(whole.snapshot())
    for k in range(6, 12):
        here = person(0.15 * k, 0.0)
        assert other.update(0.25 * k, here, places) == whole.update(0.25 * k, here, places)


def test_things_out_of_reach_are_no_candidates() -> None:
    inference = GoalInference(lambda rows: np.zeros(len(rows), np.float32), 1.0)
    assert inference.update(0.0, person(0, 0), Places.of([chair(1, 40, 0)], [])) == {NOWHERE: 1.0}


def test_another_network_is_refused() -> None:
    with pytest.raises(NetworkFileError, match="a goals network is needed"):
        open_goal_network(shipped("activity.onnx"))
