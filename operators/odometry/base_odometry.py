"""Odometry of a sensor as odometry of the robot that carries it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dataflow.messages import Message, Odometry, Path, Transforms
from dataflow.messages.geometry import invert, matrix_to_quaternion, quaternion_to_matrix
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.extrinsics import transform_between


@dataclass(kw_only=True)
class State(Counts):
    """Holds the stamp of the last path that was given."""

    path: int = -1


class BaseOdometry(Operator):
    """Puts a camera's odometry on the robot: the pose of its base in the frame in which the base began.

    A camera's own odometry begins at its optical frame, tilted as it is mounted. With the extrinsics this gives a frame
    whose z is up where the robot stood level at first, and whose origin is on the floor. A pose that is not finite
    gives none, and is counted; so does one without a scale (infinite variances) of a sensor beside the base, since
    the position of the base is unknown until the scale is.

    Method: covariances to first order, Smith, Self and Cheeseman, "Estimating uncertain spatial relationships in
    robotics", 1990.
    """

    sensor: In[Odometry] = In(doc="pose of a sensor in the frame where that sensor began")
    extrinsics: Sampled[Transforms] = Sampled(doc="holds the transform between the sensor's frame and the base's")
    path: Sampled[Path] = Sampled(
        required=False, doc="keyframes of the sensor as SLAM has them, in the frame of its poses"
    )
    odometry: Out[Odometry] = Out(doc="the base in `frame`, with covariance where the sensor's has one")
    keyframes: Out[Path] = Out(doc="the base at those keyframes, in `frame`; where a new `path` came")

    base_frame: str = Param("base_link", min_length=1, doc="frame of the robot's base")
    frame: str = Param("odom_base", min_length=1, doc="name of the frame in which the base began")

    state: State

    def process(self, sensor: Odometry, extrinsics: Transforms, path: Path | None = None) -> dict[str, Message]:
        """Raises ValueError where the extrinsics do not hold the sensor, or the path is in another frame."""
        T_base_sensor = transform_between(extrinsics, sensor.child_frame, self.base_frame)
        if _without_scale(sensor) and T_base_sensor[:3, 3].any():
            self.state.counts["poses without scale"] += 1
            return {}
        if not (np.isfinite(sensor.position).all() and np.isfinite(sensor.orientation).all()):
            self.state.counts["poses not finite"] += 1
            return {}
        T = T_base_sensor @ sensor.matrix() @ invert(T_base_sensor)
        odometry = Odometry.from_matrix(
            T,
            stamp=sensor.stamp,
            frame=self.frame,
            child_frame=self.base_frame,
            pose_covariance=_carried(sensor, T_base_sensor, T),
        )
        if path is None or path.stamp == self.state.path:
            return {"odometry": odometry}
        if path.frame != sensor.frame:
            raise ValueError(f"the path is in {path.frame!r}, the sensor's poses are in {sensor.frame!r}")
        self.state.path = path.stamp
        return {"odometry": odometry, "keyframes": self._of_base(path, T_base_sensor)}

    def _of_base(self, path: Path, T_base_sensor: np.ndarray) -> Path:
        T = np.tile(np.eye(4), (path.count, 1, 1))
        T[:, :3, 3] = path.positions
        if path.orientations is not None:
            T[:, :3, :3] = [quaternion_to_matrix(q) for q in path.orientations]
        T = T_base_sensor @ T @ invert(T_base_sensor)
        turned = None if path.orientations is None else matrix_to_quaternion(T[:, :3, :3]).reshape(-1, 4)
        return path.replace(frame=self.frame, positions=T[:, :3, 3], orientations=turned)


def _without_scale(sensor: Odometry) -> bool:
    return sensor.pose_covariance is not None and bool(np.isinf(np.diag(sensor.pose_covariance)[:3]).any())


def _carried(sensor: Odometry, T_base_sensor: np.ndarray, T: np.ndarray) -> np.ndarray | None:
    """Returns the covariance about fixed axes of the base's pose; the lever arm turns rotation into translation."""
    if sensor.pose_covariance is None:
        return None
    R = T_base_sensor[:3, :3]
    arm = T[:3, 3] - (T_base_sensor @ sensor.matrix())[:3, 3]  # from the sensor to the base
    x, y, z = arm
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    if _without_scale(sensor):
        turned = R @ sensor.pose_covariance[3:, 3:] @ R.T
        C = np.diag([np.inf] * 3 + [0.0] * 3)
        C[3:, 3:] = 0.5 * (turned + turned.T)
        return C
    C = A @ sensor.pose_covariance @ A.T
    return np.asarray((C + C.T) / 2)
