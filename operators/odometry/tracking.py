"""Holds the result of every visual odometry for a frame: a pose, its covariance, and its basis."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix


class Status(StrEnum):
    """Holds what a frame's pose rests on."""

    INITIALISING = "initialising"  # nothing yet: one camera needs two views of a scene
    TRACKING = "tracking"  # measurements of this frame
    RELOCALISED = "relocalised"  # the same, in a map found again after a loss
    PREDICTED = "predicted"  # the motion so far, helped by whatever direction is still measured
    LOST = "lost"  # nothing for longer than the patience, or a new map whose place in the old one is unknown


MEASURED = (Status.TRACKING, Status.RELOCALISED)


@dataclass(frozen=True, eq=False)
class TrackResult:
    """The pose of one frame."""

    stamp: int
    T_world_camera: Matrix  # (4, 4): the camera's optical frame in that of the first frame
    covariance: Matrix  # (6, 6) of x in T_world_camera exp(x), x = (metres, radians); grows with drift
    velocity: NDArray[np.float64]  # (6,) m/s and rad/s in the camera's axes
    status: Status
    reason: str  # one line: what was measured, or why nothing was
    inliers: int  # feature tracks that agree with the pose
    depth_inliers: float  # share of compared depth points that agree with it
    keyframe: bool  # whether this frame became a keyframe
    taken_back: int | None = None  # stamp: the poses since then were at a wrong place, as this frame shows


def moved_covariance(covariance: Matrix, T_world_a: Matrix, T_world_b: Matrix) -> Matrix:
    """Carries a pose error (6, 6) of a, right perturbation, along rigidly to b."""
    A = se3.adjoint(invert(T_world_b) @ T_world_a)
    return A @ covariance @ A.T


def scaled_covariance(covariance: Matrix, factor: float) -> Matrix:
    """Returns the covariance (6, 6) of a pose whose unit of length is another."""
    by = np.repeat([factor, 1.0], 3)
    return np.asarray(covariance * np.outer(by, by))
