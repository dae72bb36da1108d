"""RGB-D visual odometry as an operator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, Odometry, Transforms
from dataflow.messages.geometry import invert
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.calibration import check_calibration
from operators.geometry.depth_sensors import DEPTH_SENSOR, DepthSensor, read_depth_sensor
from operators.geometry.extrinsics import transform_between
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import DepthNoise
from operators.odometry.rgbd.tracker import RgbdOdometry, RgbdState
from operators.odometry.tracking import outputs

Calibration = tuple[CameraInfo, CameraInfo, Transforms | None]


def camera_of(image_info: CameraInfo, depth_info: CameraInfo, extrinsics: Transforms | None) -> RgbdCamera:
    """Returns the camera that calibrations describe. Raises ValueError where they describe none."""
    T_image_depth = transform_between(extrinsics, depth_info.frame, image_info.frame)
    return RgbdCamera(image_info.K, depth_info.K, invert(T_image_depth))


class RgbdOperator(Operator, abstract=True):
    """Takes the images of one RGB-D camera, whose first calibration the later ones must repeat."""

    image: In[Image] = In(doc="colour or grey, of the same stamp")
    depth: In[DepthImage] = In(doc="depth, metres")
    image_info: Sampled[CameraInfo] = Sampled(doc="calibration of the colour camera")
    depth_info: Sampled[CameraInfo] = Sampled(doc="calibration of the depth camera")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the two cameras' frames, in either direction"
    )

    odometry_frame: str = Param("odom", min_length=1, doc="name of the frame that the first depth camera defines")
    near: float = Param(0.3, gt=0, doc="smaller depths are no return", unit="m")
    far: float = Param(6.0, gt=0, doc="larger depths are no return", unit="m")
    depth_sensor: str = Param("", doc=DEPTH_SENSOR)
    depth_noise_floor: float | None = Param(
        None, gt=0, doc="standard deviation of a near depth; none is the sensor's, 0.002 without one", unit="m"
    )
    depth_noise_quadratic: float | None = Param(
        None, ge=0, doc="and what it grows by per depth squared; none is the sensor's, 0.002 without one", unit="1/m"
    )

    _camera: RgbdCamera | None = None
    _calibration: Calibration | None = None
    _sensor: DepthSensor | None = None

    def setup(self) -> None:
        """Raises FileNotFoundError or ValueError for a depth sensor that is not known."""
        self._sensor = read_depth_sensor(self.depth_sensor, self.use_file)

    @property
    def _noise(self) -> DepthNoise:
        return DepthNoise.of(self._sensor, self.depth_noise_floor, self.depth_noise_quadratic)

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew, so nothing before it can be compared with."""
        super().on_reset(input)
        self._camera = self._calibration = None

    def process(
        self,
        image: Image,
        depth: DepthImage,
        image_info: CameraInfo,
        depth_info: CameraInfo,
        extrinsics: Transforms | None = None,
    ) -> dict[str, Any]:
        """Raises ValueError where an image does not fit its calibration, that changes, or no transform fits."""
        check_calibration("image", image, image_info)
        check_calibration("depth", depth, depth_info)
        given = (image_info, depth_info, extrinsics)
        if self._camera is None:
            self._camera = camera_of(*given)
        elif self._calibration is None or any(a is not b for a, b in zip(self._calibration, given, strict=True)):
            self._camera.check_same(camera_of(*given))
        self._calibration = given
        return self._tracked(self._camera, image, depth)

    def _tracked(self, camera: RgbdCamera, image: Image, depth: DepthImage) -> dict[str, Any]:
        raise NotImplementedError


@dataclass(kw_only=True)
class State(Counts):
    """Holds what the odometry remembers, and counts frames by status."""

    odometry: RgbdState


class VisualOdometry(RgbdOperator):
    """Tracks an RGB-D camera by its features and its depth; the first frame's depth camera is the origin.

    The pose is that of the depth camera's optical frame, at every frame, also while nothing can be measured: then it
    follows the motion so far and its covariance grows. `status` names at every frame the basis of the pose: tracking,
    relocalised, predicted or lost, and why. A lost camera looks for its view among the keyframes; where it sees
    something that is not among them for longer than `patience`, it begins a new map at the predicted pose, and joins
    it to the old one when that is seen again. A place is believed where shape fixes it in every direction, or a
    pattern that fits nowhere beside it, and more than one surface looks as it did; it is taken back when what follows
    contradicts it. An image that is black or repeats the last one is not used. The images need not be registered, but
    must be free of lens distortion. Without `extrinsics` the two cameras are taken to coincide.

    Methods: corners, Shi and Tomasi, "Good features to track", 1994; RANSAC PnP; point-to-plane alignment to the
    surfaces of keyframes, Newcombe et al., "KinectFusion", 2011; views found again by SIFT, Lowe, 2004.
    """

    odometry: Out[Odometry] = Out(doc="the depth camera in the odometry frame, with covariance and velocity")
    status: Out[Diagnostics] = Out(doc="tracking, relocalised, predicted or lost, with the reason; at every frame")

    corners: int = Param(300, ge=30, doc="most corners tracked from a keyframe")
    min_inliers: int = Param(15, ge=6, doc="fewest agreeing corners that a pose may rest on")
    refine: bool = Param(True, doc="refine with the depth image; off leaves the features alone")
    keyframe_distance: float = Param(
        0.1, gt=0, doc="change of view that makes a new keyframe: angle plus baseline over depth", unit="rad"
    )
    keyframes: int = Param(30, ge=1, doc="keyframes remembered")
    patience: float = Param(0.5, ge=0, doc="time without a measurement until tracking counts as lost", unit="s")
    give_up: float = Param(2.0, ge=0, doc="time in a new map until it counts as tracking although apart", unit="s")

    state: State

    def initial_state(self) -> State:
        return State(odometry=RgbdState(LocalMap(self.keyframes)))

    def _tracked(self, camera: RgbdCamera, image: Image, depth: DepthImage) -> dict[str, Any]:
        tracker = RgbdOdometry(camera, self._config(), self.state.odometry)
        result = tracker.track(image.data, depth.data, depth.stamp)
        self.state.counts[result.status.value] += 1
        return outputs(result, self.odometry_frame, depth.frame)

    def _config(self) -> RgbdOdometryConfig:
        return RgbdOdometryConfig(
            near=self.near,
            far=self.far,
            depth_noise=self._noise,
            corners=self.corners,
            min_inliers=self.min_inliers,
            refine=self.refine,
            keyframe_distance=self.keyframe_distance,
            keyframes=self.keyframes,
            patience_s=self.patience,
            give_up_s=self.give_up,
        )
