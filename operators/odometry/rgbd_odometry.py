"""RGB-D visual odometry: features of a keyframe give the pose, the depth image refines it.

Corners of a keyframe are tracked into each frame and solved by RANSAC PnP; the pose is then refined over reprojections
and point-to-plane distances to the surfaces of nearby keyframes, with a motion prior for what neither determines.
"""

from dataclasses import dataclass, field
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.odometry import se3
from operators.odometry.alignment import Alignment, PixelTerm, PlaneTerm, PriorTerm, Term, align
from operators.odometry.camera import Pixels, Points, RgbdCamera, project
from operators.odometry.features import Gray, OrbMatcher, detect_corners, track_corners
from operators.odometry.keyframe import Keyframe, transformed, view_distance
from operators.odometry.motion import Motion
from operators.odometry.se3 import Matrix
from operators.odometry.surface import DepthNoise, Surface, scaled_intrinsics


class Status(StrEnum):
    """What a frame's pose rests on."""

    STARTED = "started"  # the first frame: its pose is the identity
    TRACKED = "tracked"  # features, refined by depth where there is any
    DEPTH = "depth"  # depth alone
    RELOCALISED = "relocalised"  # features found again after a loss
    PREDICTED = "predicted"  # the motion model, helped by whatever direction depth still measures
    LOST = "lost"  # the motion model, for longer than patience_s
    RESTARTED = "restarted"  # given up: tracking begins anew at the predicted pose


@dataclass(frozen=True)
class RgbdOdometryConfig:
    """Settings; the defaults suit a hand-held or robot-borne structured-light or stereo depth camera at 10 to 60 Hz."""

    near: float = 0.3  # metres: smaller depths are no return
    far: float = 6.0  # metres: larger depths are no return
    depth_noise: DepthNoise = field(default_factory=DepthNoise)
    image_width: int = 320  # features work on the image reduced by whole factors to no less than this
    surface_width: int = 160  # and surfaces on the depth image likewise
    corners: int = 300
    min_inliers: int = 15
    pixel_sigma: float = 1.0  # of a track, working pixels
    refine: bool = True  # False: features only
    references: int = 2  # keyframes whose surfaces a frame is aligned with
    keyframes: int = 12  # remembered
    keyframe_distance: float = 0.15  # radians of view change that make a new keyframe
    acceleration: float = 5.0  # m/s²
    angular_acceleration: float = 20.0  # rad/s²
    decay_s: float = 0.3  # of the velocity while nothing is measured
    patience_s: float = 0.5  # of prediction until the state is lost
    give_up_s: float = 2.0  # of loss until tracking restarts

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far:
            raise ValueError(f"RgbdOdometryConfig needs 0 < near < far metres, got near={self.near}, far={self.far}")
        for name in ("image_width", "surface_width", "corners", "references", "keyframes"):
            if getattr(self, name) < 1:
                raise ValueError(f"RgbdOdometryConfig.{name} must be at least 1, got {getattr(self, name)}")
        if self.min_inliers < 6:
            raise ValueError(f"RgbdOdometryConfig.min_inliers must be at least 6, got {self.min_inliers}")


@dataclass(frozen=True, eq=False)
class TrackResult:
    """The pose of one frame."""

    stamp: int
    T_world_camera: Matrix  # (4, 4): the depth camera's optical frame in that of the first frame
    covariance: Matrix  # (6, 6) of x in T_world_camera exp(x), x = (metres, radians); grows with drift
    velocity: NDArray[np.float64]  # (6,) m/s and rad/s in the camera's axes
    inliers: int  # feature tracks that agree with the pose
    depth_inliers: float  # share of compared depth points that agree with it
    status: Status
    keyframe: bool  # whether this frame became a keyframe


@dataclass(frozen=True, eq=False)
class _Frame:
    """The working images of one frame."""

    gray: Gray
    depth: NDArray[np.float32]
    surface: Surface


@dataclass(frozen=True, eq=False)
class _Sighting:
    """World points (N, 3) and where the frame sees them (N, 2), all in agreement with a pose."""

    T_world_camera: Matrix
    points_world: Points
    pixels: Pixels


class RgbdOdometry:
    """Tracks one camera. Deterministic: the same frames give the same bytes, in every process."""

    def __init__(self, camera: RgbdCamera, config: RgbdOdometryConfig | None = None) -> None:
        self.camera = camera
        self.config = config or RgbdOdometryConfig()
        self._orb = OrbMatcher()
        self._keyframes: list[Keyframe] = []
        self._motion: Motion | None = None
        self._covariance = np.zeros((6, 6))
        self._shapes: tuple[tuple[int, ...], tuple[int, ...]] | None = None

    def track(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> TrackResult:
        """The pose of the next frame: (H, W) or (H, W, 3) RGB uint8, (H', W') float32 metres, nanoseconds.

        Raises ValueError for a wrong shape or type, a size that changed, or a stamp that does not increase.
        """
        self._check(image, depth, stamp)
        # 1. Reduce the images to what the rest works on.
        frame = self._observe(image, depth)
        if self._motion is None:
            return self._start(frame, stamp)
        # 2. Predict the pose from the motion so far.
        T_predicted = self._motion.predict(stamp, self.config.decay_s)
        # 3. Track the keyframe's corners into the frame and solve for the pose; failing that, match descriptors.
        sighting = self._follow(frame, T_predicted) or self._recognise(frame, T_predicted)
        # 4. Refine with the depth image, against the surfaces of nearby keyframes.
        T_initial = sighting.T_world_camera if sighting else T_predicted
        alignment, prior = self._refine(frame, sighting, T_initial, T_predicted, stamp)
        # 5. Decide what the pose rests on, and remember it.
        return self._conclude(frame, stamp, alignment, prior, sighting)

    # -- the steps -------------------------------------------------------------------------------------------------

    def _observe(self, image: NDArray[np.uint8], depth: NDArray[np.float32]) -> _Frame:
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        factor = max(1, gray.shape[1] // self.config.image_width)
        if factor > 1:
            gray = cv2.resize(gray, (gray.shape[1] // factor, gray.shape[0] // factor), interpolation=cv2.INTER_AREA)
        block = max(1, depth.shape[1] // self.config.surface_width)
        surface = Surface.from_depth(depth, self.camera.K_depth, self.config.near, self.config.far, block)
        self._K_color = scaled_intrinsics(self.camera.K_color, 1.0 / factor)
        self._scale = factor
        return _Frame(gray, depth, surface)
