"""Monocular visual odometry: two views begin a map, its points give the pose, keyframes make it grow.

Corners are tracked by Lucas-Kanade from frame to frame. Two views of them give the first points; the pose then comes by
RANSAC PnP from the points, and keyframes triangulate new ones and are adjusted together. One camera sees no scale: the
map has an arbitrary unit until another odometry gives the camera's motion in metres, or a depth image distances.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix, Vector
from operators.monitoring.image_flaws import Watch
from operators.odometry.features import detect_corners
from operators.odometry.images import check_image
from operators.odometry.keyframes import candidates, view_distance
from operators.odometry.mono.initialisation import first_map
from operators.odometry.mono.map import MonoMap, View
from operators.odometry.mono.pose import PosedView, recognised, refined, solved
from operators.odometry.mono.ranging import MetricDepth, Ranged, RangingMemory, RangingUse, pose_at, ranged
from operators.odometry.mono.scale import Scale
from operators.odometry.mono.settings import MonoOdometryConfig
from operators.odometry.mono.tracks import MonoFrame, Tracks, from_view, observe
from operators.odometry.mono.two_view import TwoViewFailure
from operators.odometry.motion import Motion
from operators.odometry.tracking import Status, TrackResult, moved_covariance, scaled_covariance

# Variances are this much larger than residuals say: neighbouring tracks err together (calibrated against truth).
SYSTEMATIC = 30.0
RECALLED = 3  # keyframes that a lost camera compares one frame with
SHARED_BEGINNING = 0.4  # share of the first view's corners without which a new first view is taken


@dataclass(frozen=True, eq=False)
class MonoState:
    """Holds what an odometry remembers between frames; immutable, as its parts are."""

    motion: Motion | None = None
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    map: MonoMap = field(default_factory=MonoMap)
    beginning: View | None = None  # of a map: what the next views are compared with
    tracks: Tracks | None = None
    following: int = 0  # number of the next new corner
    scale: Scale = field(default_factory=Scale)
    origin: Vector = field(default_factory=lambda: np.zeros(3))  # where the map began
    ranging: RangingMemory = field(default_factory=RangingMemory)
    T_reference: Matrix | None = None  # the reference's camera at the last frame
    watch: Watch = field(default_factory=Watch)
    shape: tuple[int, ...] | None = None
    turns: int = 0  # frames that the map was searched for since the last loss


@dataclass(frozen=True, eq=False)
class MonoResult:
    """The pose of one frame in the map's unit, how well that is known to be a metre, and what a depth image said."""

    track: TrackResult
    scale: Scale
    ranged: Ranged | None = None


