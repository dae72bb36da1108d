"""LiDAR odometry as an operator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from dataflow.messages import Diagnostics, Message, Odometry, PointCloud, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.extrinsics import transform_between
from operators.geometry.se3 import Matrix, about_fixed_axes, adjoint
from operators.odometry.lidar.tracker import LidarTracker, Tracked, TrackerConfig
from operators.odometry.tracking import Status
from operators.status import counted_status

_STAMPED = {"begin": 0.0, "middle": 0.5, "end": 1.0}
_LEVELS = {Status.PREDICTED: Level.WARN, Status.LOST: Level.ERROR}


class Sweep(BaseModel):
    """Holds how a LiDAR turns about its z axis, at constant speed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    period: float = Field(gt=0, le=10, description="seconds that a turn takes")
    begins: float = Field(0.0, description="azimuth at which it begins, radians from x towards y")
    clockwise: bool = Field(False, description="seen from above")
    stamped: Literal["begin", "middle", "end"] = Field("end", description="moment of the turn that stamps give")

    def offsets(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns when each of the points (N, 3) was measured after the stamp (N,), seconds; NaN where a point is.

        As in Zhang and Singh, "LOAM: lidar odometry and mapping in real-time", 2014.
        """
        azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
        turned = np.mod((self.begins - azimuth) if self.clockwise else (azimuth - self.begins), 2 * math.pi)
        return ((turned / (2 * math.pi) - _STAMPED[self.stamped]) * self.period).astype(np.float32)


@dataclass(kw_only=True)
class LidarState(Counts):
    """Holds the tracker with its map, and counts scans by state."""

    tracker: LidarTracker


class LidarOdometry(Operator):
    """Tracks a LiDAR by the planes of a map built from its scans; the first scan is the origin.

    A scan whose points have `time_offsets`, or get them by `sweep`, is deskewed with the velocity that its own pose
    means. Without either, its pose is that of the middle of the turn rather than that of the stamp. Scans that measure
    nothing are bridged with the velocity so far, for `patience`; then the LiDAR is lost, there are no poses, and it is
    looked for within three metres of where it was, in any heading, and not believed where two places fit or a
    direction is not constrained; after `give_up` a new map begins there. The covariance is that of the whole way: it
    grows when the LiDAR leaves what it has mapped and with every bridge, and along directions that the surroundings do
    not constrain (a bare corridor), which the status names. Where scans are so far apart that the prediction may be off
    by half a metre, or the first step may be more than three, it is looked for around the prediction, and a pose with
    a rival is not believed; a street that repeats itself exactly may yet be followed one period off. A scan that
    repeats the last one means that the LiDAR stands: where a sensor may hang, ScanWatch before this operator holds it
    back.

    Method: scan to map, point to plane. Yuan et al., "Efficient and probabilistic adaptive voxel mapping for accurate
    online LiDAR odometry", 2022; prediction and kernel as in Vizzo et al., "KISS-ICP", 2023; directions without support
    as in Tuna et al., "X-ICP", 2023.
    """

    cloud: In[PointCloud] = In(doc="one turn of the LiDAR")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the LiDAR's frame and `body_frame`"
    )
    odometry: Out[Odometry] = Out(doc="the body in the odometry frame, with velocity and covariances; none when lost")
    status: Out[Diagnostics] = Out(
        doc="tracking, relocalised, predicted or lost, with the reason and counts; at every scan"
    )

    odometry_frame: str = Param("odom", min_length=1, doc="name of the frame that the body's first pose defines")
    body_frame: str = Param("", doc="frame whose pose is given; the LiDAR's own where empty")
    near: float = Param(0.5, ge=0, doc="nearer points are left out: the robot itself", unit="m")
    far: float = Param(100.0, gt=1, doc="farther points are left out", unit="m")
    sweep: Sweep | None = Param(
        None,
        doc="how the LiDAR turns (period, begins, clockwise, stamped), where its points do not say when each was "
        "measured; nothing is deskewed if none",
    )
    spacing: float | None = Param(
        None, gt=0.01, doc="distance of the points that are kept; a fortieth of the median range if none", unit="m"
    )
    voxel: float = Param(2.0, gt=0.1, doc="side of the largest planes of the map", unit="m")
    levels: int = Param(3, ge=1, le=5, doc="sizes of planes, each half the one before")
    noise: float = Param(0.03, gt=0, doc="standard deviation of a range", unit="m")
    correlation: float = Param(10.0, ge=1, doc="points whose errors are alike, for the covariance")
    acceleration: float = Param(10.0, gt=0, doc="standard deviation from constant velocity", unit="m/s²")
    angular_acceleration: float = Param(15.0, gt=0, doc="the same of turning", unit="rad/s²")
    start_speed: float = Param(30.0, gt=0, doc="how fast it may move when first seen", unit="m/s")
    min_known: float = Param(0.2, ge=0, le=1, doc="least share of a scan in mapped places")
    min_inliers: float = Param(0.5, ge=0, le=1, doc="least share of the points on planes that agree with them")
    patience: float = Param(0.5, ge=0, doc="time bridged by prediction, and one scan at least", unit="s")
    give_up: float = Param(2.0, ge=0, doc="and time lost until a new map begins", unit="s")

    state: LidarState

    def setup(self) -> None:
        """Raises ValueError for a range that holds no point."""
        if self.near >= self.far:
            raise ValueError(f"near must be less than far, got {self.near} and {self.far}")

    def initial_state(self) -> LidarState:
        return LidarState(tracker=self._new())

    def process(self, cloud: PointCloud, extrinsics: Transforms | None = None) -> Mapping[str, Message]:
        """Raises ValueError where no transform relates the cloud's frame to the body's."""
        return self._tracked(cloud, extrinsics)[0]

    def _tracked(self, cloud: PointCloud, extrinsics: Transforms | None) -> tuple[dict[str, Message], Tracked, Matrix]:
        """Returns the messages of a scan, what they say, and the LiDAR's pose (4, 4) in the body."""
        body = self.body_frame or cloud.frame
        if body != cloud.frame and extrinsics is None:
            raise ValueError(f"the cloud is in {cloud.frame!r}; extrinsics that relate it to {body!r} are missing")
        T_body_lidar = transform_between(extrinsics, cloud.frame, body)
        offsets = cloud.time_offsets
        if offsets is None and self.sweep is not None:
            offsets = self.sweep.offsets(cloud.points)
        tracked = self.state.tracker.track(cloud.points, offsets, cloud.stamp)
        self.state.counts[tracked.state.value] += 1
        self.state.counts["with a direction untold"] += len(tracked.blind) > 0
        messages: dict[str, Message] = {"status": _status(cloud.stamp, tracked)}
        if tracked.state is not Status.LOST:
            messages["odometry"] = self._odometry(cloud.stamp, body, T_body_lidar, tracked)
        return messages, tracked, T_body_lidar

    def _odometry(self, stamp: int, body: str, T_body_lidar: Matrix, tracked: Tracked) -> Odometry:
        T = T_body_lidar @ tracked.T @ invert(T_body_lidar)
        carried = adjoint(T_body_lidar)
        velocity, moving = carried @ tracked.velocity, tracked.velocity_covariance
        return Odometry.from_matrix(
            T,
            stamp=stamp,
            frame=self.odometry_frame,
            child_frame=body,
            linear=velocity[:3],
            angular=velocity[3:],
            pose_covariance=about_fixed_axes(carried @ tracked.covariance @ carried.T, T),
            twist_covariance=None if moving is None else carried @ moving @ carried.T,
        )

    def _new(self) -> LidarTracker:
        own = {name: getattr(self, name) for name in TrackerConfig.__dataclass_fields__}
        return LidarTracker(TrackerConfig(**own))


def _status(stamp: int, tracked: Tracked) -> Diagnostics:
    level = Level.WARN if len(tracked.blind) else _LEVELS.get(tracked.state, Level.OK)
    text = f"{tracked.state.value}: {tracked.reason}" if tracked.reason else tracked.state.value
    return counted_status("lidar_odometry", stamp, text, level, {"state": tracked.state.value, **tracked.counts})
