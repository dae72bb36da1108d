"""Poses in the plane: of a robot on a flat floor, by position and heading."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataflow.messages import Odometry
from dataflow.messages.geometry import quaternion_from_yaw, transform_matrix, yaw_of

Array = NDArray[np.float64]
PLANAR = (0, 1, 5)  # x, y and yaw in covariances (6, 6)


def planar(x: float, y: float, yaw: float) -> Array:
    """Returns a pose in the plane as a rigid motion (4, 4)."""
    return transform_matrix([x, y, 0.0], quaternion_from_yaw(yaw))


def flat(odometry: Odometry) -> Array:
    """Returns an odometry's pose in the plane, as a rigid motion (4, 4)."""
    return planar(odometry.position[0], odometry.position[1], float(yaw_of(odometry.orientation)))


def spatial(covariance: ArrayLike, places: tuple[int, ...] = PLANAR, rest: ArrayLike = 0.0) -> Array:
    """Returns a covariance (6, 6) that is the given one at some places, and else has these variances."""
    full = np.diag(np.broadcast_to(np.asarray(rest, np.float64), 6))
    full[np.ix_(places, places)] = covariance
    return full


def placed_in(frame: str, child_frame: str, T: Array, covariance: Array, odometry: Odometry) -> Odometry:
    """Returns a planar pose (4, 4) with its covariance (3, 3) as a message, moving as odometry does at that stamp."""
    return Odometry.from_matrix(
        T,
        stamp=odometry.stamp,
        frame=frame,
        child_frame=child_frame,
        linear=odometry.linear,
        angular=odometry.angular,
        pose_covariance=spatial(covariance, PLANAR, [0.0, 0.0, 1e-9, 1e-9, 1e-9, 0.0]),
    )
