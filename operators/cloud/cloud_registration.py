"""Clouds of one scene laid onto each other without a guess."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dataflow.messages import Diagnostics, Message, PointCloud, Pose
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import transform_points
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.cloud.filtering import finite
from operators.cloud.registration import Prepared, Registered, Settings, register
from operators.geometry.se3 import about_fixed_axes
from operators.status import counted_status


class CloudRegistration(Operator):
    """Finds the rigid motion from a cloud to a target cloud of the same scene, or reports that it failed, and why.

    Both clouds have their sensor at the origin of their frames: a motion is accepted only where each sensor saw what
    the other saw, as far as it could, and where nothing hangs in what the other saw to be free. Clouds that share too
    little, surfaces that leave a direction free, and two motions that explain the clouds as well are failures.

    Method: fast point feature histograms by Rusu, Blodow and Beetz, 2009; of their mutual matches those that agree, by
    Chen, Sun, Yang and Tao, "SC2-PCR", 2022; refined by Segal, Haehnel and Thrun, "Generalized-ICP", 2009.
    """

    cloud: In[PointCloud] = In(doc="points in the frame of their sensor, which is the origin")
    target: Sampled[PointCloud] = Sampled(doc="points of the same scene in the frame of their sensor")
    pose: Out[Pose] = Out(doc="the cloud's sensor in the target's frame, with covariance; none where it failed")
    aligned: Out[PointCloud] = Out(doc="the cloud in the target's frame; none where it failed")
    status: Out[Diagnostics] = Out(doc="registered or failed, why, overlap, fitness, violation, score and RMSE")

    child_frame: str = Param("", doc="name of the cloud's frame in the pose; the cloud's own where empty")
    voxel: float = Param(0.1, gt=0.005, doc="side of the voxels that the clouds are thinned to", unit="m")
    trials: int = Param(2_000, ge=100, le=10_000_000, doc="motions, one for each match, that are put to the vote")
    min_overlap: float = Param(0.5, gt=0, le=1, doc="least share of each cloud that the other sensor could see")
    min_fitness: float = Param(0.87, gt=0, le=1, doc="least share of that which lies on the other cloud")
    max_violation: float = Param(0.04, ge=0, lt=1, doc="most of a cloud that hangs in what the other saw to be free")
    min_score: float = Param(
        0.5,
        lt=1,
        doc="least score: the share that lies in the other's surfaces, less three times what hangs in free space",
    )
    sure_score: float = Param(
        0.6, doc="a score from which on 0.02 less of `min_fitness` and 0.01 more of `max_violation` suffice"
    )
    state: Counts

    def setup(self) -> None:
        self._settings = Settings(
            voxel=self.voxel,
            trials=self.trials,
            min_overlap=self.min_overlap,
            min_fitness=self.min_fitness,
            max_violation=self.max_violation,
            min_score=self.min_score,
            sure_score=self.sure_score,
        )
        self._target: tuple[PointCloud, Prepared] | None = None

    def process(self, cloud: PointCloud, target: PointCloud) -> dict[str, Message]:
        found = register(self._prepared(cloud), self._prepared_target(target), self._settings, self.rng)
        self.state.counts["failed" if found.reason else "registered"] += 1
        messages: dict[str, Message] = {"status": _status(cloud.stamp, found)}
        if not found.reason:
            messages["pose"] = Pose.from_matrix(
                found.T,
                stamp=cloud.stamp,
                frame=target.frame,
                child_frame=self.child_frame or cloud.frame,
                covariance=about_fixed_axes(found.covariance, found.T),
            )
            aligned = cloud.replace(
                frame=target.frame, points=transform_points(found.T, cloud.points).astype(np.float32)
            )
            if cloud.normals is not None:
                aligned = aligned.replace(normals=(cloud.normals @ found.T[:3, :3].T).astype(np.float32))
            messages["aligned"] = aligned
        return messages

    def summary(self) -> Mapping[str, int]:
        return {"registered": self.state.counts["registered"], "failed": self.state.counts["failed"]}

    def _prepared(self, cloud: PointCloud) -> Prepared:
        return Prepared.of_cloud(cloud.points[finite(cloud.points)], self.voxel)

    def _prepared_target(self, target: PointCloud) -> Prepared:
        """Returns the target prepared, once for each."""
        if self._target is None or self._target[0] is not target:
            self._target = target, self._prepared(target)
        return self._target[1]


def _status(stamp: int, found: Registered) -> Diagnostics:
    shares = {
        "overlap": found.overlap,
        "fitness": found.fitness,
        "violation": found.violation,
        "score": found.score,
        "rmse m": found.rmse,
    }
    text, level = (f"failed: {found.reason}", Level.WARN) if found.reason else ("registered", Level.OK)
    figures = {name: f"{value:.4f}" for name, value in shares.items()}
    return counted_status("cloud_registration", stamp, text, level, figures)
