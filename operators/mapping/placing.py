"""Clouds placed in the frame of a map by the pose of their sensor or of the robot that carries it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Odometry, PointCloud, Pose, Transforms
from dataflow.messages.geometry import transform_points
from operators.cloud.deskewing import deskewed
from operators.geometry.extrinsics import transform_between
from operators.geometry.se3 import Matrix

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlacedPoints:
    """Points (N, 3) in the frame of the poses, and where the sensor was, (3,). Metres."""

    points: Array
    origin: Array


def sensor_pose(frame: str, pose: Pose | Odometry, extrinsics: Transforms | None) -> tuple[Matrix, Matrix] | None:
    """Returns the pose (4, 4) of a sensor's frame, and that of the sensor in the posed frame; None if not finite.

    Raises ValueError where the pose is that of another frame and no transform relates the two.
    """
    posed = pose.child_frame or frame
    if posed != frame and extrinsics is None:
        raise ValueError(f"the pose is that of {posed!r}, the measurement in {frame!r}, and there are no extrinsics")
    T_posed_sensor = transform_between(extrinsics, frame, posed)
    if not (np.isfinite(pose.position).all() and np.isfinite(pose.orientation).all()):
        return None
    return pose.matrix() @ T_posed_sensor, T_posed_sensor


def placed(cloud: PointCloud, pose: Pose | Odometry, extrinsics: Transforms | None) -> PlacedPoints | None:
    """Returns a cloud in the frame of the pose, deskewed where times and velocity are known; None without a pose.

    Raises ValueError where the pose is that of another frame and no transform relates the two.
    """
    found = sensor_pose(cloud.frame, pose, extrinsics)
    if found is None:
        return None
    T, T_posed_sensor = found
    points = transform_points(T_posed_sensor, cloud.points)
    if cloud.time_offsets is not None and isinstance(pose, Odometry):
        still = np.zeros(3)
        parts = [still if part is None else np.nan_to_num(part) for part in (pose.linear, pose.angular)]
        points = deskewed(points, cloud.time_offsets.astype(np.float64), np.concatenate(parts))
    return PlacedPoints(transform_points(pose.matrix(), points), T[:3, 3])
