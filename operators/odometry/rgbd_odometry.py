"""RGB-D visual odometry: features of a keyframe give the pose, the depth image refines it.

Corners of a keyframe are tracked into each frame and solved by RANSAC PnP; the pose is then refined over
reprojections and point-to-plane distances to the surfaces of nearby keyframes, with a motion prior for what
neither determines.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import Pixels, Points, project
from operators.geometry.se3 import Matrix
from operators.odometry.alignment import PixelTerm, PlaneTerm, PriorTerm, Term, align
from operators.odometry.camera import RgbdCamera
from operators.odometry.features import Gray, OrbMatcher, detect_corners, track_corners, with_exposure_of
from operators.odometry.keyframe import Keyframe, view_distance
from operators.odometry.motion import Motion
from operators.odometry.surface import DepthNoise, Surface, scaled_intrinsics

# Share of the summed information that is believed. Neighbouring residuals err together (depth noise is smooth
# over several pixels, tracks share motion blur), so they do not average like independent draws.
PLANE_STRENGTH = 0.1
PIXEL_STRENGTH = 0.2
# Calibration, rolling shutters and unsynchronised images err alike in every residual, so no count averages it
# out: variances are this much larger than the residuals say (calibrated against truth, see the benchmark).
SYSTEMATIC = 20.0
TOP_SPEED = 3.0  # m/s that a recognised pose may ask of the camera


class Status(StrEnum):
    """Holds what a frame's pose rests on."""

    STARTED = "started"  # the first frame: its pose is the identity
    TRACKED = "tracked"  # features, refined by depth where there is any
    DEPTH = "depth"  # depth alone
    RELOCALISED = "relocalised"  # features found again after a loss
    PREDICTED = "predicted"  # the motion model, helped by whatever direction depth still measures
    LOST = "lost"  # the motion model, for longer than patience_s
    RESTARTED = "restarted"  # given up: tracking begins anew at the predicted pose


MEASURED = (Status.TRACKED, Status.DEPTH, Status.RELOCALISED)


@dataclass(frozen=True)
class RgbdOdometryConfig:
    """Settings; the defaults suit a hand-held or robot-borne depth camera at 10 to 60 Hz."""

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
    keyframe_distance: float = 0.1  # radians of view change that make a new keyframe
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
    recognised: bool  # by descriptors, so the pose may lie far from the prediction


@dataclass(frozen=True, eq=False)
class _Fit:
    """The refined pose and what supports it."""

    T_world_camera: Matrix
    information: Matrix  # (6, 6) of the measurements
    prior: Matrix  # (6, 6) information of the prediction
    inliers: int  # feature tracks
    offered: int  # depth points the frame has, times the reference surfaces
    compared: int  # of these, those that met a reference surface
    agreeing: int  # of these, those that lie on it
    recognised: bool

    @property
    def depth_inliers(self) -> float:
        return self.agreeing / self.compared if self.compared else 0.0

    @property
    def depth_agrees(self) -> bool:
        return self.compared > max(100, 0.1 * self.offered) and self.depth_inliers > 0.5

    @property
    def covariance(self) -> Matrix:
        return SYSTEMATIC * np.asarray(np.linalg.inv(self.information + self.prior), np.float64)

    @property
    def weakest_sigma(self) -> float:
        """Standard deviation, in metres or radians, along what the measurements alone determine least."""
        return float(1.0 / np.sqrt(max(np.linalg.eigvalsh(self.information)[0], 1e-12)))


@dataclass(frozen=True, eq=False)
class State:
    """Holds what an odometry remembers between frames."""

    motion: Motion | None
    covariance: Matrix
    keyframes: tuple[Keyframe, ...]
    shapes: tuple[tuple[int, ...], tuple[int, ...]] | None


