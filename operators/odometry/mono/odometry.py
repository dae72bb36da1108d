"""Monocular visual odometry as an operator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, Odometry, Transforms
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry import se3
from operators.geometry.calibration import check_calibration
from operators.geometry.extrinsics import transform_between
from operators.geometry.se3 import Matrix
from operators.odometry.mono.ranging import MetricDepth
from operators.odometry.mono.settings import MonoOdometryConfig, RangingConfig
from operators.odometry.mono.tracker import MonoOdometry, MonoResult, MonoState
from operators.odometry.mono.two_view import TwoViewConfig
from operators.odometry.rgbd.odometry import camera_of
from operators.odometry.tracking import Status, TrackResult, outputs


@dataclass
class State(Counts):
    """Holds what the odometry remembers, and counts frames by status, depth images by use."""

    odometry: MonoState = field(default_factory=MonoState)


class MonoVisualOdometry(Operator):
    """Tracks one camera by its corners; where the camera was when the first map began is the origin.

    Two views with parallax begin a map; until then `status` is *initialising*, with the reason (the view has hardly
    changed, pure rotation, too little texture), and there is no odometry. From then on the pose of the camera's
    optical frame comes at every frame, and `status` names its basis, as VisualOdometry's does. A lost camera
    looks for its view among the keyframes; after `give_up` it begins a new map where the prediction puts it.

    One camera sees no scale. Without `scale` and `depth` the poses are in an arbitrary unit (about the depth of the
    first view), and the message shows it: its frame is `unscaled_frame`, the variances of its position are infinite,
    and it has no linear velocity. Two inputs give metres, each alone or both together:

    - `scale`, an odometry in metres of anything rigidly attached, over the ways between keyframes. Wheels are the
      simplest: their way is right to a percent or two at any speed, whereas an inertial sensor needs excitation and
      the level.
    - `depth`, an image in metres every now and then, over the points of the map that it shows: the median of what their
      depths are by what they are in the map. It may be of another camera and another rate, and need not cover the view.

    The first that gives a scale brings the map to metres and the path to `odometry_frame`, which begins where the map
    did; from then on the scale is a state with a variance that grows from keyframe to keyframe, and its corrections
    move the map about the camera, so that no pose jumps. Depth that contradicts a known scale is left out, until five
    images in succession do so alike; the way so far then counts as wrong by that factor. `status` gives the uncertainty
    of the scale and the use of each depth image, and the covariance of the position holds what is left.

    Methods: Mur-Artal et al., "ORB-SLAM", 2015 (initialisation); Strasdat et al., "Scale drift-aware large scale
    monocular SLAM", 2010.
    """

    image: In[Image] = In(doc="colour or grey, without lens distortion")
    image_info: Sampled[CameraInfo] = Sampled(doc="calibration of the camera")
    scale: Sampled[Odometry] = Sampled(
        required=False, max_age="200ms", doc="an odometry in metres, of wheels for instance, that gives the scale"
    )
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the camera on the body that `scale` poses, and the depth camera beside it"
    )
    depth: Sampled[DepthImage] = Sampled(
        required=False, doc="depth in metres that gives the scale, each image once: of an image's stamp, or between two"
    )
    depth_info: Sampled[CameraInfo] = Sampled(required=False, doc="calibration of the depth camera")
    odometry: Out[Odometry] = Out(doc="the camera, with covariance and velocity as far as the scale is known")
    status: Out[Diagnostics] = Out(
        doc="initialising, tracking, relocalised, predicted or lost, with the reason; at every frame"
    )

    odometry_frame: str = Param("odom", min_length=1, doc="name of the frame that the first camera defines")
    unscaled_frame: str = Param("odom_unscaled", min_length=1, doc="its name while its unit is unknown")
    corners: int = Param(400, ge=60, doc="most corners tracked")
    min_inliers: int = Param(20, ge=8, doc="fewest agreeing corners that a pose may rest on")
    beginning_points: int = Param(50, ge=8, doc="fewest points of a first map")
    beginning_parallax: float = Param(
        0.02, gt=0, doc="a map begins where corners move so much in the median beyond what a turn explains", unit="rad"
    )
    keyframe_distance: float = Param(
        0.08, gt=0, doc="change of view that makes a new keyframe: angle plus baseline over depth", unit="rad"
    )
    keyframes: int = Param(30, ge=8, doc="keyframes remembered")
    window: int = Param(8, ge=3, le=30, doc="keyframes adjusted together")
    patience: float = Param(0.5, ge=0, doc="time without a measurement until tracking counts as lost", unit="s")
    give_up: float = Param(3.0, ge=0, doc="time of being lost until a new map begins", unit="s")
    scale_sigma: float = Param(0.02, gt=0, doc="share by which the ways of `scale` may be wrong")
    depth_sigma: float = Param(0.01, gt=0, doc="share by which all depths of `depth` may be wrong alike")
    depth_near: float = Param(0.3, gt=0, doc="smaller depths are no return", unit="m")
    depth_far: float = Param(6.0, gt=0, doc="larger depths are no return", unit="m")
    depth_points: int = Param(15, ge=5, doc="fewest points of the map with a depth that a scale may rest on")

    state: State
    _tracker: MonoOdometry | None = None

    def process(
        self,
        image: Image,
        image_info: CameraInfo,
        scale: Odometry | None = None,
        extrinsics: Transforms | None = None,
        depth: DepthImage | None = None,
        depth_info: CameraInfo | None = None,
    ) -> dict[str, Any]:
        """Raises ValueError where an image does not fit its calibration, that changes, or `scale` poses what no
        transform relates."""
        check_calibration("image", image, image_info)
        T_reference = None if scale is None else _camera_by(scale, image, extrinsics)
        given = None if depth is None else _metric(depth, depth_info, image_info, extrinsics)
        tracker = self._tracking(image_info)
        result = tracker.track(image.data, image.stamp, T_reference, given)
        self.state.odometry = tracker.state
        self.state.counts[result.track.status.value] += 1
        if result.ranged is not None:
            self.state.counts[f"depth {result.ranged.use.value}"] += 1
        return self._told(result, image.frame)

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew, so nothing before it can be compared with."""
        super().on_reset(input)
        self._tracker = None

    def _told(self, result: MonoResult, frame: str) -> dict[str, Any]:
        track, known = result.track, result.scale.known
        told = outputs(_with_scale(result), self.odometry_frame if known else self.unscaled_frame, frame)
        if track.status is Status.INITIALISING:
            return {"status": told["status"]}
        status: Diagnostics = told["status"]
        text = f"scale known to {100 * result.scale.sigma:.0f} %" if known else "scale unknown"
        if result.ranged is not None:
            text += f", {result.ranged.text}"
        told["status"] = status.replace(messages=(f"{status.messages[0]}; {text}",))
        if not known:
            odometry: Odometry = told["odometry"]
            assert odometry.pose_covariance is not None
            covariance = odometry.pose_covariance.copy()
            covariance[:3, :], covariance[:, :3] = 0.0, 0.0
            covariance[range(3), range(3)] = np.inf
            told["odometry"] = odometry.replace(pose_covariance=covariance, linear=None)
        return told

    def _tracking(self, image_info: CameraInfo) -> MonoOdometry:
        """The tracker, made for the first calibration, which later ones must repeat."""
        if self._tracker is None:
            self._tracker = MonoOdometry(image_info.K, self._config())
            self._tracker.state = self.state.odometry
        elif not np.array_equal(self._tracker.K, image_info.K):
            raise ValueError("the calibration changed (K of image_info is another): one camera, one calibration")
        return self._tracker

    def _config(self) -> MonoOdometryConfig:
        return MonoOdometryConfig(
            two_view=TwoViewConfig(min_points=self.beginning_points, parallax=self.beginning_parallax),
            corners=self.corners,
            min_inliers=self.min_inliers,
            keyframe_distance=self.keyframe_distance,
            keyframes=max(self.keyframes, self.window),
            window=self.window,
            patience_s=self.patience,
            give_up_s=self.give_up,
            reference_sigma=self.scale_sigma,
            ranging=RangingConfig(
                near=self.depth_near, far=self.depth_far, min_points=self.depth_points, sigma=self.depth_sigma
            ),
        )


