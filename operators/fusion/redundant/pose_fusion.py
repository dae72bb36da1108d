"""The pose of one body from several sensors as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Imu, Message, Odometry, Pose, Transforms
from dataflow.messages.geometry import invert, matrix_to_quaternion, quaternion_to_matrix, transform_matrix
from dataflow.operator import Context, Duration, In, Operator, Out, Param, Sampled
from operators.fusion.redundant.combination import RigidPose, inverted, pose_consistency, pose_misfits, posed
from operators.fusion.redundant.sensors import RedundantSensors
from operators.geometry.extrinsics import transform_between
from operators.geometry.se3 import skew

Array = NDArray[np.float64]


@dataclass
class State:
    """Holds what each sensor gave last, and how far the sensors agree."""

    sensors: RedundantSensors[Message]


class PoseFusion(Operator):
    """Combines the poses that several sensors give of one body, without a motion model: any of them may be missing.

    Poses and odometry count with their covariances, inertial sensors with the orientation that they estimate.
    Rotations are averaged on the manifold. Sensors whose messages are at most `window` old count as simultaneous.

    Each sensor is compared with the others. Of three or more the one that contradicts the rest is left out; of two
    it is undecidable which is wrong, and the covariance grows until it holds both. The status reports either before it
    is averaged. Covariances follow how far a sensor is from the others, so a degrading one loses its weight. For a
    body that moves fast, or sensors with biases and delays, there is EkfFusion.

    Methods: rotations, Hartley et al., "Rotation averaging", 2013; positions by least squares with the covariances as
    weights; contradictions by the chi-square test of the difference.
    """

    estimates: In[Imu | Pose | Odometry] = In(many=True, doc="poses in `frame` with covariance; orientations")
    extrinsics: Sampled[Transforms] = Sampled(required=False, doc="where what the sensors pose is on the body")
    pose: Out[Pose] = Out(doc="the body in `frame`, once position and orientation are known")
    status: Out[Diagnostics] = Out(doc="which sensors agree; every second, and at once when one contradicts another")

    frame: str = Param("world", min_length=1, doc="frame of all poses")
    base_frame: str = Param("base_link", min_length=1, doc="frame that is posed")
    window: Duration = Param("50ms", doc="how old a sensor's message may be")
    share: float = Param(0.999, gt=0, lt=1, doc="share of true estimates that do not count as a contradiction")

    state: State

    def initial_state(self) -> State:
        return State(RedundantSensors(self.window, self.share))

    def process(
        self, estimates: Mapping[str, Message], context: Context, extrinsics: Transforms | None = None
    ) -> dict[str, Any]:
        """Raises ValueError for poses of another frame, and for estimates without covariance."""
        stamp = context.stamp
        self.state.sensors.take(estimates)
        agreement = self.state.sensors.agreement
        seen: dict[str, RigidPose] = {}
        for name, message in self.state.sensors.simultaneous(stamp):
            if (one := self._of(name, message, extrinsics)) is not None:
                seen[name] = replace(one, information=one.information / agreement.noise(name))
        result: dict[str, Any] = {}
        if seen:
            kept, growth = agreement.judge(list(seen), list(seen.values()), pose_consistency, pose_misfits)
            mean = posed(kept)
            if float(np.linalg.eigvalsh(mean.information)[0]) > 0:
                result["pose"] = Pose(
                    stamp=stamp,
                    frame=self.frame,
                    child_frame=self.base_frame,
                    position=mean.position,
                    orientation=matrix_to_quaternion(mean.rotation),
                    covariance=inverted(mean.information) * growth,
                )
            else:
                self.state.sensors.ignored["position or orientation unknown"] += 1
        return result | {"status": self.state.sensors.status(stamp)}

    def summary(self) -> Mapping[str, float | int | str]:
        return self.state.sensors.summary()

    def _of(self, name: str, message: Message, extrinsics: Transforms | None) -> RigidPose | None:
        """The pose in a message; None where there is none, which is counted."""
        if isinstance(message, Imu):
            if message.orientation is None or message.orientation_covariance is None:
                raise ValueError(f"{name}: its samples have no orientation with covariance")
            T = transform_between(extrinsics, message.frame, self.base_frame)
            rotation = quaternion_to_matrix(message.orientation) @ T[:3, :3].T
            return self._checked(name, np.zeros(3), rotation, message.orientation_covariance, slice(3, 6))
        assert isinstance(message, Pose | Odometry)
        if message.frame != self.frame:
            raise ValueError(f"{name}: its poses are in {message.frame!r}, the fused one is in {self.frame!r}")
        given = message.covariance if isinstance(message, Pose) else message.pose_covariance
        if given is None:
            raise ValueError(f"{name}: its messages have no covariance: how good they are must be known")
        if not (np.isfinite(message.position).all() and np.isfinite(message.orientation).all()):
            self.state.sensors.ignored[f"{name}: not finite"] += 1
            return None
        T_child_base = invert(transform_between(extrinsics, message.child_frame or self.base_frame, self.base_frame))
        T = transform_matrix(message.position, message.orientation) @ T_child_base
        J = np.eye(6)
        J[:3, 3:] = -skew(T[:3, 3] - message.position)
        return self._checked(name, T[:3, 3], T[:3, :3], J @ given @ J.T, slice(0, 6))

    def _checked(
        self, name: str, position: Array, rotation: Array, covariance: Array, known: slice
    ) -> RigidPose | None:
        if not (np.isfinite(position).all() and np.isfinite(rotation).all() and np.isfinite(covariance).all()):
            self.state.sensors.ignored[f"{name}: not finite"] += 1
            return None
        if float(np.linalg.eigvalsh(covariance)[0]) <= 0:
            self.state.sensors.ignored[f"{name}: covariance not positive"] += 1
            return None
        information = np.zeros((6, 6))
        information[known, known] = inverted(covariance)
        return RigidPose(position, rotation, information)
