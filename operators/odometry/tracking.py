"""The result of every visual odometry for a frame: a pose, its covariance, and its basis; and the messages of it."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Odometry
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix, about_fixed_axes
from operators.status import counted_status


class Status(StrEnum):
    """Holds what a frame's pose rests on."""

    INITIALISING = "initialising"  # nothing yet: one camera needs two views of a scene
    TRACKING = "tracking"  # measurements of this frame
    RELOCALISED = "relocalised"  # the same, in a map found again after a loss
    PREDICTED = "predicted"  # the motion so far, helped by whatever direction is still measured
    LOST = "lost"  # nothing for longer than the patience, or a new map whose place in the old one is unknown


MEASURED = (Status.TRACKING, Status.RELOCALISED)
LEVELS = {
    Status.INITIALISING: Level.WARN,
    Status.TRACKING: Level.OK,
    Status.RELOCALISED: Level.OK,
    Status.PREDICTED: Level.WARN,
    Status.LOST: Level.ERROR,
}


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


def outputs(result: TrackResult, frame: str, child_frame: str) -> dict[str, Any]:
    """Returns the messages of the ports `odometry` and `status`."""
    odometry = Odometry.from_matrix(
        result.T_world_camera,
        stamp=result.stamp,
        frame=frame,
        child_frame=child_frame,
        linear=result.velocity[:3],
        angular=result.velocity[3:],
        pose_covariance=about_fixed_axes(result.covariance, result.T_world_camera),
    )
    status = counted_status(
        "visual_odometry",
        result.stamp,
        f"{result.status}: {result.reason}",
        LEVELS[result.status],
        {"inliers": result.inliers, "keyframe": int(result.keyframe)},
    )
    return {"odometry": odometry, "status": status}
