"""What is told of a scene graph: who carries what, who does what and where to; not what is near what."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dataflow.messages import Activity, SceneGraph
from dataflow.messages.scene_summary import (
    CARRYING,
    LEAST,
    Row,
    agents_in_words,
    carriers_in_words,
    grouped,
    movers_in_words,
    plural,
    summarize,
)

Relation = tuple[int, str, int, float]


def graph(classes: str, *relations: Relation, places: Mapping[int, int] | None = None) -> SceneGraph:
    """Nodes of these classes with ids 1, 2, ..., but for `places`, whose ids are given by index; relations by index."""
    words = classes.split()
    names = tuple(dict.fromkeys(words))
    return SceneGraph(
        stamp=0, frame="map", class_names=names, predicates=tuple(p for _, p, _, _ in relations),
        ids=np.array([(places or {}).get(k, k + 1) for k in range(len(words))]),
        class_ids=np.array([names.index(word) for word in words], np.int32),
        positions=np.zeros((len(words), 3)), sizes=np.ones((len(words), 3)),
        subjects=np.array([s for s, _, _, _ in relations], np.int32),
        objects=np.array([o for _, _, o, _ in relations], np.int32),
        relation_scores=np.array([score for _, _, _, score in relations], np.float32),
    )  # fmt: skip


def test_a_thing_is_carried_by_the_likeliest_alone() -> None:
    told = summarize(graph("mug table shelf", (0, "on", 1, 0.7), (0, "in", 2, 0.9), (1, "on", 2, 0.4)))
    assert {child: (r.predicate, r.object) for child, r in told.carriers.items()} == {0: ("in", 2)}
    assert told.carried(2) == (0,)


def test_carrier_is_the_object_in_place_of_its_top() -> None:
    made = graph("mug table tabletop", (0, "on", 1, 0.7), (0, "on", 2, 0.9), (2, "part_of", 1, 0.9), places={2: -11})
    told = summarize(made)
    assert {child: r.object for child, r in told.carriers.items()} == {0: 1, 2: 1}
    assert [(row.name, row.text) for row in carriers_in_words(made, told)] == [("table 2", "on it mug 1")]
    alone = graph("mug tabletop", (0, "on", 1, 0.9), places={1: -11})
    assert [row.text for row in carriers_in_words(alone, summarize(alone))] == ["on it mug 1"]


@given(
    st.lists(st.tuples(st.integers(0, 5), st.sampled_from(CARRYING), st.integers(0, 5), st.floats(0, 1)), max_size=30)
)
def test_nothing_carries_itself_by_whatever_way(relations: list[Relation]) -> None:
    told = summarize(graph("box box box box box box", *relations))
    for start in told.carriers:
        node, seen = start, set[int]()
        while node in told.carriers:
            assert node not in seen
            seen.add(node)
            node = told.carriers[node].object
    for child, relation in told.carriers.items():
        assert relation.subject == child
        assert relation.score >= np.float32(LEAST)
        assert (child, relation.predicate, relation.object) in {(s, p, o) for s, p, o, _ in relations}


def test_relations_between_almost_all_objects_are_omitted() -> None:
    near = [(a, "near", b, 1.0) for a in range(4) for b in range(a)]
    told = summarize(graph("mug mug mug person", *near, (3, "holding", 1, 0.8), (0, "under", 2, 0.4)))
    assert [(r.subject, r.predicate, r.object) for r in told.telling] == [(3, "holding", 1)]


def test_the_commonest_predicates_give_way_and_agents_come_first() -> None:
    many = [(a, "touching", b, 1.0) for a in range(6) for b in range(6) if a != b]
    told = summarize(
        graph("mug mug mug mug mug mug person", *many, (0, "above", 1, 0.9), (6, "facing", 1, 0.6)), most=4
    )
    assert [r.predicate for r in told.telling] == ["facing", "above"]


def test_an_agent_faces_one_thing() -> None:
    told = summarize(graph("person mug box", (0, "facing", 1, 0.6), (0, "facing", 2, 0.8), (1, "above", 2, 0.9)))
    assert [(r.subject, r.predicate, r.object) for r in told.telling] == [(0, "facing", 2), (1, "above", 2)]


def test_intentions_of_any_likelihood_are_listed_likeliest_first() -> None:
    told = summarize(graph("person chair door", (0, "heads_for", 1, 0.2), (0, "heads_for", 2, 0.7)))
    assert [(r.object, round(r.score, 1)) for r in told.intentions] == [(2, 0.7), (1, 0.2)]
    assert not told.telling


def test_people_are_summarized_with_activities_and_the_ball_as_a_mover() -> None:
    scene = graph("ball person chair", (1, "heads_for", 2, 0.76), (0, "on", 2, 0.9))
    acts = Activity(
        stamp=0, class_names=("walking", "resting"), subjects=np.array([2, 1]),
        class_ids=np.array([0, 1], np.int32), scores=np.array([0.9, 0.5], np.float32),
    )  # fmt: skip
    told = summarize(scene, acts)
    assert agents_in_words(scene, told, acts) == [Row("person 2", "walking 90 %, heads for chair 3 (76 %)")]
    assert movers_in_words(scene, told, acts) == [Row("ball 1", "resting 50 %, on chair 3")]


def test_carried_objects_are_grouped_by_class_and_single_ones_listed_on_the_floor() -> None:
    scene = graph(
        "floor table book book mug lamp",
        (1, "on", 0, 0.9), (2, "on", 1, 0.9), (3, "on", 1, 0.9), (4, "in", 1, 0.9), (5, "on", 0, 0.9),
        places={0: 0},
    )  # fmt: skip
    rows = carriers_in_words(scene, summarize(scene))
    assert [(row.name, row.text) for row in rows] == [("table 2", "on it 2 books; in it mug 5"), ("floor 0", "lamp 6")]


def test_agents_are_determined_by_acting_not_by_class() -> None:
    scene = graph("zorb mug table", (0, "holding", 1, 0.9), (1, "on", 2, 0.9))
    assert summarize(scene).agents == {0}
    acts = Activity(
        stamp=0, class_names=("resting",), subjects=np.array([3]), class_ids=np.array([0], np.int32),
        scores=np.array([0.9], np.float32),
    )  # fmt: skip
    assert summarize(scene, acts).agents == {0, 2}


def test_groups_are_in_english() -> None:
    assert [plural(word) for word in ("robot", "shelf", "box", "bench", "mug")] == [
        "robots", "shelves", "boxes", "benches", "mugs",
    ]  # fmt: skip
    assert grouped(["mug 1", "box 2", "box 3"], ["mug", "box", "box"]) == "2 boxes, mug 1"


def test_graph_without_names_and_scores_is_summarized() -> None:
    scene = SceneGraph(
        stamp=0, frame="", predicates=("on",), ids=np.array([7, 8]), class_ids=np.array([0, 3], np.int32),
        positions=np.zeros((2, 3)), sizes=np.ones((2, 3)), subjects=np.array([0], np.int32),
        objects=np.array([1], np.int32),
    )  # fmt: skip
    assert [(row.name, row.text) for row in carriers_in_words(scene, summarize(scene))] == [("3 8", "on it 0 7")]
