"""SceneGraphBuilder on rooms whose relations are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_graphs import Thing, scene_graph
from repeated import assert_repeats

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Activity, Classification, Diagnostics, Pose, SceneGraph
from dataflow.messages.geometry import quaternion_from_yaw
from dataflow.testing import Played, play
from operators.scene import SceneGraphBuilder
from operators.scene.bodies import Body, footprint_share, gap
from operators.scene.graph.layers import GraphSettings, LayeredGraph
from operators.scene.relations import Hysteresis

Builder = partial(SceneGraphBuilder, labels="simulator")
STEP = 200_000_000  # ns
TABLE: Thing = (1, "table", (2, 0, 0.375), (1.5, 0.8, 0.75))
MUG: Thing = (2, "mug", (2, 0.2, 0.8), (0.1, 0.08, 0.1))
CHAIR: Thing = (3, "chair", (2, -0.9, 0.5), (0.5, 0.5, 1.0))
SHELF: Thing = (4, "shelf", (4, 2, 0.9), (0.3, 1.0, 1.8))
BOOK: Thing = (5, "book", (4, 2.1, 0.9), (0.2, 0.05, 0.25))
CRATE: Thing = (6, "box", (2.2, 0.1, 0.15), (0.3, 0.3, 0.3))
LAMP: Thing = (7, "lamp", (2, 0, 1.5), (0.3, 0.3, 0.3))


def person(x: float, y: float, height: float = 1.7, id: int = 9) -> Thing:
    return (id, "person", (x, y, height / 2), (0.5, 0.5, height))


def room(k: int, things: Sequence[Thing]) -> SceneGraph:
    return scene_graph(things, stamp=(k + 1) * STEP)


def robot(k: int, frame: str = "world") -> Pose:
    return Pose(stamp=(k + 1) * STEP, frame=frame, child_frame="base", position=[0, 0, 0], orientation=[0, 0, 0, 1])


def built(rooms: Sequence[Sequence[Thing]], **params: Any) -> Played:
    nodes = [room(k, things) for k, things in enumerate(rooms)]
    return play(Builder(**params), {"nodes": nodes, "robot": [robot(k) for k in range(len(rooms))]})


def first(*things: Thing) -> Mapping[tuple[int, str, int], float]:
    """The relations of the first graph of a room."""
    return relations(built([things])["graph"][0])


def doing(message: Activity) -> str:
    """What the only agent does."""
    return message.class_names[message.class_ids[0]]


def relations(message: Any) -> Mapping[tuple[int, str, int], float]:
    ids = message.ids.tolist()
    triples = [(ids[s], p, ids[o]) for s, p, o in message.relations()]
    return dict(zip(triples, message.relation_scores.tolist(), strict=True))


def test_a_room_has_the_relations_that_a_person_would_name() -> None:
    found = first(TABLE, MUG, CHAIR, SHELF, BOOK, CRATE, LAMP)
    expected = [(2, "on", 1), (1, "on", 0), (3, "on", 0), (4, "on", 0), (5, "in", 4), (6, "on", 0), (6, "under", 1)]
    for relation in [*expected, (7, "above", 1), (0, "part_of", -2), (1, "near", 3)]:
        assert found[relation] > 0.6, relation
    assert sum(p in ("on", "in") for s, p, _ in found if s == 2) == 1
    assert not any(s in (1, 2, 3) and o in (4, 5) for s, _, o in found)
    assert (1, "left_of", 3) in found


TOP: Thing = (-11, "tabletop", (2, 0, 0.74), (1.4, 0.7, 0.02))
WALL: Thing = (-12, "wall", (2, 3, 1.2), (4, 0.02, 2.4))
GROUND: Thing = (0, "floor", (2, 0, -0.31), (6, 6, 0.02))


def test_things_stand_on_surfaces_by_their_height_and_extent() -> None:
    beside: Thing = (8, "mug", (2, 1.2, 0.8), (0.1, 0.08, 0.1))
    above: Thing = (9, "mug", (2.1, 0, 1.1), (0.1, 0.08, 0.1))
    found = first(TABLE, MUG, TOP, WALL, beside, above)
    assert found[2, "on", -11] > 0.6
    assert found[2, "on", 1] > 0.6
    assert found[-11, "part_of", 1] > 0.6
    assert found[-12, "part_of", -2] == 1
    assert not any({s, o} & {-11, -12} for s, p, o in found if p not in ("on", "part_of"))
    assert [s for s, p, o in found if p == "on" and o == -11] == [2]


@pytest.mark.parametrize(("below", "lies"), [(0.02, True), (0.05, False)])
def test_flat_object_lies_on_a_slightly_offset_plane(below: float, lies: bool) -> None:
    top = 0.75
    magazine: Thing = (8, "book", (2, 0.1, top - below), (0.2, 0.3, 0.01))
    found = first(TABLE, TOP, magazine)
    assert {o for s, p, o in found if s == 8 and p == "on"} == ({1, -11} if lies else set())


def test_tabletop_without_a_table_carries_its_objects() -> None:
    found = first(MUG, TOP)
    assert found[2, "on", -11] > 0.6
    assert not any(s == -11 for s, _, _ in found)


def test_height_is_over_the_floor_of_the_map() -> None:
    low: Thing = (6, "box", (2.2, 0.1, -0.15), (0.3, 0.3, 0.3))
    message = built([[GROUND, low, SHELF, TOP, WALL]])["graph"][0]
    found = relations(message)
    assert found[6, "on", 0] > 0.9
    assert (4, "on", 0) not in found or found[4, "on", 0] < 0.6
    assert message.sizes[message.ids.tolist().index(0)].tolist() == [6, 6, 0.02]
    assert {"floor", "tabletop 1", "wall 2", "shelf 4"} <= set(message.names())


def test_one_box_that_reaches_through_the_floor_does_not_take_it_from_the_others() -> None:
    plant: Thing = (8, "plant", (3, -2, 0.1), (0.6, 0.5, 1.2))  # to half a metre below the floor
    found = first(TABLE, CHAIR, SHELF, CRATE, plant)
    assert {s for s, p, o in found if (p, o) == ("on", 0)} == {1, 3, 4, 6, 8}


def test_left_and_front_are_those_of_the_robots_view() -> None:
    """The robot looks along x from the origin; y is to its left."""
    nearer: Thing = (1, "box", (2.0, 0, 0.1), (0.2, 0.2, 0.2))
    farther: Thing = (2, "box", (2.5, 0.05, 0.1), (0.2, 0.2, 0.2))
    left: Thing = (3, "box", (2.05, 0.5, 0.1), (0.2, 0.2, 0.2))
    found = first(nearer, farther, left)
    assert (1, "in_front_of", 2) in found
    assert (3, "left_of", 1) in found
    assert (2, "in_front_of", 1) not in found


@pytest.mark.parametrize(
    ("degrees", "left"),
    [([0.0, 90.0, 45.3, 44.0], [1, 0, 0, 1]), ([30.0, 44.9, 45.1, 44.9, 45.1, 60.0], [1, 1, 1, 1, 1, 0])],
    ids=["quarter turn", "on the bisector"],
)
def test_left_and_front_are_those_of_the_view_with_hysteresis_on_the_bisector(
    degrees: list[float], left: list[int]
) -> None:
    ahead: Thing = (1, "box", (2.0, 0, 0.1), (0.2, 0.2, 0.2))
    beside: Thing = (2, "box", (2.0, 0.4, 0.1), (0.2, 0.2, 0.2))
    nodes = [room(k, [ahead, beside]) for k in range(len(degrees))]
    turns = quaternion_from_yaw(np.radians(degrees))
    poses = [robot(k).replace(orientation=turns[k]) for k in range(len(degrees))]
    found = [relations(m) for m in play(Builder(), {"nodes": nodes, "robot": poses})["graph"]]
    assert [(2, "left_of", 1) in each for each in found] == [bool(each) for each in left]
    assert [(1, "in_front_of", 2) in each for each in found][-1] is not bool(left[-1])
    assert all(each[1, "near", 2] > 0.5 for each in found)


def test_relations_begin_and_end_with_hysteresis() -> None:
    """A mug that flickers between table and air keeps its relation; one that is gone for good loses it."""
    lifted: Thing = (2, "mug", (2, 0.2, 1.3), (0.1, 0.08, 0.1))
    flicker = [[TABLE, lifted if k % 4 == 3 else MUG] for k in range(16)]
    played = built(flicker)
    assert all((2, "on", 1) in relations(m) for m in played["graph"])
    gone = built([*flicker, *([[TABLE, lifted]] * 10)])
    assert (2, "on", 1) not in relations(gone["graph"][-1])
    last = [m for m in gone["changes"] if isinstance(m, Diagnostics) and "on table 1 ends" in m.messages]
    assert len(last) == 1


def test_a_person_walks_to_a_chair_and_sits_down() -> None:
    """From 3 m away along a straight line past the table; the chair is the goal long before the arrival."""
    walk = [[TABLE, MUG, CHAIR, SHELF, person(2 + 3 - 0.16 * k, -0.9 - 0.02 * k)] for k in range(18)]
    sit = [[TABLE, MUG, CHAIR, SHELF, person(2.05, -0.95, max(1.3, 1.7 - 0.08 * k))] for k in range(16)]
    played = built(walk + sit)
    acts = [doing(message) for message in played["activities"]]
    assert acts[10] == "walking"
    assert "sitting_down" in acts[18:26]
    assert acts[-1] == "sitting"
    goal = played["activities"][12]
    assert goal.goals[0].startswith("chair 3")
    found = relations(played["graph"][12])
    assert found[9, "heads_for", 3] > 0.4
    assert (9, "facing", 3) in found
    assert (9, "sitting_on", 3) in relations(played["graph"][-1])


def test_object_in_a_hand_is_held() -> None:
    cup: Thing = (2, "mug", (1.65, -2, 1.2), (0.1, 0.08, 0.1))
    found = relations(built([[TABLE, cup, person(1.4, -2)]] * 6)["graph"][-1])
    assert (9, "holding", 2) in found
    assert not any(s == 2 and p == "on" for s, p, _ in found)


def recognised(stamp: int, name: str) -> Activity:
    """What a recogniser says of the person with id 9."""
    return Activity(
        stamp=stamp, class_names=(name,), subjects=np.array([9]), class_ids=np.array([0], np.int32),
        scores=np.array([0.7], np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("said", ["drinking", "unknown"])
def test_a_recognised_activity_counts_while_it_is_fresh(said: str) -> None:
    nodes = [room(k, [TABLE, person(0, 3)]) for k in range(8)]
    told = recognised(3 * STEP, said)
    played = play(Builder(), {"nodes": nodes, "recognized": [told]})
    names = [doing(m) for m in played["activities"]]
    assert names[2:4] == [said, said]
    assert names[-1] == "standing"


@pytest.mark.parametrize(("ago", "name"), [(1.0, "unknown"), (2.0, "standing")])
def test_out_of_sight_the_last_activity_counts_where_nothing_is_recognised(ago: float, name: str) -> None:
    operator = Builder()
    operator.setup()
    for k in range(8):
        operator.process(room(k, [TABLE, person(0, 3)]))
    nodes = room(8, [TABLE, person(0, 3)])
    told = recognised(nodes.stamp, "unknown")
    seen = np.array([nodes.stamp, nodes.stamp - round(ago * 1e9)])
    said = operator.process(nodes.replace(last_seen=seen), recognized=told)["activities"]
    assert doing(said) == name


def test_nodes_without_a_place_are_counted_and_other_frames_refused() -> None:
    nowhere: Thing = (2, "mug", (np.nan, 0, 0), (0.1, 0.1, 0.1))
    operator = Builder()
    operator.setup()
    graph = operator.process(room(0, [TABLE, nowhere]))["graph"]
    assert 2 not in graph.ids.tolist()
    assert operator.summary()["unusable nodes"] == 1
    with pytest.raises(OperatorFailure, match="the robot is in 'odom', the map in 'world'"):
        play(Builder(), {"nodes": [room(0, [TABLE])], "robot": [robot(0, "odom")]})
    assert built([[]])["graph"][0].stamp == STEP


def test_classes_without_an_entry_in_the_label_space_are_related_and_named_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    operator, things = SceneGraphBuilder(), [(1, "zorb", *TABLE[2:]), MUG, (4, "dax", *CHAIR[2:])]
    operator.setup()
    graphs = [operator.process(room(k, things))["graph"] for k in range(2)]
    assert (2, "on", 1) in relations(graphs[-1])
    assert operator.summary()["unknown classes"] == 2
    (record,) = caplog.records
    assert "the label space coco has no entry for 'zorb', 'dax'" in record.getMessage()


def test_coco_classes_support_in_refrigerator_and_sitting_on_couch() -> None:
    refrigerator: Thing = (1, "refrigerator", (0, 0, 0.9), (0.6, 0.6, 1.8))
    bottle: Thing = (2, "bottle", (0, 0, 1.0), (0.08, 0.08, 0.3))
    couch: Thing = (3, "couch", (3, 0.1, 0.4), (0.9, 1.8, 0.8))
    found = relations(built([[refrigerator, bottle, couch, person(3, 0.6, 1.25)]] * 5, labels="coco")["graph"][-1])
    assert (2, "in", 1) in found
    assert (9, "sitting_on", 3) in found
    assert (2, "under", 1) not in found


def test_nodes_keep_the_tracks_that_are_theirs() -> None:
    nodes = room(0, [MUG, LAMP, TABLE]).replace(tracks=np.array([5, 9, 4]), track_nodes=np.array([0, 0, 2], np.int32))
    graph = play(Builder(), {"nodes": [nodes]})["graph"][0]
    held = {name: graph.tracks_of(k) for k, name in enumerate(graph.names()) if graph.tracks_of(k)}
    assert held == {"mug 2": (5, 9), "table 1": (4,)}


def test_restored_builder_continues_identically() -> None:
    rooms = [[TABLE, MUG, CHAIR, person(5 - 0.15 * k, -0.9)] for k in range(20)]
    assert_repeats(Builder, [(room(k, things), robot(k)) for k, things in enumerate(rooms)], 10)


def body(x: float, y: float, size: float, yaw: float) -> Body:
    return Body(1, "box", np.array([x, y, 0.5]), np.array([size, 2 * size, 1.0]), yaw, np.zeros(3))


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 1), st.floats(-3, 3))
def test_gap_is_symmetric_and_no_share_exceeds_one(x: float, y: float, size: float, yaw: float) -> None:
    first, second = body(0, 0, 0.6, 0.3), body(x, y, size, yaw)
    assert gap(first, second) == pytest.approx(gap(second, first), abs=1e-5)
    assert 0 <= footprint_share(first, second) <= 1
    assert gap(first, second) == 0 or footprint_share(first, second) == 0


def test_hysteresis_forgets_removed_objects() -> None:
    held = Hysteresis(0.5, 0.25, 0.4)
    held.update(0, {(1, "on", 2): 1.0})
    held.forget({2})
    assert held.update(STEP, {}) == ({}, [], [])


def test_orientation_turns_a_footprint() -> None:
    nodes = room(0, [TABLE]).replace(orientations=quaternion_from_yaw(np.array([np.pi / 2])))
    graph = play(Builder(), {"nodes": [nodes]})["graph"][0]
    floor = graph.ids.tolist().index(0)
    np.testing.assert_allclose(graph.sizes[floor, :2], [0.8, 1.5], atol=1e-9)


@pytest.mark.parametrize(("moving", "said"), [(0.05, "resting"), (0.5, "unknown"), (0.95, "driving")])
def test_vehicle_known_to_stand_rests_though_its_box_moves(moving: float, said: str) -> None:
    seen = [room(k, [(2, "car", (8 + 0.3 * k, 3, 0.7), (4, 1.8, 1.5)), TABLE]) for k in range(8)]
    graph, act = driven(seen, moving)
    assert (doing(act), graph) == (said, np.float32(moving))


@pytest.mark.parametrize(("moving", "ago", "said"), [(0.98, 1, "driving"), (0.98, 2, "unknown"), (0.02, 2, "resting")])
def test_a_vehicle_out_of_sight_may_have_stopped(moving: float, ago: float, said: str) -> None:
    graph, act = driven(
        [room(k, [(2, "car", (8, 3, 0.7), (4, 1.8, 1.5)), TABLE]) for k in range(4)], moving, ago=round(ago * 1e9)
    )
    assert (doing(act), graph) == (said, np.float32(0.5 if said == "unknown" else moving))


def driven(seen: Sequence[SceneGraph], moving: float, ago: int = 0) -> tuple[np.float32, Activity]:
    """Whether car 2 moves at the end, and what it does; its node moves with `moving` and was seen `ago`."""
    nodes = [
        each.replace(moving=np.array([moving, np.nan], np.float32), last_seen=np.array([each.stamp - ago] * 2))
        for each in seen
    ]
    played = play(SceneGraphBuilder(), {"nodes": nodes})
    graph = played["graph"][-1]
    return graph.moving[graph.names().index("car 2")], played["activities"][-1]


@pytest.mark.parametrize(("moving", "speed"), [(0.05, 0.0), (0.5, 10.0), (np.nan, 10.0), (0.95, 10.0)])
def test_agent_has_the_velocity_of_its_centre_unless_at_standstill(moving: float, speed: float) -> None:
    graph = LayeredGraph(GraphSettings())
    for k in range(8):
        center, size = np.array([40 + 2.0 * k, 3, 0.7]), np.array([4, 1.8, 1.5])
        car = Body(2, "car", center, size, 0.0, np.zeros(3), frozenset({"agent"}), moving)
        now = graph.update(k * STEP, [car], None)
    velocity = next(b.velocity for b in now.bodies if b.id == 2)
    np.testing.assert_allclose(velocity, [speed, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([(8, "sitting", 0.8), (9, "standing", 0.9)], [("sitting", 0.8), ("standing", 0.9)]),
        ([(9, "sitting", 0.7)], [("unknown", 0.3), ("sitting", 0.7)]),
        ([(None, "sitting", 0.9)], [("unknown", 0.3), ("unknown", 0.3)]),  # without ids they are of no node
    ],
)
def test_joints_decide_between_sitting_and_standing_and_without_them_it_is_unknown(
    rows: list[tuple[Any, str, float]], expected: list[tuple[str, float]]
) -> None:
    names, ids = ("standing", "sitting"), [id for id, _, _ in rows]
    joints = [
        Classification(
            stamp=(k + 1) * STEP, class_names=names, scores=np.array([score for _, _, score in rows], np.float32),
            class_ids=np.array([names.index(name) for _, name, _ in rows], np.int32), ids=None if None in ids else ids,
        )
        for k in range(5)
    ]  # fmt: skip
    nodes = [room(k, [person(4, 2, id=8), person(6, -2, id=9)]) for k in range(5)]
    act = play(Builder(), {"nodes": nodes, "postures": joints})["activities"][-1]
    assert [
        (act.class_names[c], round(float(s), 2)) for c, s in zip(act.class_ids, act.scores, strict=True)
    ] == expected
