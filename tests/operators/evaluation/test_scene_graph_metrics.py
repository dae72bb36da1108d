"""SceneGraphMetrics on made graphs."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from made_graphs import Thing, scene_graph

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Detections2D, Odometry
from dataflow.testing import play
from operators.evaluation import SceneGraphMetrics

SECOND = 1_000_000_000
CLASSES = ("box", "table", "floor")
TABLE, BOX, FAR = (
    (1, "table", (2.0, 0.0, 0.4), (1.0, 0.8, 0.8)),
    (2, "box", (2.0, 0.0, 0.9), (0.2, 0.2, 0.2)),
    (3, "box", (9.0, 9.0, 0.1), (0.2, 0.2, 0.2)),
)


def graph(stamp: int, nodes: list[Thing], relations: list[tuple[int, str, int]], offset: Any = 0.0, **more: Any) -> Any:
    made = scene_graph(nodes, relations, stamp=stamp, orientations=np.tile([0, 0, 0, 1.0], (len(nodes), 1)), **more)
    return made.replace(positions=made.positions + offset)


def seen(stamp: int, ids: list[int], visible: float = 1.0) -> Detections2D:
    return Detections2D(
        stamp=stamp, frame="camera", width=640, height=480, class_names=CLASSES,
        boxes=np.tile([10.0, 10, 50, 50], (len(ids), 1)), scores=np.ones(len(ids), np.float32),
        class_ids=np.zeros(len(ids), np.int32), ids=np.array(ids, np.int64),
        visible=np.full(len(ids), visible, np.float32), pixel_counts=np.full(len(ids), 900, np.int64),
    )  # fmt: skip


def robot(stamp: int, frame: str, x: float) -> Odometry:
    return Odometry(stamp=stamp, frame=frame, child_frame="base", position=[x, 0, 0], orientation=[0, 0, 0, 1])


def scored(
    mine: list[Thing], relations: list[tuple[int, str, int]], offset: float = 0.0, **more: Any
) -> dict[str, Any]:
    """The graph's frame begins `offset` along every axis of the world; the robot says so."""
    stamps = [SECOND * (k + 1) for k in range(6)]
    true = [TABLE, BOX, FAR]
    shift = [[offset, 0, 0]]
    streams = {
        "graph": [graph(t, mine, relations, frame="odom", offset=-np.array(shift)) for t in stamps],
        "truth": [graph(t, true, [(2, "on", 1)]) for t in stamps],
        "pose": [robot(t, more.get("frame", "odom"), 0.0) for t in stamps],
        "true_pose": [robot(t, "world", offset) for t in stamps],
        "seen": [seen(t, [1, 2]) for t in stamps],
    }
    metrics = SceneGraphMetrics(images=more.get("images", 5))
    play(metrics, streams)
    return dict(metrics.summary())


def test_right_graph_in_another_frame_scores_one() -> None:
    figures = scored([(7, "table", TABLE[2], TABLE[3]), (8, "box", BOX[2], BOX[3])], [(8, "on", 7)], offset=3.0)
    assert figures == {
        "graphs": 6,
        "objects": 2,
        "node_recall": 1.0,
        "node_precision": 1.0,
        "doubles": 0,
        "relations_f1": 1.0,
        "relations_f1_mapped": 1.0,
    }


def test_doubles_and_false_relations_count_and_unseen_objects_do_not() -> None:
    beside = (2.25, 0.0, 0.9)
    nodes: list[Thing] = [
        (7, "table", TABLE[2], TABLE[3]),
        (8, "box", BOX[2], BOX[3]),
        (9, "box", beside, BOX[3]),
        (10, "box", (9.1, 9.0, 0.1), BOX[3]),
    ]
    figures = scored(nodes, [(8, "on", 7), (9, "on", 7)])
    assert figures["doubles"] == 1
    assert figures["node_precision"] == pytest.approx(2 / 3, abs=1e-3)
    assert figures["relations_f1_mapped"] == 1.0
    assert figures["relations_f1"] == pytest.approx(2 / 3, abs=1e-3)


@pytest.mark.parametrize(
    ("images", "objects", "recall"), [(5, 2, 0.5), (7, 0, 0.0)], ids=["plainly seen", "hardly seen"]
)
def test_objects_count_that_were_plainly_seen(images: int, objects: int, recall: float) -> None:
    figures = scored([(7, "table", TABLE[2], TABLE[3])], [], images=images)
    assert (figures["objects"], figures["node_recall"]) == (objects, recall)
    assert figures["node_precision"] == (1.0 if objects else 0.0)


def test_a_robot_in_another_frame_than_its_graph_is_refused() -> None:
    with pytest.raises(OperatorFailure, match="the robot is in 'map', its graph in 'odom'"):
        scored([(7, "table", TABLE[2], TABLE[3])], [], frame="map")


def test_scoring_imports_no_map_dependencies() -> None:
    code = "import sys; from operators.evaluation import SceneGraphMetrics; print('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
