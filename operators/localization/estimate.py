"""Estimates of a pose in the plane, whether they are to be believed, and planar motions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Odometry
from dataflow.messages.geometry import quaternion_from_yaw, transform_matrix, yaw_of
from operators.estimation.particles import wrapped

Array = NDArray[np.float64]
Word = Literal["waiting", "searching", "ambiguous", "localised", "lost"]
_APART = 16.27
"""Chi-square with 3 degrees of freedom, 99.9 %."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A pose (3,) with covariance (3, 3), the share of the weight that it has, and whether it is to be believed.

    `other`: another place (3,) that explains what was observed about as well.
    """

    word: Word
    mean: Array
    covariance: Array
    share: float
    other: Array | None = None


def planar(pose: Array) -> Array:
    """Returns the rigid motion (4, 4) of a pose (x, y, yaw)."""
    return transform_matrix([pose[0], pose[1], 0.0], quaternion_from_yaw(pose[2]))


def flat(odometry: Odometry) -> Array:
    """Returns the pose in the plane, as a rigid motion (4, 4)."""
    return planar(np.array([*odometry.position[:2], float(yaw_of(odometry.orientation))]))


def apart(first: Estimate, second: Estimate) -> bool:
    """Returns whether two estimates, both to be believed, contradict each other."""
    if first.word != "localised" or second.word != "localised":
        return False
    off = first.mean - second.mean
    off[2:] = wrapped(off[2:])
    spread = first.covariance + second.covariance + np.diag([0.03**2, 0.03**2, 0.02**2])
    return float(off @ np.linalg.solve(spread, off)) > _APART