class RgbdOdometry:
    """Tracks one camera. Deterministic: the same frames give the same bytes, in every process."""

    def __init__(self, camera: RgbdCamera, config: RgbdOdometryConfig | None = None) -> None:
        self.camera = camera
        self.config = config or RgbdOdometryConfig()
        self._orb = OrbMatcher()
        self._working = camera  # with K_color of the reduced image
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
        # 3. Track the keyframe's corners and solve for the pose; failing that, match descriptors.
        sighting = self._follow(frame, T_predicted) or self._recognise(frame, stamp, T_predicted)
        # 4. Refine with the depth image, against the surfaces of nearby keyframes.
        fit = self._refine(frame, stamp, sighting, T_predicted)
        # 5. Decide what the pose rests on, and remember it.
        return self._conclude(frame, stamp, fit)

    # -- the steps ---------------------------------------------------------------------------------------

    def _observe(self, image: NDArray[np.uint8], depth: NDArray[np.float32]) -> _Frame:
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        factor = max(1, gray.shape[1] // self.config.image_width)
        if factor > 1:
            height, width = gray.shape[0] // factor, gray.shape[1] // factor
            gray = cv2.resize(gray[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)
        self._working = replace(self.camera, K_color=scaled_intrinsics(self.camera.K_color, 1.0 / factor))
        block = max(1, depth.shape[1] // self.config.surface_width)
        surface = Surface.from_depth(depth, self.camera.K_depth, self.config.near, self.config.far, block)
        return _Frame(np.ascontiguousarray(gray), depth, surface)

    def _start(self, frame: _Frame, stamp: int) -> TrackResult:
        self._motion = Motion(stamp, np.eye(4), np.zeros(6))
        self._remember(self._keyframe(frame, stamp))
        return self._result(stamp, Status.STARTED, 0, 0.0, keyframe=True)

    def _follow(self, frame: _Frame, T_predicted: Matrix) -> _Sighting | None:
        """Track the newest keyframe's corners from where the prediction puts them."""
        keyframe = self._keyframes[-1]
        T_color_world = self.camera.T_color_depth @ invert(T_predicted)
        guess = project(transform_points(T_color_world, keyframe.points_world), self._working.K_color)
        gray = with_exposure_of(keyframe.gray, frame.gray)
        pixels, found = track_corners(keyframe.gray, gray, keyframe.pixels, guess)
        return self._solve(keyframe.points_world[found], pixels[found], recognised=False)

    def _recognise(self, frame: _Frame, stamp: int, T_predicted: Matrix) -> _Sighting | None:
        """Match descriptors with the keyframes whose views are likeliest."""
        pixels, descriptors = self._orb.describe(frame.gray)
        for keyframe in self._nearby(T_predicted, 3):
            pairs = self._orb.match(keyframe.orb_descriptors, descriptors)
            points_world = transform_points(keyframe.T_world_camera, keyframe.orb_points[pairs[:, 0]])
            sighting = self._solve(points_world, pixels[pairs[:, 1]], recognised=True)
            if sighting and self._plausible(stamp, sighting.T_world_camera, T_predicted):
                return sighting
        return None

    def _solve(self, points_world: Points, pixels: Pixels, recognised: bool) -> _Sighting | None:
        """RANSAC PnP; OpenCV seeds it alike at every call."""
        if len(points_world) < self.config.min_inliers:
            return None
        ok, rotation, translation, inliers = cv2.solvePnPRansac(
            points_world, pixels, self._working.K_color, None, iterationsCount=300,
            reprojectionError=3.0 * self.config.pixel_sigma, confidence=0.999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        if not ok or inliers is None or len(inliers) < self.config.min_inliers:
            return None
        T_color_world = np.eye(4)
        T_color_world[:3, :3] = cv2.Rodrigues(rotation)[0]
        T_color_world[:3, 3] = translation.ravel()
        chosen = inliers.ravel()
        T_world_camera = invert(T_color_world) @ self.camera.T_color_depth
        return _Sighting(T_world_camera, points_world[chosen], pixels[chosen], recognised)

    def _refine(self, frame: _Frame, stamp: int, sighting: _Sighting | None, T_predicted: Matrix) -> _Fit:
        assert self._motion is not None
        config = self.config
        spread = self._motion.spread(stamp, config.acceleration, config.angular_acceleration)
        prior = PriorTerm(T_predicted, np.diag(1.0 / np.diag(spread)))
        T, features = T_predicted, list[Term]()
        if sighting:
            T = sighting.T_world_camera
            features = [
                PixelTerm(
                    sighting.points_world, sighting.pixels, self._working.K_color, self.camera.T_color_depth,
                    config.pixel_sigma, PIXEL_STRENGTH,
                )
            ]  # fmt: skip
            if sighting.recognised:
                prior = PriorTerm(T, 1e-3 * np.eye(6))
        references = self._nearby(T, config.references) if config.refine else []
        for stride, gate, iterations in ((4, 0.15, 3), (2, 0.06, 4)):
            points = frame.surface.points(stride)
            surfaces = [
                PlaneTerm(points, k.surface, k.T_camera_world, config.depth_noise, gate, PLANE_STRENGTH)
                for k in references
            ]
            alignment = align(T, [*features, *surfaces], prior, iterations)
            T = alignment.T_world_camera
        depth = alignment.terms[len(features) :]
        return _Fit(
            T,
            alignment.information,
            prior.information,
            alignment.terms[0].inliers if features else 0,
            len(points) * len(depth),
            sum(part.seen for part in depth),
            sum(part.inliers for part in depth),
            bool(sighting and sighting.recognised),
        )

    def _conclude(self, frame: _Frame, stamp: int, fit: _Fit) -> TrackResult:
        assert self._motion is not None
        before, config = self._motion, self.config
        status = self._judge(fit, stamp)
        if status in MEASURED:
            T = fit.T_world_camera
            self._motion = before.measured(stamp, T)
            newest = self._keyframes[-1]
            self._covariance = moved_covariance(newest.covariance, newest.T_world_camera, T) + fit.covariance
        else:
            # Depth that fits still holds the directions that it measures; the prediction fills in the others.
            T = fit.T_world_camera if fit.depth_agrees else before.predict(stamp, config.decay_s)
            self._motion = before.guessed(stamp, T)
            spread = before.spread(stamp, config.acceleration, config.angular_acceleration)
            self._covariance = moved_covariance(self._covariance, before.T_world_camera, T) + spread
        if status is Status.RESTARTED:
            self._keyframes.clear()  # what was seen before the gap is no longer comparable
        if keyframe := self._new_keyframe(frame, stamp, status, fit):
            self._remember(keyframe)
        return self._result(stamp, status, fit.inliers, fit.depth_inliers, keyframe is not None)

    def _judge(self, fit: _Fit, stamp: int) -> Status:
        assert self._motion is not None
        if fit.inliers >= self.config.min_inliers:
            return Status.RELOCALISED if self._motion.blind_s > 0 else Status.TRACKED
        if fit.depth_agrees and fit.weakest_sigma < 0.05:
            return Status.DEPTH
        newest = self._keyframes[-1]
        if len(newest.points) < self.config.min_inliers and not (self.config.refine and newest.surface.coverage > 0.05):
            return Status.RESTARTED  # a keyframe of nothing, taken in the dark: waiting for it is in vain
        blind_s = self._motion.blind_s + (stamp - self._motion.stamp) * 1e-9
        if blind_s <= self.config.patience_s:
            return Status.PREDICTED
        return Status.LOST if blind_s <= self.config.give_up_s else Status.RESTARTED

    def _new_keyframe(self, frame: _Frame, stamp: int, status: Status, fit: _Fit) -> Keyframe | None:
        """The frame as a keyframe, where one is due and it serves the next frames better than the newest."""
        if status is Status.RESTARTED:
            return self._keyframe(frame, stamp)
        if status not in MEASURED:
            return None
        newest = self._keyframes[-1]
        baseline = view_distance(newest.T_world_camera, fit.T_world_camera, self._depth(frame.surface))
        moved = baseline > self.config.keyframe_distance or (fit.compared > 0 and fit.compared < 0.5 * fit.offered)
        starved = fit.inliers < max(0.4 * len(newest.points), 3 * self.config.min_inliers) or fit.recognised
        if not (moved or starved) or frame.surface.coverage < 0.5 * newest.surface.coverage:
            return None
        candidate = self._keyframe(frame, stamp)
        richer = len(candidate.points) > 1.5 * fit.inliers + self.config.min_inliers
        return candidate if richer or (moved and len(candidate.points) >= fit.inliers) else None

    # -- keyframes ---------------------------------------------------------------------------------------

    def _keyframe(self, frame: _Frame, stamp: int) -> Keyframe:
        """The frame, at the pose just found, with its corners and descriptors that have depth."""
        assert self._motion is not None
        corners = detect_corners(frame.gray, self.config.corners)
        points, known = self._working.depth_at(corners, frame.depth, self.config.near, self.config.far)
        orb_pixels, descriptors = self._orb.describe(frame.gray)
        orb_points, orb_known = self._working.depth_at(orb_pixels, frame.depth, self.config.near, self.config.far)
        return Keyframe(
            stamp, self._motion.T_world_camera, self._covariance, frame.gray, frame.surface,
            corners[known], points[known], orb_points[orb_known], descriptors[orb_known],
        )  # fmt: skip

    def _remember(self, keyframe: Keyframe) -> None:
        self._keyframes.append(keyframe)
        if len(self._keyframes) > self.config.keyframes:
            del self._keyframes[0]

    def _nearby(self, T_world_camera: Matrix, count: int) -> list[Keyframe]:
        """The newest keyframe, then those whose views are nearest to a pose's."""
        *older, newest = self._keyframes
        depth = self._depth(newest.surface)
        distances = [view_distance(k.T_world_camera, T_world_camera, depth) for k in older]
        ranked = sorted(range(len(older)), key=distances.__getitem__)
        return [newest, *(older[i] for i in ranked[: count - 1] if distances[i] < 0.7)]

    @staticmethod
    def _depth(surface: Surface) -> float:
        """A typical depth of a view, metres; 2 m where nothing is known."""
        known = surface.inverse_depth[surface.inverse_depth > 0]
        return float(1.0 / np.median(known)) if known.size else 2.0

    def _plausible(self, stamp: int, T_world_camera: Matrix, T_predicted: Matrix) -> bool:
        """Tells whether the camera can have come that far since it was last measured."""
        assert self._motion is not None
        reach = 0.3 + TOP_SPEED * (self._motion.blind_s + (stamp - self._motion.stamp) * 1e-9)
        return bool(np.linalg.norm(T_world_camera[:3, 3] - T_predicted[:3, 3]) < reach)

    # -- results and state -------------------------------------------------------------------------------

    def snapshot(self) -> State:
        """All that the next result depends on, as immutable values of plain arrays; it pickles."""
        return State(self._motion, self._covariance, tuple(self._keyframes), self._shapes)

    def restore(self, state: State) -> None:
        """Go on from a snapshot of an odometry with the same camera and configuration."""
        self._motion, self._covariance, self._shapes = state.motion, state.covariance, state.shapes
        self._keyframes = list(state.keyframes)

    def _result(self, stamp: int, status: Status, inliers: int, depth_inliers: float, keyframe: bool) -> TrackResult:
        assert self._motion is not None
        T, velocity = self._motion.T_world_camera.copy(), self._motion.velocity.copy()
        return TrackResult(stamp, T, self._covariance.copy(), velocity, inliers, depth_inliers, status, keyframe)

    def _check(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> None:
        if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
            raise ValueError(f"image must be (H, W) or (H, W, 3) uint8, got {image.shape} {image.dtype}")
        if depth.dtype != np.float32 or depth.ndim != 2:
            raise ValueError(f"depth must be (H, W) float32 metres, got {depth.shape} {depth.dtype}")
        for name, shape in (("image", image.shape), ("depth", depth.shape)):
            if min(shape[:2]) < 32:
                raise ValueError(f"{name} must be at least 32 x 32 pixels, got {shape}")
        shapes = (image.shape[:2], depth.shape)
        if self._shapes not in (None, shapes):
            raise ValueError(f"image and depth sizes changed from {self._shapes} to {shapes}: one camera, one size")
        if self._motion is not None and stamp <= self._motion.stamp:
            raise ValueError(f"stamp {stamp} ns does not follow the last frame's {self._motion.stamp} ns")
        self._shapes = shapes


def moved_covariance(covariance: Matrix, T_world_a: Matrix, T_world_b: Matrix) -> Matrix:
    """A pose error (6, 6) of a, right perturbation, carried along rigidly to b."""
    A = se3.adjoint(invert(T_world_b) @ T_world_a)
    return A @ covariance @ A.T