def _camera_by(odometry: Odometry, image: Image, extrinsics: Transforms | None) -> Matrix | None:
    """Returns where another odometry has the camera at an image's stamp, or None where it does not say."""
    T = odometry.matrix()
    if extrinsics is None and odometry.child_frame != image.frame:
        raise ValueError(
            f"scale poses {odometry.child_frame!r}, and extrinsics are needed for the place of {image.frame!r} on it"
        )
    if not np.isfinite(T).all():
        return None
    if odometry.linear is not None and odometry.angular is not None:
        seconds = (image.stamp - odometry.stamp) * 1e-9
        T = T @ se3.exp(np.concatenate([odometry.linear, odometry.angular]) * seconds)
    return np.asarray(T @ transform_between(extrinsics, image.frame, odometry.child_frame))


def _metric(
    depth: DepthImage, depth_info: CameraInfo | None, image_info: CameraInfo, extrinsics: Transforms | None
) -> MetricDepth:
    """Returns a depth image with its place beside the camera. Raises ValueError if that place is unknown."""
    if depth_info is None:
        raise ValueError("depth is connected, but not depth_info, without which its pixels have no rays")
    check_calibration("depth", depth, depth_info)
    return MetricDepth(depth.stamp, depth.data, camera_of(image_info, depth_info, extrinsics))


def _with_scale(result: MonoResult) -> TrackResult:
    """Returns the track with what an error of the scale does to the way from the origin."""
    track = result.track
    if not result.scale.known:
        return track
    away = track.T_world_camera[:3, :3].T @ track.T_world_camera[:3, 3]
    covariance = track.covariance.copy()
    covariance[:3, :3] += (result.scale.sigma**2 + result.scale.past**2) * np.outer(away, away)
    return replace(track, covariance=covariance)
