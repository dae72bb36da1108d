"""Rooms as a layer of the scene graph: which room things are in, which rooms are connected, and how they are told."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest
from made_graphs import Thing, scene_graph

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Pose, Rooms, SceneGraph
from dataflow.messages.scene_summary import ROOMS, carriers_in_words, rooms_in_words, summarize
from dataflow.testing import Played, play
from operators.scene import SceneGraphBuilder
from operators.scene.graph.query import as_json, ask
from operators.scene.graph.spark import as_spark_dsg

Builder = partial(SceneGraphBuilder, labels="simulator")
STEP = 200_000_000  # ns
TABLE: Thing = (1, "table", (2.0, 2.0, 0.375), (1.5, 0.8, 0.75))
MUG: Thing = (2, "mug", (2.0, 2.2, 0.8), (0.1, 0.08, 0.1))
CHAIR: Thing = (3, "chair", (6.0, 1.0, 0.5), (0.5, 0.5, 1.0))
SHELF: Thing = (4, "shelf", (3.85, 3.0, 0.9), (0.3, 1.0, 1.8))
"""Its back is at the wall between the two rooms, and its place was never seen free."""
LEFT, RIGHT = ROOMS - 1, ROOMS - 4


def two_rooms(frame: str = "world", stamp: int = 1) -> Rooms:
    """Rooms 1 and 4 side by side: x from 0 to 4 m and from 4.1 to 8, y from 0 to 4, a door at (4.05, 1.5)."""
    cells = np.full((40, 81), -1, np.int32)
    cells[:, :40], cells[:, 41:] = 0, 1
    cells[25:35, 37:40] = -1  # the shelf
    return Rooms(
        stamp=stamp, frame=frame, resolution=0.1, cells=cells, position=[0, 0, 0], ids=[1, 4], areas=[15.7, 16.0],
        centers=[[2, 2, 0], [6, 2, 0]], doors=[[0, 1]], door_positions=[[4.05, 1.5, 0]], door_widths=[0.9],
    )  # fmt: skip


def built(scenes: Sequence[Sequence[Thing]], rooms: Rooms | None = None, at: Sequence[float] = (5, 2, 0)) -> Played:
    stamps = range(len(scenes))
    robot = [
        Pose(stamp=(k + 1) * STEP, frame="world", child_frame="base", position=at, orientation=[0, 0, 0, 1])
        for k in stamps
    ]
    given: dict[str, Any] = {
        "nodes": [scene_graph(things, stamp=(k + 1) * STEP) for k, things in enumerate(scenes)],
        "robot": robot,
    }
    return play(Builder(), given | {"rooms": [two_rooms() if rooms is None else rooms]})


def last(played: Played) -> SceneGraph:
    return played["graph"][-1]


def room_of(graph: SceneGraph, id: int) -> list[str]:
    ids, names = graph.ids.tolist(), graph.names()
    return [names[o] for s, p, o in graph.relations() if p == "in" and ids[s] == id and ids[o] < ROOMS]


def test_things_and_the_robot_are_in_the_room_where_they_stand() -> None:
    graph = last(built([[TABLE, MUG, CHAIR, SHELF]]))
    assert [room_of(graph, i) for i in (1, 2, 3, 4, -1)] == [["room 1"], ["room 1"], ["room 4"], ["room 1"], ["room 4"]]


def test_rooms_are_nodes_with_area_and_box_joined_by_doors_within_a_building() -> None:
    graph = last(built([[TABLE, CHAIR]]))
    ids, names = graph.ids.tolist(), graph.names()
    triples = {(names[s], p, names[o]) for s, p, o in graph.relations()}
    assert triples >= {
        ("room 1", "connected_to", "room 4"), ("room 1", "part_of", "building"), ("room 4", "part_of", "building"),
    }  # fmt: skip
    assert graph.areas[ids.index(LEFT)] == pytest.approx(15.7)
    assert np.isnan(graph.areas[ids.index(1)])
    np.testing.assert_allclose(graph.positions[ids.index(RIGHT)][:2], [6.1, 2.0])
    np.testing.assert_allclose(graph.sizes[ids.index(RIGHT)][:2], [4.0, 4.0])


def test_object_far_from_all_rooms_is_in_none() -> None:
    graph = last(built([[TABLE, (5, "chair", (2.0, 6.0, 0.5), (0.5, 0.5, 1.0))]]))
    assert room_of(graph, 5) == []
    assert room_of(graph, 1) == ["room 1"]


def test_a_person_who_walks_through_the_door_leaves_one_room_for_the_other() -> None:
    walk = [[TABLE, (9, "person", (3.0 + 0.1 * k, 1.5, 0.85), (0.5, 0.5, 1.7))] for k in range(30)]
    graphs = [m for m in built(walk)["graph"] if isinstance(m, SceneGraph)]
    rooms = [room_of(graph, 9) for graph in graphs]
    assert (rooms[2], rooms[-1]) == (["room 1"], ["room 4"])
    changed = next(k for k, now in enumerate(rooms) if now == ["room 4"])
    assert 9 <= changed <= 16  # the middle of the door is at 10, and relations are means over 0.4 s


def test_questions_reports_and_exports_know_the_rooms() -> None:
    graph = last(built([[TABLE, MUG, CHAIR, SHELF]]))
    ids = graph.ids.tolist()
    assert [ids[m.node] for m in ask(graph, "anything in room 4")] == [3]
    assert [ids[m.node] for m in ask(graph, "mug on table in room 1")] == [2]
    assert [ids[m.node] for m in ask(graph, "room connected to room 1")] == [RIGHT]
    told = summarize(graph)
    assert [(row.name, row.text) for row in rooms_in_words(graph, told)] == [
        ("room 1", "15.7 m²; connected to room 4; in it table 1, mug 2, shelf 4"),
        ("room 4", "16.0 m²; connected to room 1; in it self, chair 3"),
    ]
    assert ("table 1", "on it mug 2") in [(row.name, row.text) for row in carriers_in_words(graph, told)]
    shown = {node["name"]: node for node in as_json(graph)["nodes"]}
    assert {shown[name]["layer"] for name in ("room 1", "room 4")} == {"room"}
    assert (shown["building"]["layer"], shown["room 4"]["area"]) == ("building", 16.0)
    layers = {node["attributes"]["name"]: node["layer"] for node in as_spark_dsg(graph)["nodes"]}
    assert (layers["building"], layers["room 1"], layers["table 1"]) == (5, 4, 2)


def test_graph_without_rooms_is_unchanged() -> None:
    graph = last(play(Builder(), {"nodes": [scene_graph([TABLE, CHAIR], stamp=STEP)]}))
    assert graph.areas is None
    assert {"room", "floor"} <= set(graph.names())
    assert "building" not in graph.class_names


def test_rooms_of_another_frame_are_refused() -> None:
    with pytest.raises(OperatorFailure, match="the rooms are in 'odom', the map in 'world'"):
        built([[TABLE]], two_rooms(frame="odom"))
