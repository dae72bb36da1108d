"""The messages that every visual odometry makes of a result."""

from typing import Any

from dataflow.messages import Odometry
from dataflow.messages.diagnostics import Level
from operators.geometry.se3 import about_fixed_axes
from operators.odometry.tracking import Status, TrackResult
from operators.status import counted_status

LEVELS = {
    Status.INITIALISING: Level.WARN,
    Status.TRACKING: Level.OK,
    Status.RELOCALISED: Level.OK,
    Status.PREDICTED: Level.WARN,
    Status.LOST: Level.ERROR,
}


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