class MonoOdometry:
    """Tracks one camera. Deterministic: the same frames give the same bytes, in every process."""

    def __init__(self, K: Matrix, config: MonoOdometryConfig | None = None) -> None:
        if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise ValueError("MonoOdometry.K must be a finite (3, 3) matrix with positive focal lengths")
        self.K = K
        self.config = config or MonoOdometryConfig()
        self.state = MonoState()

    def track(
        self, image: NDArray[np.uint8], stamp: int, T_reference: Matrix | None = None, depth: MetricDepth | None = None
    ) -> MonoResult:
        """Returns the pose of the next frame: (H, W) or (H, W, 3) RGB uint8, nanoseconds.

        `T_reference` (4, 4), metres, is where another odometry has the camera, in any frame that does not jump.
        `depth` is of this stamp, or of one after the last frame's; its camera's K_color is that of the image as given.
        One that was given before is ignored. Raises ValueError for a wrong shape or type, a size that changed, or
        a stamp that does not increase.
        """
        frame = self._look(image, stamp, T_reference)
        if self.state.motion is None:
            self._set(motion=Motion(stamp, np.eye(4), np.zeros(6)))
        before = self.state
        result = self._go_on(frame) if before.map.begun else self._initialise(frame)
        self._set(T_reference=T_reference)
        if depth is None or depth.stamp <= before.ranging.stamp:
            return MonoResult(result, self.state.scale)
        return self._ranged(frame, result, depth, before)

    def _go_on(self, frame: MonoFrame) -> TrackResult:
        # 1. Predict the pose by the reference, or else by the motion so far.
        T_predicted = self._predict(frame)
        if frame.flaw is not None:
            return self._guessed(frame, T_predicted, str(frame.flaw))
        # 2. Follow the corners of the last image, and solve for the pose.
        assert self.state.tracks is not None
        tracks = self.state.tracks.followed(frame, T_predicted, self.state.map)
        fit = self._solve(tracks, frame.K)
        if fit is not None:
            return self._measured(frame, tracks, fit)
        # 3. Failing that, recognise the view, or begin a new map.
        found = self._recall(frame, T_predicted)
        if found is not None:
            return self._measured(frame, *found)
        return self._unmeasured(frame, tracks, T_predicted)

    @property
    def _motion(self) -> Motion:
        assert self.state.motion is not None
        return self.state.motion

    # -- the beginning -----------------------------------------------------------------------------------

    def _initialise(self, frame: MonoFrame) -> TrackResult:
        """Waits for a second view that gives points, before there is any map."""
        motion = self._motion
        if motion.stamp < frame.stamp:
            self._set(motion=Motion(frame.stamp, motion.T_world_camera, np.zeros(6)))
        if frame.flaw is not None:
            return self._result(Status.INITIALISING, str(frame.flaw), 0)
        reason = self._begin(frame, motion.T_world_camera)
        if reason is not None:
            return self._result(Status.INITIALISING, reason, 0)
        return self._result(Status.TRACKING, "the first map", len(self.state.map.numbers), keyframe=True)

    def _begin(self, frame: MonoFrame, T_world_camera: Matrix) -> str | None:
        """Compares the frame with the beginning of a map; returns why there is none yet, or None where there is."""
        state, config = self.state, self.config
        first, fewest = state.beginning, config.two_view.min_points
        tracks = None
        if first is not None and state.tracks is not None:
            tracks = state.tracks.followed(frame, state.tracks.T_world_camera, MonoMap())
            self._set(tracks=tracks)
        if first is None or tracks is None or len(tracks.numbers) < max(fewest, SHARED_BEGINNING * len(first.numbers)):
            tracks = self._replenished(Tracks(frame.gray, T_world_camera, np.zeros(0, np.int64), np.zeros((0, 2))))
            self._set(tracks=tracks, beginning=tracks.view(frame, state.covariance))
            few = len(tracks.numbers) < fewest
            return f"{len(tracks.numbers)} corners: the view has too little texture" if few else "the first view"
        begun = first_map(frame, first, tracks, state.covariance, config)
        if isinstance(begun, TwoViewFailure):
            return str(begun)
        motion = Motion(frame.stamp, begun.tracks.T_world_camera, np.zeros(6))
        origin = first.T_world_camera[:3, 3]
        self._set(
            map=begun.map, beginning=None, scale=begun.scale, origin=origin, tracks=begun.tracks, motion=motion, turns=0
        )
        return None

    # -- the steps ---------------------------------------------------------------------------------------

    def _predict(self, frame: MonoFrame) -> Matrix:
        state = self.state
        if state.scale.known and state.T_reference is not None and frame.T_reference is not None:
            T: Matrix = self._motion.T_world_camera @ invert(state.T_reference) @ frame.T_reference
            return T
        return self._motion.predict(frame.stamp, self.config.decay_s)

    def _solve(self, tracks: Tracks, K: Matrix) -> PosedView | None:
        """Returns the pose that the map's points give; `agree` is of all tracks, and true where there is no point."""
        config, (rows, known) = self.config, self.state.map.find(tracks.numbers)
        points, pixels = self.state.map.points[rows[known]], tracks.pixels[known]
        rough = solved(points, pixels, K, config.gate * config.sigma + 1.0, config.min_inliers)
        if rough is None:
            return None
        T, inliers = rough
        fit = refined(points[inliers], pixels[inliers], T, K, config.sigma, config.gate)
        if fit.count < config.min_inliers:
            return None
        off = project(transform_points(invert(fit.T_world_camera), points), K) - pixels
        agree = np.ones(len(tracks.numbers), np.bool_)
        agree[known] = (off**2).sum(axis=1) < (config.gate * config.sigma) ** 2
        return replace(fit, agree=agree)

    def _measured(self, frame: MonoFrame, tracks: Tracks, fit: PosedView) -> TrackResult:
        """Takes up a measured pose, and makes the frame a keyframe where one is due."""
        state, config = self.state, self.config
        T, newest = fit.T_world_camera, state.map.newest
        tracks = replace(tracks.only(fit.agree), T_world_camera=T)
        blind = self._motion.blind_s > config.patience_s
        step = SYSTEMATIC * np.linalg.inv(fit.information + 1e-6 * np.eye(6))
        covariance = moved_covariance(newest.covariance, newest.T_world_camera, T) + step
        self._set(
            motion=self._motion.measured(frame.stamp, T), covariance=covariance, tracks=tracks, turns=0, beginning=None
        )
        count = int(np.count_nonzero(state.map.find(tracks.numbers)[1]))
        before = int(np.count_nonzero(state.map.find(newest.numbers)[1]))
        moved = view_distance(newest.T_world_camera, T, state.map.typical_depth(T)) > config.keyframe_distance
        starved = count < max(0.6 * before, 2 * config.min_inliers)
        keyframe = moved or starved
        if keyframe:
            self._add_keyframe(frame)
        status = Status.RELOCALISED if blind else Status.TRACKING
        return self._result(status, f"{count} corners", count, keyframe)

    def _add_keyframe(self, frame: MonoFrame) -> None:
        """Remembers the frame, makes points of what it saw under a new angle, and adjusts the newest keyframes."""
        config, state = self.config, self.state
        assert state.tracks is not None
        tracks = self._replenished(state.tracks)
        grown = state.map.with_view(tracks.view(frame, state.covariance), config.keyframes, config.window)
        grown = grown.grown(frame.K, config.min_angle, config.gate * config.sigma)
        grown, wrong = grown.adjusted(frame.K, config.sigma, config.window, config.fixed, config.iterations)
        grown = grown.without(wrong)
        T = grown.newest.T_world_camera
        factor, scale = state.scale.corrected(grown.views[-config.window :], config.reference_sigma)
        self._set(
            map=grown,
            tracks=replace(tracks.only(~np.isin(tracks.numbers, wrong)), T_world_camera=T),
            motion=replace(self._motion, T_world_camera=T),
        )
        self._rescale(factor, scale)

    def _recall(self, frame: MonoFrame, T_predicted: Matrix) -> tuple[Tracks, PosedView] | None:
        """Looks for the view in the map, the nearest keyframe first and the others by turns."""
        known, config, turn = self.state.map, self.config, self.state.turns
        self._set(turns=turn + 1)
        chosen = candidates(known.views, T_predicted, 1, RECALLED - 1, turn, 1.0)
        found = recognised(frame.gray, known, chosen, frame.K)
        if found is None:
            return None
        T, view = found
        tracks = from_view(view, known, frame, T)
        fit = self._solve(tracks, frame.K)
        return None if fit is None or fit.count < config.min_inliers else (tracks, fit)

    def _unmeasured(self, frame: MonoFrame, tracks: Tracks, T_predicted: Matrix) -> TrackResult:
        """Goes on without points: by the rotation that corners hold, and with a new map after a while."""
        state, motion, config = self.state, self._motion, self.config
        assert state.tracks is not None
        T, reason = T_predicted, f"{len(tracks.numbers)} corners followed, too few agree with the map"
        if len(tracks.numbers) >= config.two_view.min_points:
            R = tracks.turn_since(state.tracks, frame.K, config.sigma)
            if R is not None:
                T = T_predicted.copy()
                T[:3, :3] = state.tracks.T_world_camera[:3, :3] @ R
                reason = f"no parallax: {len(tracks.numbers)} corners hold the rotation alone"
        elif len(detect_corners(frame.gray, config.corners)) < config.two_view.min_points:
            reason = f"{len(tracks.numbers)} corners: the view has too little texture"
        blind = motion.blind_s + (frame.stamp - motion.stamp) * 1e-9
        if blind <= config.patience_s + config.give_up_s:
            tracks = replace(tracks, T_world_camera=T)
            if len(tracks.numbers) < 0.5 * config.corners:
                tracks = self._replenished(tracks)
            self._set(tracks=tracks)
            return self._guessed(frame, T, reason)
        why = self._begin(frame, T)
        if why is None:
            spread = motion.spread(frame.stamp, config.acceleration, config.angular_acceleration)
            self._set(covariance=state.covariance + spread)
            return self._result(Status.TRACKING, "a new map; its place in the old one is unknown", 0, keyframe=True)
        return self._guessed(frame, T, f"{reason}; for a new map: {why}")

    def _guessed(self, frame: MonoFrame, T: Matrix, reason: str) -> TrackResult:
        motion, config = self._motion, self.config
        spread = motion.spread(frame.stamp, config.acceleration, config.angular_acceleration)
        covariance = moved_covariance(self.state.covariance, motion.T_world_camera, T) + spread
        self._set(motion=motion.guessed(frame.stamp, T), covariance=covariance)
        lost = self._motion.blind_s > config.patience_s
        return self._result(Status.LOST if lost else Status.PREDICTED, reason, 0)

    # -- the scale ---------------------------------------------------------------------------------------

    def _ranged(self, frame: MonoFrame, result: TrackResult, depth: MetricDepth, before: MonoState) -> MonoResult:
        """Takes the scale from a depth image; the pose is that of a result, or lies between it and the one before."""
        state = self.state
        rows, known = state.map.find(np.zeros(0, np.int64) if state.tracks is None else state.tracks.numbers)
        T = pose_at(depth.stamp, result, before.motion if before.map.begun else None)
        given = replace(depth, camera=replace(depth.camera, K_color=frame.K))
        told = ranged(given, state.map.points[rows[known]], T, state.scale, state.ranging, self.config.ranging)
        self._set(ranging=told.memory)
        self._rescale(told.factor, told.scale)
        if told.use is RangingUse.FOUND:
            result = self._result(result.status, result.reason, result.inliers, result.keyframe)
        return MonoResult(result, self.state.scale, told)

    def _rescale(self, factor: float, scale: Scale) -> None:
        """Brings the map to metres: about the camera, so that its pose stays; where they are known for the first time,
        about the place where the map began."""
        state = self.state
        if factor == 1.0 and scale == state.scale:
            return
        motion = self._motion
        T, velocity = motion.T_world_camera, motion.velocity * np.repeat([factor, 1.0], 3)
        if scale.known and not state.scale.known:
            T = T.copy()
            T[:3, 3] = state.origin + factor * (T[:3, 3] - state.origin)
            self._set(
                map=state.map.in_metres(factor, state.origin), covariance=scaled_covariance(state.covariance, factor)
            )
        elif factor != 1.0:
            self._set(map=state.map.resized(factor, T[:3, 3]))
        assert state.tracks is not None
        self._set(
            scale=scale,
            tracks=replace(state.tracks, T_world_camera=T),
            motion=replace(motion, T_world_camera=T, velocity=velocity),
        )

    # -- corners -----------------------------------------------------------------------------------------

    def _replenished(self, tracks: Tracks) -> Tracks:
        """Adds corners where the image has none."""
        more = tracks.replenished(self.config.corners, self.state.following)
        self._set(following=self.state.following + len(more.numbers) - len(tracks.numbers))
        return more

    # -- results and state -------------------------------------------------------------------------------

    def _set(self, **changes: object) -> None:
        self.state = replace(self.state, **changes)  # type: ignore[arg-type]

    def _result(self, status: Status, reason: str, inliers: int, keyframe: bool = False) -> TrackResult:
        motion = self._motion
        return TrackResult(
            motion.stamp, motion.T_world_camera.copy(), self.state.covariance.copy(), motion.velocity.copy(),
            status, reason, inliers, 0.0, keyframe,
        )  # fmt: skip

    def _look(self, image: NDArray[np.uint8], stamp: int, T_reference: Matrix | None) -> MonoFrame:
        """Checks an image and reduces it."""
        check_image("image", image)
        state = self.state
        if state.shape not in (None, image.shape[:2]):
            raise ValueError(f"image size changed from {state.shape} to {image.shape[:2]}: one camera, one size")
        if state.motion is not None and stamp <= state.motion.stamp:
            raise ValueError(f"stamp {stamp} ns does not follow the last frame's {state.motion.stamp} ns")
        frame = observe(image, stamp, self.K, self.config.image_width, state.watch, T_reference)
        self._set(watch=frame.watch, shape=image.shape[:2])
        return frame
