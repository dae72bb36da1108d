"""Nodes and relations are counted against the truth; what does not count is neither right nor wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_graphs import scene_graph

from dataflow.messages import Detections2D, SceneGraph
from operators.labels import LabelSpace, labels_file
from operators.scene.relations import FLOOR
from operators.scene.scoring import RelationScore, VisibleImages, score_nodes


def graph(nodes: dict[int, tuple[str, float]], relations: list[tuple[int, str, int]]) -> SceneGraph:
    """Boxes of half a metre, by id: class and x."""
    things = [(id, name, (x, 0, 1.0), (0.5, 0.5, 0.5)) for id, (name, x) in nodes.items()]
    scores = np.ones(len(nodes) + 1, np.float32)
    return scene_graph([(FLOOR, "floor", (0, 0, -0.1), (20, 20, 0.1)), *things], relations, scores=scores)


TRUTH = graph(
    {11: ("mug", 1.0), 12: ("table", 2.0), 13: ("ball", 3.0)}, [(11, "near", 12), (12, "near", 13), (12, "on", FLOOR)]
)


def f1(mine: SceneGraph, must: set[int]) -> float:
    score, relations = score_nodes(mine, TRUTH, must), RelationScore()
    relations.add(mine, TRUTH, score.match, must, score.ignored)
    return relations.f1("all")


def test_all_that_is_true_and_nothing_else_scores_one() -> None:
    mine = graph(
        {21: ("mug", 1.0), 22: ("table", 2.0), 23: ("ball", 3.0)},
        [(21, "near", 22), (22, "near", 23), (22, "on", FLOOR)],
    )
    assert f1(mine, {11, 12, 13}) == 1.0


@pytest.mark.parametrize("relation", [(22, "near", 23), (22, "left_of", 23)], ids=["true", "false"])
@pytest.mark.parametrize("place", [3.0, 3.35], ids=["matched", "beside its thing"])
def test_relations_with_a_thing_that_does_not_count_are_neither_right_nor_wrong(
    relation: tuple[int, str, int], place: float
) -> None:
    nodes = {21: ("mug", 1.0), 22: ("table", 2.0)}
    told = [(21, "near", 22)]
    without = f1(graph(nodes, told), {11, 12})
    assert f1(graph({**nodes, 23: ("ball", place)}, [*told, relation]), {11, 12}) == without == pytest.approx(2 / 3)


def test_relations_with_a_node_of_nothing_are_false() -> None:
    nodes = {21: ("mug", 1.0), 22: ("table", 2.0), 24: ("mug", 9.0)}
    mine = graph(nodes, [(21, "near", 22), (22, "on", FLOOR), (24, "near", 22)])
    assert score_nodes(mine, TRUTH, {11, 12}).wrong == [("mug", 24, 0.0, 8.0)]
    assert f1(mine, {11, 12}) == pytest.approx(0.8)


def test_relation_precision_and_recall_count_false_and_missed_ones() -> None:
    nodes = {21: ("mug", 1.0), 22: ("table", 2.0), 24: ("mug", 9.0)}
    mine = graph(nodes, [(22, "on", FLOOR), (24, "near", 22), (24, "left_of", 22)])  # one right, two false, one missed
    score, relations = score_nodes(mine, TRUTH, {11, 12}), RelationScore()
    relations.add(mine, TRUTH, score.match, {11, 12}, score.ignored)
    assert relations.precision("all") == pytest.approx(1 / 3)
    assert relations.recall("all") == pytest.approx(1 / 2)
    assert relations.precision("mapped") == 1.0
    assert relations.recall("mapped") == pytest.approx(1 / 2)
    assert np.isnan(RelationScore().precision("all"))
    assert np.isnan(RelationScore().recall("all"))


def test_mapped_relations_are_scored_separately() -> None:
    mine = graph({21: ("mug", 1.0), 23: ("ball", 3.0)}, [(21, "near", 23)])
    relations = RelationScore()
    relations.add(mine, TRUTH, score_nodes(mine, TRUTH, {11}).match, {11})
    assert relations.f1("mapped") == 0.0
    assert np.isnan(relations.f1("all"))


def in_image(second: int, ids: list[int]) -> Detections2D:
    return Detections2D(
        stamp=second * 1_000_000_000, frame="camera", width=100, height=100, class_names=("thing",),
        boxes=np.tile(np.array([0, 0, 50, 50], np.float32), (len(ids), 1)), scores=np.ones(len(ids), np.float32),
        class_ids=np.zeros(len(ids), np.int32), ids=np.array(ids, np.int64), visible=np.ones(len(ids), np.float32),
        pixel_counts=np.full(len(ids), 2500, np.int64),
    )  # fmt: skip


def test_map_must_contain_plainly_seen_objects_and_visible_movers() -> None:
    """The table (12) is seen from the third second on, the ball (13) up to the fourth, the mug (11) always."""
    seen, must = VisibleImages(images=3), []
    labels = LabelSpace.read(Path(labels_file("simulator")))
    for second in range(8):
        seen.add(in_image(second, [11, *([12] if second >= 3 else []), *([13] if second <= 4 else [])]))
        must.append(seen.must(TRUTH.replace(stamp=second * 1_000_000_000), labels))
    assert must == [set(), set(), {11, 13}, {11, 13}, {11, 13}, {11, 12, 13}, {11, 12, 13}, {11, 12}]
