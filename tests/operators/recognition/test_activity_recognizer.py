"""Activities of made agents by the shipped network, its state, what it cannot know, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dataflow.firing.failure import OperatorFailure
from dataflow.messages import Activity, Boxes3D, Pose, SceneGraph
from dataflow.messages.geometry import quaternion_from_yaw
from dataflow.testing import play
from operators.recognition import ActivityRecognizer
from operators.weights import shipped

CLASSES = ("person", "chair", "table", "mug", "robot", "ball")
RATE = 4.0
Box = tuple[int, str, tuple[float, float, float], tuple[float, float, float]]
"""Id, class, middle on the ground and bottom (x, y, bottom), full size."""


def nodes(time: float, boxes: list[Box], seen: dict[int, float] | None = None) -> SceneGraph:
    stamp = round(time * 1e9)
    return SceneGraph(
        stamp=stamp,
        frame="map",
        class_names=CLASSES,
        ids=[b[0] for b in boxes],
        class_ids=[CLASSES.index(b[1]) for b in boxes],
        positions=np.array([(b[2][0], b[2][1], b[2][2] + b[3][2] / 2) for b in boxes]).reshape(-1, 3),
        sizes=np.array([b[3] for b in boxes], np.float64).reshape(-1, 3),
        orientations=quaternion_from_yaw(np.zeros(len(boxes))).reshape(-1, 4),
        last_seen=[round((seen or {}).get(b[0], time) * 1e9) for b in boxes],
        subjects=np.zeros(0, np.int32),
        objects=np.zeros(0, np.int32),
    )


def course(seconds: float, at: Callable[[float], list[Box]]) -> list[SceneGraph]:
    return [nodes(k / RATE, at(k / RATE)) for k in range(round(seconds * RATE))]


def person(x: float, y: float, height: float = 1.7, length: float = 0.4) -> Box:
    return 1, "person", (x, y, 0.0), (length, 0.55, height)


def said(message: Activity, agent: int = 1) -> str:
    k = message.subjects.tolist().index(agent)
    return message.class_names[message.class_ids[k]]


def answers(graphs: list[SceneGraph], agent: int = 1) -> list[str]:
    return [said(m, agent) for m in play(ActivityRecognizer(), {"nodes": graphs})["activities"]]


def test_who_walks_and_then_stands_is_said_to() -> None:
    graphs = course(8, lambda t: [person(0.65 * min(t, 4.0), 0.0, length=0.8 if t < 4 else 0.35)])
    found = answers(graphs)
    assert set(found[4:15]) == {"walking"}
    assert set(found[24:]) == {"standing"}


def test_who_lowers_onto_a_chair_sits_down_and_then_sits_on_it() -> None:
    chair: Box = 5, "chair", (0.0, 0.45, 0.0), (0.5, 0.5, 0.9)

    def at(t: float) -> list[Box]:
        share = float(np.clip((t - 3) / 1.7, 0, 1))
        return [person(0.0, 0.2 * share, 1.7 - 0.4 * share, 0.4 + 0.4 * share), chair]

    messages = play(ActivityRecognizer(), {"nodes": course(8, at)})["activities"]
    found = [said(m) for m in messages]
    assert found[9] == "standing"
    assert "sitting_down" in found[13:19]
    assert set(found[24:]) == {"sitting"}
    assert messages[-1].objects is not None
    assert messages[-1].objects.tolist() == [5]
    assert messages[-1].since is not None
    assert 3.0 <= messages[-1].since[0] * 1e-9 <= 6.0


@pytest.mark.parametrize(("away", "allowed"), [(0.3, True), (3.0, False)])
def test_nobody_sits_down_or_stands_up_without_a_seat_in_reach(away: float, allowed: bool) -> None:
    chair: Box = 5, "chair", (away, 0.0, 0.0), (0.5, 0.5, 0.9)

    def at(t: float) -> list[Box]:
        share = float(np.clip((t - 3) / 1.7, 0, 1)) - float(np.clip((t - 7) / 1.7, 0, 1))
        return [person(0.2 * share, 0.0, 1.7 - 0.4 * share, 0.4 + 0.4 * share), chair]

    messages = play(ActivityRecognizer(), {"nodes": course(11, at)})["activities"]
    found = {said(m) for m in messages}
    assert ("sitting_down" in found) == ("standing_up" in found) == allowed
    for message in messages:
        assert message.probabilities is not None
        assert message.probabilities.sum() == pytest.approx(1, abs=1e-4)


def test_balls_roll_and_rest_robots_drive_and_rest() -> None:
    def at(t: float) -> list[Box]:
        return [
            (2, "ball", (0.5 * min(t, 3.0), 2.0, 0.0), (0.2, 0.2, 0.2)),
            (3, "robot", (0.3 * min(t, 3.0), 4.0, 0.0), (0.4, 0.4, 0.4)),
        ]

    graphs = course(7, at)
    assert answers(graphs, 2)[8] == "rolling"
    assert answers(graphs, 3)[8] == "driving"
    assert answers(graphs, 2)[-1] == answers(graphs, 3)[-1] == "resting"


@pytest.mark.parametrize(("later", "expected"), [(0.0, "driving"), (0.25, "resting")])
def test_a_robot_that_drives_into_view_drives_at_once_by_boxes_of_the_same_time(later: float, expected: str) -> None:
    (graph,) = course(0.25, lambda _: [(3, "robot", (0.0, 4.0, 0.0), (0.4, 0.4, 0.4))])
    boxes = Boxes3D(
        stamp=graph.stamp + round(later * 1e9),
        frame=graph.frame,
        class_names=CLASSES,
        centers=graph.positions,
        sizes=graph.sizes,
        orientations=graph.orientations,
        scores=[0.9],
        class_ids=graph.class_ids,
        ids=graph.ids,
        velocities=[(0.25, 0.0, 0.0)],
    )
    recognizer = ActivityRecognizer()
    recognizer.setup()
    assert said(recognizer.process(graph, objects=boxes), 3) == expected


def test_who_is_out_of_sight_for_long_does_something_unknown() -> None:
    graphs = course(3, lambda t: [person(0.0, 0.0)])
    graphs += [nodes(t, [person(0.0, 0.0)], {1: 2.75}) for t in (3.5, 4.5, 5.5)]
    found = answers(graphs)
    assert found[-4] == "standing"
    assert found[-1] == "unknown"


def test_graphs_that_come_more_often_take_no_more_steps_of_the_network() -> None:
    recognizer = ActivityRecognizer()
    recognizer.setup()

    def state() -> bytes:
        ((_, _, network, *_),) = recognizer.snapshot()["agents"]
        return np.asarray(network).tobytes()

    states = []
    for k in range(9):
        recognizer.process(nodes(k / 10, [person(0.06 * k, 0.0)]))
        states.append(state())
    assert states[1::2] == states[0:-1:2]
    assert len(set(states)) == 5


def test_the_state_goes_on_after_a_snapshot_as_if_nothing_had_been() -> None:
    graphs = course(6, lambda t: [person(0.6 * t, 0.0), (4, "mug", (1.0, 0.5, 0.8), (0.1, 0.1, 0.1))])
    whole, first, second = ActivityRecognizer(), ActivityRecognizer(), ActivityRecognizer()
    for each in (whole, first, second):
        each.setup()
    expected = [whole.process(g).digest() for g in graphs]
    found = [first.process(g).digest() for g in graphs[:11]]
    second.restore(first.snapshot())
    found += [second.process(g).digest() for g in graphs[11:]]
    assert found == expected


def test_equal_graphs_give_equal_answers() -> None:
    graphs = course(5, lambda t: [person(0.6 * t, 0.0)])
    runs = [play(ActivityRecognizer(), {"nodes": graphs}).digests() for _ in range(2)]
    assert runs[0] == runs[1]


def test_an_agent_that_was_lost_begins_anew_and_nobody_is_no_error() -> None:
    graphs = [nodes(0.0, [person(0, 0)]), nodes(0.25, []), nodes(0.5, [person(5, 5)])]
    messages = play(ActivityRecognizer(), {"nodes": graphs})["activities"]
    assert [m.count for m in messages] == [1, 0, 1]
    assert messages[2].since is not None
    assert messages[2].since.tolist() == [500_000_000]


def test_nodes_that_are_not_finite_are_left_out_and_counted() -> None:
    broken: Box = 1, "person", (float("nan"), 0.0, 0.0), (0.4, 0.5, 1.7)
    operator = ActivityRecognizer()
    (message,) = play(operator, {"nodes": [nodes(0.0, [broken, (2, "ball", (0, 0, 0), (0.2, 0.2, 0.2))])]})[
        "activities"
    ]
    assert message.subjects.tolist() == [2]
    assert operator.summary()["unusable nodes"] == 1


def test_other_networks_and_other_frames_are_refused(tmp_path: Path) -> None:
    graphs = course(1, lambda t: [person(0, 0)])
    with pytest.raises(OperatorFailure, match="is a detector; an activity network is needed"):
        play(ActivityRecognizer(weights=str(shipped("detector.onnx"))), {"nodes": graphs})
    elsewhere = Pose.from_matrix(np.eye(4), stamp=0, frame="odom", child_frame="base")
    with pytest.raises(OperatorFailure, match="the robot is in 'odom', the nodes in 'map'"):
        play(ActivityRecognizer(), {"nodes": graphs, "robot": [elsewhere]})
