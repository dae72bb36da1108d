"""Where an agent is going, from its path and what there is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from operators.labels import LabelSpace, labels_file
from operators.scene.bodies import Body
from operators.scene.graph.agents import GoalInference
from operators.scene.graph.layers import GraphSettings, LayeredGraph

STEP = 250_000_000
roles = LabelSpace.read(Path(labels_file("simulator"))).roles


def thing(id: int, label: str, x: float, y: float, *, size: float = 0.1, z: float = 0.8, yaw: float = 0.0) -> Body:
    return Body(id, label, np.array([x, y, z]), np.full(3, size), yaw, np.zeros(3), roles(label))


def person(x: float, y: float) -> Body:
    return Body(9, "person", np.array([x, y, 0.85]), np.array([0.6, 0.4, 1.7]), 0.0, np.zeros(3), roles("person"))


def after(places: list[tuple[float, float]], goals: list[Body]) -> dict[int, float]:
    inference, found = GoalInference(), {-1: 1.0}
    for k, (x, y) in enumerate(places):
        found = inference.update(0.25 * k, person(x, y), goals)
    return found


def test_probabilities_of_goals_sum_to_one_and_follow_the_path() -> None:
    doors = [thing(1, "door", 4, 0, size=1), thing(2, "door", 0, 4, size=1)]
    for k in (4, 8, 14):
        found = after([(0.15 * n, 0.0) for n in range(k)], doors)
        assert sum(found.values()) == pytest.approx(1)
        assert found[1] > found[2]
    assert found[1] > 0.8


@pytest.mark.parametrize("side", [1, -1], ids=["left", "right"])
def test_goal_of_a_path_is_symmetric_in_left_and_right(side: int) -> None:
    """A person walks straight past one mug to another, which lies on this side of a table or on that."""
    mugs = [thing(2, "mug", 0.6, 0.3 * side), thing(3, "mug", 0.6, -0.3 * side)]
    found = after([(0.08 * k, 0.03 * side * k) for k in range(9)], mugs)
    assert max(found, key=lambda i: found[i]) == 2


def test_goal_added_later_is_judged_by_the_earlier_path() -> None:
    """Doors left and right, equally far from who has come from the left: that to the left was left behind."""
    left, right = thing(1, "door", -1, 0, size=1), thing(2, "door", 3, 0, size=1)
    inference, walk = GoalInference(), [0.2 * k for k in range(6)]
    for k, x in enumerate(walk):
        late = inference.update(0.25 * k, person(x, 0.0), [right] if k < 5 else [left, right])
    early = after([(x, 0.0) for x in walk], [left, right])
    assert late == early
    assert late[1] < 0.5 * late[2]


def test_jitter_of_a_still_box_leaves_goals_as_they_are() -> None:
    rng = np.random.default_rng(3)
    chair = [thing(1, "chair", 0.44, 0.0, size=0.5, z=0.4)]
    still = after([(0.0, 0.0)] * 40, chair)
    shaken = after([(float(x), float(y)) for x, y in rng.normal(0, 0.02, (39, 2))] + [(0.0, 0.0)], chair)
    assert shaken[1] == pytest.approx(still[1], abs=0.02)


@pytest.mark.parametrize(
    ("space", "near", "far", "goal"), [("simulator", "table", "door", 1), ("coco", "dining table", "couch", -1)]
)
def test_person_heads_for_the_goal_it_walks_to(space: str, near: str, far: str, goal: int) -> None:
    own = LabelSpace.read(Path(labels_file(space))).roles
    table = Body(1, near, np.array([1.0, 0.0, 0.4]), np.array([0.6, 1.6, 0.8]), 0.0, np.zeros(3), own(near))
    other = Body(2, far, np.array([-3.0, 0.0, 0.8]), np.ones(3), 0.0, np.zeros(3), own(far))
    graph = LayeredGraph(GraphSettings())
    for k in range(10):
        now = graph.update(k * STEP, [table, other, person(min(-1 + 0.15 * k, 0.3), 0.0)], None)
    (act,) = now.acts
    assert act.goal == goal
