"""Finds the vertical of a cloud, and the height of its sensor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Odometry, PointCloud, Pose, Transforms
from operators.geometry.extrinsics import transform_between

Array = NDArray[np.float64]


def unit(up: tuple[float, float, float]) -> Array:
    """Returns a direction of length 1. Raises ValueError where it has none."""
    length = float(np.linalg.norm(up))
    if not length > 1e-6 or not math.isfinite(length):
        raise ValueError(f"up {up} is no direction")
    return np.array(up) / length


def told(pose: Pose | Odometry | None) -> bool:
    """Returns whether there is a finite pose, without which up is unknown."""
    return pose is not None and bool(np.isfinite(pose.position).all() and np.isfinite(pose.orientation).all())


def gravity(
    cloud: PointCloud, pose: Pose | Odometry | None, extrinsics: Transforms | None, fallback: Array
) -> tuple[Array, float]:
    """Returns up (3,) in the cloud's frame and the height of that frame's origin in the pose's frame, whose z is up.

    Without a finite pose they are `fallback` and 0. The pose may be of the cloud's own frame or of one that the
    extrinsics relate to it; ValueError where they do not.
    """
    T = standing(cloud, pose, extrinsics)
    return (fallback, 0.0) if T is None else (np.asarray(T[2, :3]), float(T[2, 3]))


def standing(cloud: PointCloud, pose: Pose | Odometry | None, extrinsics: Transforms | None) -> Array | None:
    """Returns the pose (4, 4) of the cloud's frame in the pose's frame; None without a finite one. Errors as
    `gravity`."""
    if pose is None or not told(pose):
        return None
    posed = pose.child_frame or cloud.frame
    if posed != cloud.frame and extrinsics is None:
        raise ValueError(f"the pose is that of {posed!r}, the cloud in {cloud.frame!r}, and there are no extrinsics")
    return np.asarray(pose.matrix() @ transform_between(extrinsics, cloud.frame, posed))
