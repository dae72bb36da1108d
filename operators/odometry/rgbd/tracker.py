"""RGB-D visual odometry: features of a keyframe give the pose, the depth image refines it.

Corners of a keyframe are tracked into each frame and solved by RANSAC PnP; the pose is then refined over
reprojections and point-to-plane distances to the surfaces of nearby keyframes, with a motion prior for what
neither determines. A corner keeps its point from keyframe to keyframe for as long as it agrees, so what moves
slowly disagrees in the end; what moves fast stands in front of the map, and is left out of the refinement. Where
corners agree on two motions, the larger surface stands still.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix, Vector
from operators.monitoring.image_flaws import Watch
from operators.odometry.images import check_image, check_size
from operators.odometry.keyframes import RECALL_EVERY, RECALL_NEAR, RECALL_OTHERS, candidates, recall_due, view_distance
from operators.odometry.motion import Motion
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.corners import Corners, Layer, followed, renewed, with_new
from operators.odometry.rgbd.fitting import Fit, Fitter, Sighting
from operators.odometry.rgbd.frame import Frame, observe
from operators.odometry.rgbd.keyframe import Keyframe, carried
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.movers import Movers
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.relocalizer import believed, contradicted, recognised, support
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.trial import Trial, taken_back, with_trial
from operators.odometry.tracking import Status, TrackResult, moved_covariance

TOP_SPEED = 3.0  # m/s that a recognised pose may ask of the camera
INTERVALS = 5  # between the last frames, whose median is the stream's own
LATE = 1.5  # times that: a frame that comes later comes after a gap


@dataclass(eq=False)
class RgbdState:
    """Holds what an odometry remembers between frames; but for the map, its parts are immutable."""

    map: LocalMap
    motion: Motion | None = None
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    shapes: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    noise: Noise = field(default_factory=Noise)
    watch: Watch = field(default_factory=Watch)
    intervals: tuple[int, ...] = ()  # nanoseconds between the last frames, the oldest first
    recalls: int = 0  # frames that the map was searched for since the last loss
    apart_since: int | None = None  # stamp at which the newest segment began, while its place is unknown
    trials: tuple[Trial, ...] = ()  # of the places that were found last


class RgbdOdometry:
    """Tracks one camera. Deterministic: the same frames give the same bytes, in every process."""

    def __init__(
        self, camera: RgbdCamera, config: RgbdOdometryConfig | None = None, state: RgbdState | None = None
    ) -> None:
        self.camera = camera
        self.config = config or RgbdOdometryConfig()
        self._working = camera  # with K_color of the reduced image
        self.state = state or RgbdState(LocalMap(self.config.keyframes))

    def track(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> TrackResult:
        """Returns the pose of the next frame: (H, W) or (H, W, 3) RGB uint8, (H', W') float32 metres, nanoseconds.

        Raises ValueError for a wrong shape or type, a size that changed, or a stamp that does not increase.
        """
        self._check(image, depth, stamp)
        # 1. Reduce the images to what the rest works on, and see what is wrong with them.
        frame = observe(image, depth, stamp, self.camera.K_color, self.camera.K_depth, self.config, self.state.watch)
        self.state.watch = frame.watch
        self._working = replace(self.camera, K_color=frame.K_color)
        if self.state.motion is None or self.state.map.newest.empty:
            return self._start(frame)
        # 2. Predict the pose from the motion so far.
        T_predicted = self._motion.predict(stamp, self.config.decay_s)
        # 3. Track the keyframe's corners and solve for the pose.
        sighting = self._follow(frame, T_predicted)
        # 4. Refine with the depth image, against the surfaces of nearby keyframes.
        fit = self._refine(frame, sighting, T_predicted, self.state.map.newest)
        # 5. Failing that, after a gap, now and then, or in a new map, recognise the view by its descriptors.
        measured = self._measured(frame, fit)
        recalled = self._recall(frame, fit if measured else None, T_predicted)
        self.state.intervals = (*self.state.intervals, stamp - self._motion.stamp)[-INTERVALS:]
        # 6. Decide what the pose rests on, and remember it.
        if recalled is not None:
            return self._relocalised(frame, fit if measured else None, T_predicted, *recalled)
        if measured and (refuted := self._contradicted(frame, fit)):
            return self._taken_back(frame, fit, refuted)
        return self._followed(frame, fit) if measured else self._guessed(frame, fit)

    @property
    def _motion(self) -> Motion:
        assert self.state.motion is not None
        return self.state.motion

    # -- the steps ---------------------------------------------------------------------------------------

    def _start(self, frame: Frame) -> TrackResult:
        """Begins the map with a frame, or waits for one that shows anything."""
        if self.state.motion is None:
            self.state.motion = Motion(frame.stamp, np.eye(4), np.zeros(6))
        else:
            spread = self.state.motion.spread(frame.stamp, self.config.acceleration, self.config.angular_acceleration)
            self.state.covariance = self.state.covariance + spread
            self.state.motion = self.state.motion.guessed(frame.stamp, self.state.motion.T_world_camera)
            self.state.map.keyframes.clear()
        keyframe = self._keyframe(frame, None)
        self.state.map.add(keyframe)
        if keyframe.empty:
            return self._result(Status.LOST, f"nothing seen yet: {frame.flaws}", None, keyframe=False)
        self.state.motion = Motion(frame.stamp, self.state.motion.T_world_camera, np.zeros(6))
        return self._result(Status.TRACKING, "the first view", None, keyframe=True)

    def _follow(self, frame: Frame, T_predicted: Matrix) -> Sighting | None:
        """Tracks the newest keyframe's corners from where the prediction puts them."""
        keyframe = self.state.map.newest
        if frame.image_flaw is not None or len(keyframe.points) < self.config.min_inliers:
            return None
        T_color_world = self.camera.T_color_depth @ invert(T_predicted)
        guess = project(transform_points(T_color_world, keyframe.points_world), self._working.K_color)
        return followed(frame.gray, keyframe, guess, self._fitter)

    @property
    def _fitter(self) -> Fitter:
        return Fitter(self._working, self.config, self.state.noise)

    def _refine(self, frame: Frame, sighting: Sighting | None, T_predicted: Matrix, known: Keyframe) -> Fit:
        """Refines a pose against the surfaces of a keyframe's segment."""
        return self._fitter.refine(frame, sighting, self._motion, T_predicted, self.state.map, known.segment)

    def _after_gap(self, frame: Frame) -> bool:
        """Returns whether the camera was blind for so long that it may be at a place that looks alike."""
        return self._motion.blind_s + (frame.stamp - self._motion.stamp) * 1e-9 > self.config.patience_s

    def _slow(self, frame: Frame) -> bool:
        """Returns whether a frame that comes after longer than the patience is as usual for its stream."""
        intervals = self.state.intervals
        usual = len(intervals) > 1 and frame.stamp - self._motion.stamp <= LATE * float(np.median(intervals))
        return self._motion.blind_s == 0.0 and usual

    def _measured(self, frame: Frame, fit: Fit) -> bool:
        """Returns whether a fit counts: after a gap with more evidence."""
        if self._after_gap(frame) and frame.image_flaw is None and frame.depth_flaw is None:
            there = self.state.map.of_segment(self.state.map.newest.segment)
            return believed(frame, fit.T_world_camera, there, self._working, self.config.depth_noise) is not None
        return fit.inliers >= self.config.min_inliers or (fit.depth_agrees and fit.weakest_sigma < 0.05)

    def _recall(self, frame: Frame, tracked: Fit | None, T_predicted: Matrix) -> tuple[Fit, Keyframe] | None:
        """Looks for the view in the map: while nothing is tracked, once after a gap, and now and then in a new map.

        What is tracked after a gap was looked for around a prediction: a place that more speaks for takes its place.
        In a stream that is slower than the patience every frame is such a one, so it is looked for now and then.
        """
        gap, apart = self._after_gap(frame), self.state.apart_since
        slow = gap and self._slow(frame)
        steady = tracked is not None and (slow or not gap)
        if steady and not slow and apart is None:
            self.state.recalls = 0
            return None
        self.state.recalls += 1
        due = recall_due(frame.stamp, apart, self.state.recalls) or (slow and self.state.recalls % RECALL_EVERY == 0)
        if frame.image_flaw is not None or (steady and not due):
            return None
        newest = self.state.map.newest.segment
        others = self.state.map.elsewhere if steady and apart is not None else self.state.map.keyframes
        chosen = candidates(others, T_predicted, RECALL_NEAR, RECALL_OTHERS, self.state.recalls)
        for found, known in recognised(frame, chosen, self._fitter, self._motion, T_predicted, self.state.map):
            if known.segment != newest:
                return found, known
            if tracked is not None and not self._likelier(frame, found, tracked):
                continue
            if self._plausible(frame.stamp, found.T_world_camera, T_predicted):
                return found, known
        return None

    def _likelier(self, frame: Frame, found: Fit, tracked: Fit) -> bool:
        """Returns whether more speaks for one pose in the newest segment than for another."""
        there = self.state.map.of_segment(self.state.map.newest.segment)
        poses, noise = (found.T_world_camera, tracked.T_world_camera), self.config.depth_noise
        one, other = (support(frame, T, there, self._working, noise) for T in poses)
        return one > other

    def _followed(self, frame: Frame, fit: Fit) -> TrackResult:
        """Takes up a pose that was measured against the newest keyframes."""
        T, newest = fit.T_world_camera, self.state.map.newest
        if self._motion.blind_s > self.config.patience_s:
            self._try(frame.stamp, frame.stamp, self._motion.predict(frame.stamp, self.config.decay_s), T)
        status = Status.RELOCALISED if self._motion.blind_s > self.config.patience_s else Status.TRACKING
        self.state.motion = self._motion.measured(frame.stamp, T)
        self.state.noise = fit.noise
        covariance, sunk = carried(newest, T)
        self.state.covariance = covariance + fit.covariance
        keyframe = self._new_keyframe(frame, fit, sunk)
        return self._placed(status, _support(frame, fit), fit, keyframe)

    def _relocalised(
        self, frame: Frame, tracked: Fit | None, T_predicted: Matrix, found: Fit, known: Keyframe
    ) -> TrackResult:
        """Takes up a pose that was found among older keyframes, and a new map that is `tracked` meanwhile with it."""
        T, apart = found.T_world_camera, known.segment != self.state.map.newest.segment
        since = self.state.apart_since if apart and tracked is not None else None
        before = T_predicted if tracked is None else tracked.T_world_camera
        self._try(frame.stamp if since is None else since, frame.stamp, before, T)
        if apart:
            if tracked is not None:
                self.state.map.join(known, T @ invert(tracked.T_world_camera))
            else:
                self.state.map.drop_newest_segment(known)
            self.state.apart_since = None
        self.state.recalls = 0
        self.state.motion = Motion(frame.stamp, T, np.zeros(6))
        covariance, sunk = carried(known, T)
        self.state.covariance = covariance + found.covariance
        keyframe = self._new_keyframe(frame, found, sunk)
        return self._placed(Status.RELOCALISED, f"the map found again by {found.inliers} features", found, keyframe)

    def _try(self, since: int, stamp: int, T_before: Matrix, T_found: Matrix) -> None:
        """Puts a place that is found on trial: what was placed since a stamp rests on it."""
        spread = self._motion.spread(stamp, self.config.acceleration, self.config.angular_acceleration)
        covariance = moved_covariance(self.state.covariance, self._motion.T_world_camera, T_before) + spread
        running = [trial for trial in self.state.trials if not trial.over(stamp)]
        self.state.trials = with_trial(running, Trial.of(since, stamp, T_before, covariance, T_found))

    def _contradicted(self, frame: Frame, fit: Fit) -> tuple[Trial, ...]:
        """Returns the first place on trial that this view, as those just before, contradicts, and any found since."""
        if frame.flaws:
            return ()
        segment, heard = self.state.map.newest.segment, []
        for trial in self.state.trials:
            if not trial.over(frame.stamp):
                there = [k for k in self.state.map.keyframes if k.segment == segment and k.stamp < trial.since]
                says = contradicted(frame, fit.T_world_camera, there, self._working, self.config.depth_noise)
                heard.append(trial if says is None else trial.heard(says))
        self.state.trials = tuple(heard)
        first = next((k for k, trial in enumerate(heard) if trial.failed), len(heard))
        return self.state.trials[first:]

    def _taken_back(self, frame: Frame, fit: Fit, trials: tuple[Trial, ...]) -> TrackResult:
        """Takes back places and all that rests on them: a new map, at the pose as it would be without them."""
        segment = self.state.map.unused_segment
        self.state.map.part(trials, segment)
        T, self.state.covariance = taken_back(trials, frame.stamp, fit.T_world_camera, self.state.covariance)
        self.state.motion = Motion(frame.stamp, T, np.zeros(6))
        self.state.map.add(replace(self._keyframe(frame, None), segment=segment))
        self.state.apart_since, self.state.recalls = frame.stamp, 0
        self.state.trials = self.state.trials[: -len(trials)]
        reason = f"{trials[0].against} views contradict the place that was found: taken back"
        since = min(trial.since for trial in trials)
        return replace(self._result(Status.LOST, reason, fit, keyframe=True), taken_back=since)

    def _guessed(self, frame: Frame, fit: Fit) -> TrackResult:
        """Goes on by the motion so far, and begins a new map where the old one stays out of sight."""
        before, config = self._motion, self.config
        # Depth that fits still holds the directions that it measures; the prediction fills in the others.
        T = fit.T_world_camera if fit.depth_agrees else before.predict(frame.stamp, config.decay_s)
        self.state.motion = before.guessed(frame.stamp, T)
        spread = before.spread(frame.stamp, config.acceleration, config.angular_acceleration)
        self.state.covariance = moved_covariance(self.state.covariance, before.T_world_camera, T) + spread
        reason = frame.flaws or f"{fit.inliers} corners agree, and depth does not determine the pose"
        if self._motion.blind_s <= config.patience_s:
            return self._result(Status.PREDICTED, reason, fit, keyframe=False)
        if frame.image_flaw is None:
            fresh = self._keyframe(frame, None)
            if len(fresh.points) >= 2 * config.min_inliers:
                self.state.map.add(replace(fresh, segment=self.state.map.unused_segment))
                self.state.apart_since = frame.stamp
                self.state.motion = Motion(frame.stamp, T, np.zeros(6))
                return self._result(Status.LOST, "nothing here is in the map: a new one begins", fit, keyframe=True)
        return self._result(Status.LOST, reason, fit, keyframe=False)

    # -- keyframes ---------------------------------------------------------------------------------------

    def _new_keyframe(self, frame: Frame, fit: Fit, sunk: Vector) -> bool:
        """Remembers the frame, where a keyframe is due and it serves the next frames better than the newest.

        A recognised frame is due: the corners of the newest keyframe may lie elsewhere, and the next frames would be
        held by their depth alone.
        """
        newest, surface = self.state.map.newest, fit.movers.left_out_of(frame.surface)
        baseline = view_distance(newest.T_world_camera, fit.T_world_camera, surface.typical_depth)
        expected = newest.surface.coverage * fit.offered  # what meets a hole of the keyframe has not left its view
        moved = baseline > self.config.keyframe_distance or (fit.compared > 0 and fit.compared < 0.5 * expected)
        starved = fit.inliers < max(0.4 * len(newest.points), 3 * self.config.min_inliers) or fit.recognised
        better = frame.depth_flaw is None and newest.surface.coverage < 0.5 * surface.coverage
        worse = frame.depth_flaw is None and surface.coverage < 0.5 * newest.surface.coverage
        if not (moved or starved or better) or (worse and not starved):
            return False
        candidate = self._keyframe(frame, fit)
        richer = len(candidate.points) > 1.5 * fit.inliers + self.config.min_inliers
        found_again = fit.recognised and frame.depth_flaw is None and len(candidate.points) >= self.config.min_inliers
        due = found_again or richer or ((moved or better) and len(candidate.points) >= fit.inliers)
        if due:
            self.state.map.add(replace(candidate, sunk=sunk))
        return due

    def _keyframe(self, frame: Frame, fit: Fit | None) -> Keyframe:
        """Makes a keyframe of a frame: the corners that agree with its fit, and new ones."""
        T, config = self._motion.T_world_camera, self.config
        shape = frame.surface.inverse_depth.shape
        movers = fit.movers if fit else Movers.none(frame.surface.K, (shape[0], shape[1]))
        layers = self._layers(frame, T)
        none = Corners(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, np.int64))
        kept = none if fit is None else self._agreeing(fit, T)
        kept = renewed(kept, layers, config.near, config.far, config.depth_noise, self.state.noise.depth)
        found = kept
        if frame.image_flaw is None:
            found = with_new(frame.gray, kept, config.corners, layers, config.near, config.far, movers)
        segment = self.state.map.newest.segment if self.state.map.keyframes else 0
        return Keyframe(
            frame.stamp, T, self.state.covariance, frame.gray, movers.left_out_of(frame.surface),
            found.pixels, found.points, found.ages, segment, apart=fit.apart if fit else None,
        )  # fmt: skip

    def _layers(self, frame: Frame, T_world_camera: Matrix) -> list[Layer]:
        """Returns where a corner's depth is looked up: the depth image, its patches, and else the map."""
        patches = replace(self._working, K_depth=frame.surface.K)
        if frame.depth_flaw is None:
            return [(self._working, frame.depth), (patches, frame.surface.depth)]
        if not self.state.map.keyframes:
            return []
        return [(patches, self.state.map.rendered(T_world_camera, frame.surface).depth)]

    def _agreeing(self, fit: Fit, T_world_camera: Matrix) -> Corners:
        """Returns the tracked corners that fit the refined pose and do not move."""
        sighting = fit.sighting
        if sighting is None or sighting.recognised:
            return Corners(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, np.int64))
        points = transform_points(invert(T_world_camera), sighting.points_world)
        ahead = points[:, 2] > self.config.near
        color = transform_points(self.camera.T_color_depth, np.where(ahead[:, None], points, 1.0))
        error = project(color, self._working.K_color) - sighting.pixels
        agree = ahead & (np.einsum("ij,ij->i", error, error) < 9.0 * self.state.noise.pixel**2)
        agree[agree] &= ~fit.movers.hold(points[agree])
        return Corners(sighting.pixels[agree], points[agree], sighting.ages[agree])

    def _plausible(self, stamp: int, T_world_camera: Matrix, T_predicted: Matrix) -> bool:
        """Returns whether the camera can have come that far since it was last measured."""
        reach = 0.3 + TOP_SPEED * (self._motion.blind_s + (stamp - self._motion.stamp) * 1e-9)
        return bool(np.linalg.norm(T_world_camera[:3, 3] - T_predicted[:3, 3]) < reach)

    # -- results and state -------------------------------------------------------------------------------

    def _placed(self, status: Status, reason: str, fit: Fit, keyframe: bool) -> TrackResult:
        """Returns the result of a measured pose; in a new map it is not known where that is in the old one."""
        if self.state.apart_since is None:
            return self._result(status, reason, fit, keyframe)
        lost = self._motion.stamp - self.state.apart_since < self.config.give_up_s * 1e9
        reason += "; a new map, its place in the old one unknown"
        return self._result(Status.LOST if lost else status, reason, fit, keyframe)

    def _result(self, status: Status, reason: str, fit: Fit | None, keyframe: bool) -> TrackResult:
        return TrackResult(
            stamp=self._motion.stamp,
            T_world_camera=self._motion.T_world_camera.copy(),
            covariance=self.state.covariance.copy(),
            velocity=self._motion.velocity.copy(),
            status=status,
            reason=reason,
            inliers=fit.inliers if fit else 0,
            depth_inliers=fit.depth_inliers if fit else 0.0,
            keyframe=keyframe,
        )

    def _check(self, image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int) -> None:
        check_image("image", image)
        if depth.dtype != np.float32 or depth.ndim != 2:
            raise ValueError(f"depth must be (H, W) float32 metres, got {depth.shape} {depth.dtype}")
        check_size("depth", depth.shape)
        shapes = (image.shape[:2], depth.shape)
        if self.state.shapes not in (None, shapes):
            raise ValueError(
                f"image and depth sizes changed from {self.state.shapes} to {shapes}: one camera, one size"
            )
        if self.state.motion is not None and stamp <= self.state.motion.stamp:
            raise ValueError(f"stamp {stamp} ns does not follow the last frame's {self.state.motion.stamp} ns")
        self.state.shapes = shapes


def _support(frame: Frame, fit: Fit) -> str:
    """Returns what a measured pose rests on."""
    corners = f"{fit.inliers} corners" if fit.inliers else ""
    depth = "depth" if fit.compared else ""
    rests = " and ".join(part for part in (corners, depth) if part)
    others = len(fit.sighting.contrary) if fit.sighting else 0
    contest = f"{others} corners move with something else" if others else ""
    return "; ".join(part for part in (rests, contest, frame.flaws) if part)
