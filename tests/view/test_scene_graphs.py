"""A scene graph is drawn so that people can read it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dataflow.messages import Activity, SceneGraph
from dataflow.messages.scene_summary import summarize

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    from rrd_rows import at, draw

    from dataflow.view.visualizers.scene_tree import arranged

CLASSES = ("room", "floor", "table", "mug", "chair", "person", "book")


def scene(stamp: int = 0, *, person_x: float = 3.0, mug: bool = True) -> SceneGraph:
    """A table with a mug, a chair that a person heads for, in a room."""
    classes = ["room", "floor", "table", "chair", "person", *(["mug"] if mug else [])]
    relations = [(2, "on", 1, 0.9), (3, "on", 1, 0.9), (4, "heads_for", 3, 0.7), (2, "near", 3, 1.0)]
    relations += [(5, "on", 2, 0.8)] if mug else []
    positions = [(0, 0, 1), (0, 0, 0), (1, 1, 0.4), (2, 0, 0.5), (person_x, 2, 0.9), (1, 1, 0.85)]
    sizes = [(8, 6, 2), (8, 6, 0), (1, 1, 0.8), (0.5, 0.5, 1), (0.5, 0.5, 1.8), (0.1, 0.1, 0.1)]
    return SceneGraph(
        stamp=stamp,
        frame="map",
        class_names=CLASSES,
        predicates=tuple(p for _, p, _, _ in relations),
        ids=np.array([-2, 0, 2, 3, 4, 5][: len(classes)]),
        class_ids=np.array([CLASSES.index(c) for c in classes], np.int32),
        positions=np.array(positions[: len(classes)], float),
        sizes=np.array(sizes[: len(classes)], float),
        subjects=np.array([s for s, _, _, _ in relations], np.int32),
        objects=np.array([o for _, _, o, _ in relations], np.int32),
        relation_scores=np.array([score for _, _, _, score in relations], np.float32),
    )


def walking(stamp: int = 0) -> Activity:
    return Activity(
        stamp=stamp, class_names=("walking",), subjects=np.array([4]), class_ids=np.array([0], np.int32),
        scores=np.array([0.9], np.float32),
    )  # fmt: skip


def test_rooms_and_floors_are_outlines_on_the_ground_and_hide_nothing(tmp_path: Path) -> None:
    found = draw(tmp_path, ("s/graph", scene()))
    (outlines,) = at(found, "/s/graph/space/places", "LineStrips3D:strips")
    assert len(outlines.values) == 2
    for strip in outlines.values:
        assert np.allclose(np.array(strip)[:, 2], 0.0)
        assert np.ptp(np.array(strip)[:, 0]) == 8.0
    (boxes,) = at(found, "/s/graph/space/things", "Boxes3D:half_sizes")
    assert np.allclose(np.array(boxes.values), [(0.5, 0.5, 0.4), (0.25, 0.25, 0.5)]), "table and chair alone"


def test_walls_are_upright_outlines(tmp_path: Path) -> None:
    made = scene().replace(class_names=("wall", *CLASSES[1:]))
    sizes, turned = made.sizes.copy(), np.tile([0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)], (made.count, 1))
    sizes[0] = (4, 0.02, 2)
    found = draw(tmp_path, ("s/graph", made.replace(sizes=sizes, orientations=turned)))
    (outlines,) = at(found, "/s/graph/space/places", "LineStrips3D:strips")
    assert np.allclose(np.ptp(np.array(outlines.values[0]), axis=0), [0, 4, 2], atol=1e-6)


def test_things_that_are_carried_are_drawn_without_labels(tmp_path: Path) -> None:
    found = draw(tmp_path, ("s/graph", scene()))
    (parts,) = at(found, "/s/graph/space/parts", "Boxes3D:show_labels")
    assert parts.values == [False]
    (things,) = at(found, "/s/graph/space/things", "Boxes3D:labels")
    assert things.values == ["table 2", "chair 3"]


def test_a_person_is_a_capsule_as_tall_as_it_is_with_what_it_does(tmp_path: Path) -> None:
    found = draw(tmp_path, ("s/activities", walking()), ("s/graph", scene()))
    (label,) = at(found, "/s/graph/space/agents", "Capsules3D:labels")
    assert label.values == ["person 4: walking"]
    (length,) = at(found, "/s/graph/space/agents", "Capsules3D:lengths")
    (radius,) = at(found, "/s/graph/space/agents", "Capsules3D:radii")
    (foot,) = at(found, "/s/graph/space/agents", "Capsules3D:translations")
    assert length.values[0] + 2 * radius.values[0] == np.float32(1.8)
    assert np.isclose(foot.values[0][2] - radius.values[0], 0.0)


def test_an_intention_is_an_arrow_with_its_probability(tmp_path: Path) -> None:
    found = draw(tmp_path, ("s/graph", scene()))
    (label,) = at(found, "/s/graph/space/intentions", "Arrows3D:labels")
    (vector,) = at(found, "/s/graph/space/intentions", "Arrows3D:vectors")
    assert label.values == ["70 %"]
    assert np.allclose(vector.values, [(-1, -2, -0.4)])


def test_unchanged_scene_entities_are_not_resent(tmp_path: Path) -> None:
    found = draw(tmp_path, *(("s/graph", scene(t, person_x=3.0 + 0.1 * t)) for t in range(5)))
    assert len(at(found, "/s/graph/space/agents", "Capsules3D:translations")) == 5
    for entity, component in (
        ("/s/graph/space/things", "Boxes3D:centers"),
        ("/s/graph/graph", "GraphNode:id"),
        ("/s/graph/text", "TextDocument:text"),
    ):
        assert len(at(found, entity, component)) <= 1, entity
    found = draw(tmp_path, ("s/graph", scene(0)), ("s/graph", scene(1, mug=False)))
    assert len(at(found, "/s/graph/text", "TextDocument:text")) == 2


def test_text_lists_activities_and_what_carries_what(tmp_path: Path) -> None:
    found = draw(tmp_path, ("s/activities", walking()), ("s/graph", scene()))
    (text,) = at(found, "/s/graph/text", "TextDocument:text")
    assert "| **person 4** | walking 90 %, heads for chair 3 (70 %) |" in text.values[0]
    assert "| **table 2** | on it mug 5 |" in text.values[0]
    assert "near" not in text.values[0]


def test_a_list_without_rows_has_no_heading(tmp_path: Path) -> None:
    empty = SceneGraph(
        stamp=0, frame="map", class_names=CLASSES, predicates=(), ids=np.zeros(0, np.int64),
        class_ids=np.zeros(0, np.int32), positions=np.zeros((0, 3)), sizes=np.zeros((0, 3)),
        subjects=np.zeros(0, np.int32), objects=np.zeros(0, np.int32),
    )  # fmt: skip
    (text,) = at(draw(tmp_path, ("s/graph", empty)), "/s/graph/text", "TextDocument:text")
    assert text.values == ["0 nodes, 0 relations"]


@given(st.integers(0, 12), st.integers(0, 40), st.integers(0, 15))
def test_every_node_of_the_tree_is_in_view_and_no_two_are_at_one_place(tables: int, mugs: int, people: int) -> None:
    classes = ["floor"] + ["table"] * tables + ["mug"] * mugs * bool(tables) + ["person"] * people
    n = len(classes)
    relations = [(i, "on", 0) for i in range(1, 1 + tables)]
    relations += [(1 + tables + k, "on", 1 + k % tables) for k in range(mugs if tables else 0)]
    relations += [(n - people + k, "facing", 1 + k % tables) for k in range(people if tables else 0)]
    message = SceneGraph(
        stamp=0, frame="map", class_names=CLASSES, predicates=tuple(p for _, p, _ in relations), ids=np.arange(n),
        class_ids=np.array([CLASSES.index(c) for c in classes], np.int32), positions=np.zeros((n, 3)),
        sizes=np.ones((n, 3)), subjects=np.array([s for s, _, _ in relations], np.int32),
        objects=np.array([o for _, _, o in relations], np.int32),
    )  # fmt: skip
    nodes, edges = arranged(message, summarize(message), None)
    assert all(0 <= node.x <= 1 and 0 <= node.y <= 1 for node in nodes)
    places = {(round(node.x, 6), round(node.y, 6)) for node in nodes}
    assert len(places) == len(nodes) == len({node.key for node in nodes})
    assert {key for edge in edges for key in edge} <= {node.key for node in nodes}
