"""Activities of made agents by the shipped network, its state, what it cannot know, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from made_graphs import scene_graph
from repeated import assert_repeats

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Activity, Boxes3D, Classification, Pose, SceneGraph
from dataflow.testing import play
from operators.recognition import ActivityRecognizer
from operators.weights import shipped

Recognizer = partial(ActivityRecognizer, labels="simulator")
RATE = 4.0
Box = tuple[int, str, tuple[float, float, float], tuple[float, float, float]]
"""Id, class, middle on the ground and bottom (x, y, bottom), full size."""


def nodes(time: float, boxes: list[Box], seen: dict[int, float] | None = None) -> SceneGraph:
    things = [(id, name, (x, y, bottom + size[2] / 2), size) for id, name, (x, y, bottom), size in boxes]
    last_seen = [round((seen or {}).get(b[0], time) * 1e9) for b in boxes]
    turns = np.tile([0, 0, 0, 1.0], (len(boxes), 1))
    return scene_graph(things, stamp=round(time * 1e9), frame="map", last_seen=last_seen, orientations=turns)


def course(seconds: float, at: Callable[[float], list[Box]]) -> list[SceneGraph]:
    return [nodes(k / RATE, at(k / RATE)) for k in range(round(seconds * RATE))]


def person(x: float, y: float, height: float = 1.7, length: float = 0.4) -> Box:
    return 1, "person", (x, y, 0.0), (length, 0.55, height)


def said(message: Activity, agent: int = 1) -> str:
    k = message.subjects.tolist().index(agent)
    return message.class_names[message.class_ids[k]]


def answers(graphs: list[SceneGraph], agent: int = 1) -> list[str]:
    return [said(m, agent) for m in play(Recognizer(), {"nodes": graphs})["activities"]]


def test_a_person_walks_and_then_stands() -> None:
    graphs = course(8, lambda t: [person(0.65 * min(t, 4.0), 0.0, length=0.8 if t < 4 else 0.35)])
    found = answers(graphs)
    assert set(found[4:15]) == {"walking"}
    assert set(found[24:]) == {"standing"}


def test_a_person_who_lowers_onto_a_chair_sits_down_and_then_sits_on_it() -> None:
    chair: Box = 5, "chair", (0.0, 0.45, 0.0), (0.5, 0.5, 0.9)

    def at(t: float) -> list[Box]:
        share = float(np.clip((t - 3) / 1.7, 0, 1))
        return [person(0.0, 0.2 * share, 1.7 - 0.4 * share, 0.4 + 0.4 * share), chair]

    messages = play(Recognizer(), {"nodes": course(8, at)})["activities"]
    found = [said(m) for m in messages]
    assert found[9] == "standing"
    assert "sitting_down" in found[13:19]
    assert set(found[24:]) == {"sitting"}
    assert messages[-1].objects.tolist() == [5]
    assert 3.0 <= messages[-1].since[0] * 1e-9 <= 6.0


def test_the_probabilities_of_each_agent_sum_to_one() -> None:
    for message in play(Recognizer(), {"nodes": course(2, lambda t: [person(0.2 * t, 0.0)])})["activities"]:
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
        stamp=graph.stamp + round(later * 1e9), frame=graph.frame, class_names=graph.class_names,
        centers=graph.positions, sizes=graph.sizes, orientations=graph.orientations, scores=[0.9],
        class_ids=graph.class_ids, ids=graph.ids, velocities=[(0.25, 0.0, 0.0)],
    )  # fmt: skip
    recognizer = Recognizer()
    recognizer.setup()
    assert said(recognizer.process(graph, objects=boxes), 3) == expected


def test_activity_of_an_agent_out_of_sight_becomes_unknown() -> None:
    graphs = course(3, lambda t: [person(0.0, 0.0)])
    graphs += [nodes(t, [person(0.0, 0.0)], {1: 2.75}) for t in (3.5, 4.5, 5.5)]
    found = answers(graphs)
    assert found[-4] == "standing"
    assert found[-1] == "unknown"


POSTURES = ("standing", "walking", "sitting", "reaching", "drinking")


def looks(graphs: list[SceneGraph], *likely: str) -> list[Classification]:
    """What the posture of person 1 looks like in each graph: 0.8 for one thing, 0.05 for the others."""
    rows = [np.array([[0.8 if name == p else 0.05 for p in POSTURES]], np.float32) for name in likely]
    return [
        Classification(
            stamp=graph.stamp, class_names=POSTURES, class_ids=row.argmax(axis=1).astype(np.int32),
            scores=row.max(axis=1), probabilities=row, ids=[1],
        )
        for graph, row in zip(graphs, rows, strict=True)
    ]  # fmt: skip


def test_posture_counts_beside_motion_unless_switched_off() -> None:
    mug: Box = 4, "mug", (0.45, 0.2, 0.75), (0.09, 0.09, 0.1)
    table: Box = 6, "table", (0.7, 0.0, 0.0), (0.6, 1.2, 0.75)
    graphs = course(4, lambda t: [person(0.0, 0.0), mug, table])
    given = {"nodes": graphs, "postures": looks(graphs, *["drinking"] * len(graphs))}
    alone, off, on, strong = (
        play(Recognizer(posture=weight), streams)["activities"][-1]
        for weight, streams in ((1.0, {"nodes": graphs}), (0.0, given), (1.0, given), (3.0, given))
    )
    assert off.digest() == alone.digest()
    column = alone.class_names.index("drinking")
    assert on.probabilities[0, column] > 5 * alone.probabilities[0, column]
    assert [said(each) for each in (alone, strong)] == ["standing", "drinking"]


def test_looks_of_another_time_change_nothing() -> None:
    graphs = course(3, lambda t: [person(0.0, 0.0)])
    late = [nodes(k / RATE + 0.1, []) for k in range(len(graphs))]
    given = {"nodes": graphs, "postures": looks(late, *["drinking"] * len(graphs))}
    assert play(Recognizer(), given).digests() == play(Recognizer(), {"nodes": graphs}).digests()


def test_contradicting_posture_does_not_outweigh_motion_at_once() -> None:
    graphs = course(6, lambda t: [person(0.65 * t, 0.0, length=0.8)])
    names = ["walking"] * (len(graphs) - 1) + ["standing"]
    found = play(Recognizer(), {"nodes": graphs, "postures": looks(graphs, *names)})["activities"]
    assert said(found[-1]) == "walking"


def test_graphs_that_come_more_often_take_no_more_steps_of_the_network() -> None:
    recognizer = Recognizer()
    recognizer.setup()

    def state() -> bytes:
        (agent,) = recognizer.state.agents.values()
        return agent.state.tobytes()

    states = []
    for k in range(9):
        recognizer.process(nodes(k / 10, [person(0.06 * k, 0.0)]))
        states.append(state())
    assert states[1::2] == states[0:-1:2]
    assert len(set(states)) == 5


def test_activities_repeat_and_a_restored_recogniser_goes_on() -> None:
    graphs = course(6, lambda t: [person(0.6 * t, 0.0), (4, "mug", (1.0, 0.5, 0.8), (0.1, 0.1, 0.1))])
    seen = looks(graphs, *(["walking", "standing"] * len(graphs))[: len(graphs)])
    assert_repeats(Recognizer, [{"nodes": g, "postures": p} for g, p in zip(graphs, seen, strict=True)], 11)


def test_lost_agent_restarts_its_activity_and_an_empty_graph_is_valid() -> None:
    graphs = [nodes(0.0, [person(0, 0)]), nodes(0.25, []), nodes(0.5, [person(5, 5)])]
    messages = play(Recognizer(), {"nodes": graphs})["activities"]
    assert [m.count for m in messages] == [1, 0, 1]
    assert messages[2].since.tolist() == [500_000_000]


def test_nodes_that_are_not_finite_are_left_out_and_counted() -> None:
    broken: Box = 1, "person", (float("nan"), 0.0, 0.0), (0.4, 0.5, 1.7)
    operator = Recognizer()
    (message,) = play(operator, {"nodes": [nodes(0.0, [broken, (2, "ball", (0, 0, 0), (0.2, 0.2, 0.2))])]})[
        "activities"
    ]
    assert message.subjects.tolist() == [2]
    assert operator.summary()["unusable nodes"] == 1


def test_other_networks_and_other_frames_are_refused(tmp_path: Path) -> None:
    graphs = course(1, lambda t: [person(0, 0)])
    with pytest.raises(OperatorFailure, match="is a detector; an activity network is needed"):
        play(Recognizer(weights=str(shipped("detector.onnx"))), {"nodes": graphs})
    elsewhere = Pose.from_matrix(np.eye(4), stamp=0, frame="odom", child_frame="base")
    with pytest.raises(OperatorFailure, match="the robot is in 'odom', the nodes in 'map'"):
        play(Recognizer(), {"nodes": graphs, "robot": [elsewhere]})
