"""Stereo visual odometry as an operator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dataflow.messages import CameraInfo, Diagnostics, Image, Odometry
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.calibration import check_calibration
from operators.geometry.stereo import rectified_pair
from operators.odometry.stereo.adjustment import StereoRig
from operators.odometry.stereo.settings import StereoOdometryConfig
from operators.odometry.stereo.tracker import StereoOdometry, StereoState
from operators.odometry.tracking import outputs


@dataclass
class State(Counts):
    """Holds what the odometry remembers, and counts frames by status."""

    odometry: StereoState = field(default_factory=StereoState)


class StereoVisualOdometry(Operator):
    """Tracks a rectified stereo pair by its corners; the first left camera is the origin.

    The pose is that of the left camera's optical frame, at every frame; `status` names its basis, as
    VisualOdometry's does. The images must be rectified: rows of the two correspond. A constant error of the
    disparities, as an imperfect rectification leaves it, is estimated on the way.

    Now and then a pair is kept. After a gap longer than `patience` a pose counts only if shape and brightness of what
    the view and pairs kept both see agree with it. Where corners cannot be followed across the gap, the view is looked
    for among these pairs; one that is not found begins a new map at the predicted pose, which is lost, for `give_up`,
    and then tracked although its place is unknown, until a view of the old map puts it there.

    Methods: Lucas and Kanade, "An iterative image registration technique", 1981, in time and across the pair; RANSAC
    PnP; a window of frames adjusted as in Triggs et al., "Bundle adjustment, a modern synthesis", 2000. Views are found
    again as VisualOdometry's are (Lowe's SIFT, a clique of pairs), with depth by semi-global matching.
    """

    left: In[Image] = In(doc="left image, rectified, grey or colour")
    right: In[Image] = In(doc="right image of the same stamp")
    left_info: Sampled[CameraInfo] = Sampled(doc="calibration of the left camera")
    right_info: Sampled[CameraInfo] = Sampled(doc="calibration of the right camera; P holds the baseline")
    odometry: Out[Odometry] = Out(doc="the left camera in the odometry frame, with covariance and velocity")
    status: Out[Diagnostics] = Out(doc="tracking, relocalised, predicted or lost, with the reason; at every frame")

    odometry_frame: str = Param("odom", min_length=1, doc="name of the frame that the first left camera defines")
    corners: int = Param(350, ge=50, doc="most corners followed")
    min_inliers: int = Param(15, ge=6, doc="fewest agreeing corners that a pose may rest on")
    window: int = Param(8, ge=3, le=30, doc="frames adjusted together")
    patience: float = Param(0.5, ge=0, doc="time without a measurement until tracking counts as lost", unit="s")
    give_up: float = Param(2.0, ge=0, doc="time in a new map until it counts as tracking although apart", unit="s")
    keyframes: int = Param(30, ge=1, doc="pairs kept to find the place again")

    state: State
    _tracker: StereoOdometry | None = None
    _calibration: tuple[CameraInfo, CameraInfo] | None = None

    def process(self, left: Image, right: Image, left_info: CameraInfo, right_info: CameraInfo) -> dict[str, Any]:
        """Raises ValueError where an image does not fit its calibration, that changes, or holds no baseline."""
        check_calibration("left", left, left_info)
        check_calibration("right", right, right_info)
        tracker = self._tracking(left_info, right_info)
        result = tracker.track(left.data, right.data, left.stamp)
        self.state.odometry = tracker.state
        self.state.counts[result.status.value] += 1
        return outputs(result, self.odometry_frame, left.frame)

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew, so nothing before it can be compared with."""
        super().on_reset(input)
        self._tracker = self._calibration = None

    def _tracking(self, left_info: CameraInfo, right_info: CameraInfo) -> StereoOdometry:
        """The tracker, made for the first calibration, which later ones must repeat."""
        given = (left_info, right_info)
        if self._tracker is None:
            config = StereoOdometryConfig(
                corners=self.corners,
                min_inliers=self.min_inliers,
                window=self.window,
                patience_s=self.patience,
                give_up_s=self.give_up,
                keyframes=self.keyframes,
            )
            self._tracker = StereoOdometry(rig_of(left_info, right_info), config)
            self._tracker.state = self.state.odometry
        elif self._calibration is None or any(a is not b for a, b in zip(self._calibration, given, strict=True)):
            self._tracker.rig.check_same(rig_of(*given))
        self._calibration = given
        return self._tracker


def rig_of(left: CameraInfo, right: CameraInfo) -> StereoRig:
    """Returns the rig that two calibrations describe. Raises ValueError where they are no rectified pair."""
    return StereoRig(*rectified_pair(left, right))
