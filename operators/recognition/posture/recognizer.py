"""Postures of the people of a scene as an operator: one look at each, by depth alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Boxes3D, Classification, Clusters, Odometry, PointCloud, Pose, SceneGraph, Transforms
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.extrinsics import transform_between
from operators.labels import LabelSpace, labels_file
from operators.recognition.activity.scene_agents import seen_times
from operators.recognition.posture.silhouette import HALF, MIDDLE, SIDE, silhouette
from operators.weights import open_kind, shipped, trained_in_simulation

if TYPE_CHECKING:
    import onnxruntime

F32 = NDArray[np.float32]
KIND = "posture"

_LEAST = 10  # points of a person
_APART = 0.5  # metres on the ground between a node and the points that are of it


@dataclass(frozen=True, eq=False)
class PostureModel:
    """An opened network. It runs on one CPU thread, so equal inputs give equal outputs."""

    classes: tuple[str, ...]
    session: onnxruntime.InferenceSession

    @classmethod
    def open(cls, file: Path) -> PostureModel:
        """Raises FileNotFoundError, or NetworkFileError where the file is no posture network for our silhouettes."""
        session, facts = open_kind(file, KIND, ("classes",), {"side": SIDE, "half": HALF, "middle": MIDDLE})
        return cls(tuple(map(str, facts["classes"])), session)

    def judge(self, silhouettes: F32) -> F32:
        """Returns probabilities (N, C) for silhouettes (N, 3, SIDE, SIDE)."""
        (found,) = self.session.run(None, {"silhouettes": silhouettes})
        return np.asarray(found, np.float32)


class PostureRecognizer(Operator):
    """Classifies the posture of each person of a scene by one look of the depth sensor.

    The points of each person in view are drawn as a silhouette of 64x64 cells, with relative depth and with the points
    before and behind the person; a small network classifies it as standing, walking, sitting down, sitting, standing
    up, reaching or drinking. It has no memory: `ActivityRecognizer` combines its answers with the motion and the
    surroundings of people. Trained on simulated depth alone (`dataflow train posture`), as in Shotton et al.,
    "Real-time human pose recognition in parts from single depth images", 2011.
    """

    nodes: In[SceneGraph] = In(doc="objects with persons among them; z points up in their frame")
    boxes: Sampled[Boxes3D] = Sampled(doc="objects found in the same look, in the order of the clusters")
    clusters: Sampled[Clusters] = Sampled(doc="the object of every point of the cloud")
    cloud: Sampled[PointCloud] = Sampled(
        doc="points of a depth camera or LiDAR; of the nodes' own stamp, as the others"
    )
    pose: Sampled[Pose | Odometry] = Sampled(doc="pose of the sensor or of the robot in the frame of the nodes")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="where the cloud's sensor is on what the pose is of; not needed where they are one frame"
    )
    postures: Out[Classification] = Out(doc="probabilities of what each person in view does, by the ids of the nodes")

    weights: str | None = Param(None, doc="network file of `dataflow train posture`; none means the shipped one")
    labels: str = Param("coco", doc="label space: coco, simulator, or a YAML file; gives the roles of classes")

    state: Counts

    @classmethod
    def trained_in_simulation(cls, params: Mapping[str, Any]) -> bool:
        return trained_in_simulation(params["weights"] or shipped("posture.onnx"))

    def setup(self) -> None:
        """Opens the network. Raises FileNotFoundError or NetworkFileError."""
        file = self.use_file(str(shipped("posture.onnx")) if self.weights is None else self.weights)
        self._model = PostureModel.open(file)
        self._labels = LabelSpace.read(self.use_file(labels_file(self.labels)))

    def process(
        self,
        nodes: SceneGraph,
        boxes: Boxes3D,
        clusters: Clusters,
        cloud: PointCloud,
        pose: Pose | Odometry,
        extrinsics: Transforms | None = None,
    ) -> Classification:
        """Raises ValueError where the pose is in another frame than the nodes, or no transform relates the sensors."""
        if pose.frame != nodes.frame:
            raise ValueError(f"the pose is in {pose.frame!r}, the nodes in {nodes.frame!r}")
        found: list[tuple[int, F32]] = []
        fresh = nodes.stamp == cloud.stamp == clusters.stamp == boxes.stamp
        if fresh:
            T_world_cloud = pose.matrix() @ transform_between(extrinsics, cloud.frame, pose.child_frame)
            found = _silhouettes(nodes, boxes, clusters, cloud, T_world_cloud, self._labels)
        self.state.counts.update({"graphs": 1, "persons": len(found), "graphs without a new view": int(not fresh)})
        names = self._model.classes
        probabilities = np.zeros((0, len(names)), np.float32)
        if found:
            probabilities = np.clip(self._model.judge(np.stack([shape for _, shape in found])), 0, 1)
        return Classification(
            stamp=nodes.stamp,
            frame=nodes.frame,
            class_names=names,
            class_ids=probabilities.argmax(axis=1).astype(np.int32),
            scores=probabilities.max(axis=1, initial=0.0),
            probabilities=probabilities,
            ids=np.array([id for id, _ in found], np.int64),
        )


def _silhouettes(
    nodes: SceneGraph,
    boxes: Boxes3D,
    clusters: Clusters,
    cloud: PointCloud,
    T_world_cloud: NDArray[np.float64],
    space: LabelSpace,
) -> list[tuple[int, F32]]:
    """Returns ids and silhouettes of the persons among the nodes that the look shows."""
    persons = [k for k, label in enumerate(boxes.labels()) if "person" in space.roles(label) and k < clusters.count]
    if not persons:
        return []
    finite = np.isfinite(cloud.points).all(axis=1)
    labels = clusters.labels[finite]
    points = cloud.points[finite].astype(np.float64) @ T_world_cloud[:3, :3].T + T_world_cloud[:3, 3]
    owned = {k: points[labels == k] for k in persons}
    middles = {k: np.median(own, axis=0)[:2] for k, own in owned.items() if len(own) >= _LEAST}
    seen = seen_times(nodes)
    found = []
    for row, (id, of) in enumerate(zip(nodes.ids.tolist(), nodes.class_ids.tolist(), strict=True)):
        label = nodes.class_names[of] if nodes.class_names else ""
        if "person" not in space.roles(label) or seen[id] != nodes.stamp or not middles:
            continue
        place, size = nodes.positions[row], nodes.sizes[row]
        if not (np.isfinite(place).all() and np.isfinite(size).all()):
            continue
        away = {k: float(np.hypot(*(middle - place[:2]))) for k, middle in middles.items()}
        nearest = min(away, key=lambda k: away[k])
        if away[nearest] > _APART:
            continue
        foot = np.array([*place[:2], place[2] - size[2] / 2])
        shape = silhouette(points, labels == nearest, foot, T_world_cloud[:3, 3])
        if shape is not None:
            found.append((id, shape))
    return found
