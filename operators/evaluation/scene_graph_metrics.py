"""Scores scene graphs against ground truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dataflow.messages import Detections2D, Odometry, Pose, SceneGraph
from dataflow.messages.geometry import invert, quaternion_from_yaw, transform_points, yaw_of
from dataflow.operator import Batch, In, Operator, Param, Sampled
from operators.labels import LabelSpace, labels_file
from operators.scene.scoring import NodeScore, RelationScore, VisibleImages, score_nodes


class SceneGraphMetrics(Operator):
    """Counts which objects a scene graph has, and which relations, at every time at which the true graph is given.

    A node is an object where classes agree and the IoU of the upright boxes is `iou`. Objects count that were plainly
    seen in several images; agents only while they are in view; others are ignored: neither a miss nor a false one. The
    graph's frame begins where its robot begins, the truth's in the world: both are brought together by where the robot
    was at the first graph, so what odometry loses later is in the figures. Node figures are those of the last graph,
    relations are over all.
    """

    graph: In[SceneGraph] = In(doc="the graph to score")
    truth: In[SceneGraph] = In(doc="the true graph of the same time")
    pose: Sampled[Pose | Odometry] = Sampled(doc="the robot in the graph's frame")
    true_pose: Sampled[Pose | Odometry] = Sampled(doc="the robot in the truth's frame")
    seen: Batch[Detections2D] = Batch(doc="the true objects of the camera's images: what could be seen")

    iou: float = Param(0.25, gt=0, le=1, doc="least IoU in space of a node and the object that it is")
    visible: float = Param(0.6, ge=0, le=1, doc="share of an object that is visible where it is plainly seen")
    pixels: int = Param(200, ge=1, doc="and its pixels")
    images: int = Param(5, ge=1, doc="images in which an object is plainly seen that counts")
    recent: float = Param(2.0, ge=0, doc="agents count that were in view so shortly before", unit="s")
    labels: str = Param("simulator", doc="label space: coco, simulator, or a YAML file; defines the agent classes")

    def setup(self) -> None:
        """Raises FileNotFoundError or ValueError for a bad label space."""
        self._labels = LabelSpace.read(self.use_file(labels_file(self.labels)))
        self._begin()

    def _begin(self) -> None:
        self._seen = VisibleImages(self.visible, self.pixels, self.images)
        self._relations = RelationScore()
        self._T_true_graph: np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None = None
        self._last: NodeScore | None = None
        self._graphs = 0

    def process(
        self,
        graph: SceneGraph,
        truth: SceneGraph,
        pose: Pose | Odometry,
        true_pose: Pose | Odometry,
        seen: tuple[Detections2D, ...],
    ) -> None:
        """Raises ValueError where a pose is not in its graph's frame."""
        for objects in seen:
            self._seen.add(objects)
        for posed, frame in ((pose, graph.frame), (true_pose, truth.frame)):
            if posed.frame != frame:
                raise ValueError(f"the robot is in {posed.frame!r}, its graph in {frame!r}")
        if self._T_true_graph is None:
            self._T_true_graph = true_pose.matrix() @ invert(pose.matrix())
        mine = _moved(graph, self._T_true_graph)
        must = self._seen.must(truth, self._labels, self.recent)
        self._last = score_nodes(mine, truth, must, self.iou)
        self._relations.add(mine, truth, self._last.match, must, self._last.ignored)
        self._graphs += 1

    def on_reset(self, input: str) -> None:
        """Starts the score again: the clock of an input was reset."""
        self._begin()

    def summary(self) -> Mapping[str, float | int | str]:
        if self._last is None:
            return {"graphs": 0}
        score = self._last
        figures = {"relations_f1": self._relations.f1("all"), "relations_f1_mapped": self._relations.f1("mapped")}
        return {
            "graphs": self._graphs,
            "objects": score.must,
            "node_recall": round(score.recall, 4),
            "node_precision": round(score.precision, 4),
            "doubles": len(score.doubles),
            **{name: round(value, 4) for name, value in figures.items() if np.isfinite(value)},
        }


def _moved(graph: SceneGraph, T: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> SceneGraph:
    """Returns a graph in another level frame: places and headings, relations as they are."""
    turn = float(np.arctan2(T[1, 0], T[0, 0]))
    yaws = np.zeros(graph.count) if graph.orientations is None or not graph.count else yaw_of(graph.orientations)
    return graph.replace(
        positions=transform_points(T, graph.positions), orientations=quaternion_from_yaw(yaws + turn).reshape(-1, 4)
    )
