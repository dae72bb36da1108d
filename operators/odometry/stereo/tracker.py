"""Stereo visual odometry: corners followed in time and across the pair, and a window of frames adjusted to them.

Corners are tracked by Lucas-Kanade from frame to frame and into the right image. Points of the window give the pose
by RANSAC PnP; the last frames and the points that they saw are then adjusted together, so a point is as sure as all
its sightings. Now and then a pair is kept, for a camera that was lost to find its place again.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.estimation.bundle import Sightings
from operators.geometry.pinhole import Points
from operators.geometry.se3 import Matrix
from operators.monitoring.image_flaws import Watch
from operators.odometry.features import Gray, Mask, Pixels, detect_corners, track_both_ways
from operators.odometry.images import check_image, gray_of
from operators.odometry.keyframes import RECALL_NEAR, RECALL_OTHERS, candidates, recall_due
from operators.odometry.mono.pose import solved
from operators.odometry.motion import Motion
from operators.odometry.stereo.adjustment import Offset, Past, StereoRig, adjust, fitting
from operators.odometry.stereo.map import StereoMap
from operators.odometry.stereo.relocalizer import TYPICAL, RelocalizedPose, StereoKeyframe, StereoRelocalizer, kept_pair
from operators.odometry.stereo.settings import StereoOdometryConfig
from operators.odometry.tracking import Status, TrackResult, moved_covariance

Watches = tuple[Watch, Watch]
# Variances are this much larger than residuals say: neighbouring tracks err together (calibrated against truth).
SYSTEMATIC = 500.0
GATE = 2.0  # pixels by which a corner may be off the pose
TOP_SPEED = 3.0  # m/s beyond the last speed that a pose which is recognised in the same map may ask of the camera


@dataclass(frozen=True, eq=False)
class StereoPair:
    """A rectified pair in grey at a stamp; `flaw` is the reason if it is not used."""

    stamp: int
    left: Gray
    right: Gray
    flaw: str | None
    watches: Watches  # to compare the next pair with


def observe(left: NDArray[np.uint8], right: NDArray[np.uint8], stamp: int, last: Watches) -> StereoPair:
    """Looks for flaws of two (H, W) or (H, W, 3) RGB uint8 images, such as repeating those last watched.

    Raises ValueError for a wrong shape or type.
    """
    for name, image in (("left", left), ("right", right)):
        check_image(name, image)
    if left.shape[:2] != right.shape[:2]:
        raise ValueError(f"left and right differ in size: {left.shape[:2]} and {right.shape[:2]}")
    grays = np.ascontiguousarray(gray_of(left)), np.ascontiguousarray(gray_of(right))
    none, flaws = np.zeros((1, 1), np.float32), list[str]()
    watches = Watch().seen(grays[0], none), Watch().seen(grays[1], none)
    for name, gray, watch, before in zip(("left", "right"), grays, watches, last, strict=True):
        flaw = watch.image_flaw(before, gray)
        if flaw is not None:
            flaws.append(f"{name} image {flaw}")
    return StereoPair(stamp, *grays, "; ".join(flaws) or None, watches)


@dataclass(frozen=True, eq=False)
class StereoState:
    """Holds what an odometry remembers between frames; immutable, as its parts are."""

    motion: Motion | None = None
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    left: Gray | None = None  # the last left image that was used
    watch: Watches = (Watch(), Watch())
    poses: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))  # T_world_camera of the window
    points: Points = field(default_factory=lambda: np.zeros((0, 3)))  # (M, 3) in the world
    pixels: Pixels = field(default_factory=lambda: np.zeros((0, 2)))  # (M, 2) where the last image shows them
    seen: Sightings = field(default_factory=lambda: Sightings.none(3))
    offset: Offset = field(default_factory=Offset)
    past: Past = field(default_factory=lambda: Past.none(np.zeros((0, 4, 4)), 0.0))  # of the window's poses
    map: StereoMap = field(default_factory=StereoMap)


class StereoOdometry:
    """Tracks one rectified pair. Deterministic: the same frames give the same bytes, in every process."""

    def __init__(self, rig: StereoRig, config: StereoOdometryConfig | None = None) -> None:
        self.rig = rig
        self.config = config or StereoOdometryConfig()
        self._relocalizer = StereoRelocalizer(rig)
        self.state = StereoState()

    def track(self, left: NDArray[np.uint8], right: NDArray[np.uint8], stamp: int) -> TrackResult:
        """Returns the pose of the next pair: two (H, W) or (H, W, 3) RGB uint8 images, nanoseconds.

        Raises ValueError for a wrong shape or type, a size that changed, or a stamp that does not increase.
        """
        pair = observe(left, right, stamp, self.state.watch)
        self._check(pair)
        self.state = state = replace(self.state, watch=pair.watches)
        if state.motion is None:
            self.state = replace(state, motion=Motion(stamp, np.eye(4), np.zeros(6)))
            return self._begin(pair, Status.TRACKING, "the first view")
        T_predicted = state.motion.predict(stamp, self.config.decay_s)
        T, agree, pixels, reason = None, np.zeros(0, np.bool_), state.pixels, pair.flaw or "nothing seen yet"
        if pair.flaw is None and state.left is not None:
            # 1. Follow the points from the last image, then into the right one.
            pixels, found = self._follow(state.left, pair.left, T_predicted)
            # 2. Solve for the pose; after a gap, believe it only with evidence.
            T, agree = self._solve(pixels, found, T_predicted)
            reason = f"{np.count_nonzero(found)} corners followed, too few agree"
            if T is not None and not self._believed(pair, T):
                T, reason = None, f"{np.count_nonzero(agree)} corners agree on a place that looks different"
        # 3. While the camera is lost, or in a new map, look for the view among the pairs kept.
        again = self._recall(pair, T_predicted, measured=T is not None)
        if again is not None and (T is None or self._supersedes(again, agree)):
            return self._relocalised(pair, T, again)
        return self._guessed(pair, T_predicted, reason) if T is None else self._measured(pair, T, pixels, agree, ~found)

    @property
    def _motion(self) -> Motion:
        assert self.state.motion is not None
        return self.state.motion

    # -- the steps ---------------------------------------------------------------------------------------

    def _follow(self, last: Gray, gray: Gray, T_predicted: Matrix) -> tuple[Pixels, Mask]:
        guess = self.rig.project(transform_points(invert(T_predicted), self.state.points))[:, :2]
        return track_both_ways(last, gray, self.state.pixels, guess, back=0.7)

    def _solve(self, pixels: Pixels, found: Mask, T_predicted: Matrix) -> tuple[Matrix | None, Mask]:
        chosen, agree = np.flatnonzero(found), np.zeros(len(found), np.bool_)
        solution = solved(self.state.points[chosen], pixels[chosen], self.rig.K, GATE, self.config.min_inliers)
        if solution is None:
            return None, agree
        T, inliers = solution
        agree[chosen[inliers]] = True
        return T, agree

    def _measured(
        self, pair: StereoPair, T_world_camera: Matrix, pixels: Pixels, agree: Mask, gone: Mask
    ) -> TrackResult:
        """Adds a frame to the window, adjusts it, and drops what is gone and what does not fit."""
        state, config = self.state, self.config
        kept = np.flatnonzero(agree)
        points, pixels = state.points[kept], pixels[kept]
        sightings, matched = self._across(pair, pixels, transform_points(invert(T_world_camera), points))
        left = np.flatnonzero(gone)
        past = state.past.also(self.rig, state.points[left], state.seen.of_points(left), config.sigma)
        poses, past = np.concatenate([state.poses, T_world_camera[None]]), past.with_pose(T_world_camera)
        here = np.flatnonzero(matched)
        seen = state.seen.of_points(kept).also(len(poses) - 1, here, sightings[here])
        if len(poses) > config.window:
            poses, seen, past = poses[1:], seen.without_first(), past.without_first()
        fixed = min(config.fixed, len(poses) - 1)
        adjusted = adjust(self.rig, poses, points, seen, state.offset, past, config.sigma, fixed, config.iterations)
        T = adjusted.poses[-1]
        ahead = transform_points(invert(T), adjusted.points)[:, 2] > 0.3
        good = fitting(seen, adjusted.squared, len(points)) & ahead
        misfit = max(1.0, float(np.median(adjusted.squared)) / 2.37)
        step = SYSTEMATIC * misfit * np.linalg.inv(adjusted.information + 1e-6 * np.eye(6))
        status = Status.RELOCALISED if self._lost else Status.TRACKING
        self.state = replace(
            state,
            covariance=moved_covariance(state.covariance, self._motion.T_world_camera, T) + step,
            motion=self._motion.measured(pair.stamp, T),
            left=pair.left,
            poses=adjusted.poses,
            offset=adjusted.offset,
            past=adjusted.past,
            points=adjusted.points[good],
            pixels=pixels[good],
            seen=seen.of_points(np.flatnonzero(good)),
        )
        self._replenish(pair)
        if self.state.map.due(T, config.keyframe_distance):
            self._keep(pair)
        count = int(np.count_nonzero(good))
        return self._placed(status, f"{count} corners", count, len(here) / max(len(kept), 1))

    def _guessed(self, pair: StereoPair, T: Matrix, reason: str) -> TrackResult:
        """Goes on by the motion so far, and begins a new map where the old one stays out of sight."""
        motion, config = self._motion, self.config
        spread = motion.spread(pair.stamp, config.acceleration, config.angular_acceleration)
        covariance = moved_covariance(self.state.covariance, motion.T_world_camera, T) + spread
        self.state = replace(self.state, motion=motion.guessed(pair.stamp, T), covariance=covariance)
        if not self._lost:
            return self._result(Status.PREDICTED, reason, 0, 0.0)
        if pair.flaw is None:
            return self._begin(pair, Status.LOST, f"{reason}: a new map begins")
        return self._result(Status.LOST, reason, 0, 0.0)

    def _begin(self, pair: StereoPair, status: Status, reason: str) -> TrackResult:
        """Begins the map, or a new one, at the pose so far, with a frame that shows anything."""
        if pair.flaw is not None:
            return self._result(Status.LOST, pair.flaw, 0, 0.0)
        if not self._see_anew(pair):
            return self._result(Status.LOST, f"{len(self.state.points)} corners seen by both", 0, 0.0)
        known, T = self.state.map, self.state.poses[-1]
        if known.keyframes:
            known = known.begun_anew(pair.stamp)
        else:
            depths = transform_points(invert(T), self.state.points)[:, 2]
            known = replace(known, unit=float(np.median(depths)) / TYPICAL)
        self.state = replace(self.state, map=known)
        self._keep(pair)
        return self._result(status, reason, len(self.state.points), 1.0)

    def _see_anew(self, pair: StereoPair) -> bool:
        """Begins the window at the pose so far; returns whether the pair shows enough for that."""
        state = self.state
        T, none = self._motion.T_world_camera, StereoState()
        self.state = replace(
            state,
            left=pair.left,
            poses=T[None],
            points=none.points,
            pixels=none.pixels,
            seen=none.seen,
            past=Past.none(T[None], state.offset.pixels),
        )
        self._replenish(pair)
        if len(self.state.points) < self.config.min_inliers:
            self.state = replace(self.state, left=None)
            return False
        self.state = replace(self.state, motion=Motion(pair.stamp, T, np.zeros(6)))
        return True

    # -- finding the place again -------------------------------------------------------------------------

    @property
    def _lost(self) -> bool:
        """Returns whether nothing was measured for longer than the patience."""
        return self._motion.blind_s > self.config.patience_s

    def _view(self, pair: StereoPair, T_world_camera: Matrix, segment: int) -> StereoKeyframe:
        state = self.state
        return kept_pair(
            pair.left, pair.right, pair.stamp, T_world_camera, state.covariance, state.offset.pixels, segment
        )

    def _keep(self, pair: StereoPair) -> None:
        """Keeps a pair at its pose; the first since a new map began begins its segment."""
        known = self.state.map
        begins = known.apart_since == pair.stamp
        segment = known.unused_segment if begins else known.segment
        keyframe = self._view(pair, self.state.poses[-1], segment)
        self.state = replace(self.state, map=known.with_keyframe(keyframe, self.config.keyframes))

    def _believed(self, pair: StereoPair, T_world_camera: Matrix) -> bool:
        """Returns whether a pose counts: after a gap it may be at a place that looks alike."""
        known = self.state.map
        if not self._lost or not known.keyframes:
            return True
        return self._relocalizer.believed(self._view(pair, T_world_camera, known.segment), known.keyframes, known.unit)

    def _recall(self, pair: StereoPair, T_predicted: Matrix, *, measured: bool) -> RelocalizedPose | None:
        """Looks for the view in the map: always after a gap, now and then in a new map that is tracked."""
        known = self.state.map
        if pair.flaw is not None or not (self._lost or known.apart_since is not None):
            return None
        known = replace(known, recalls=known.recalls + 1)
        self.state = replace(self.state, map=known)
        tracked = measured and not self._lost
        if tracked and not recall_due(pair.stamp, known.apart_since, known.recalls):
            return None
        others = known.elsewhere if tracked else known.keyframes
        depth = TYPICAL * known.unit
        chosen = candidates(others, T_predicted, RECALL_NEAR, RECALL_OTHERS, known.recalls, depth)
        if not chosen:
            return None
        view = self._view(pair, T_predicted, known.segment)
        for found in self._relocalizer.found(view, chosen, known.keyframes, known.unit):
            elsewhere = found.keyframe.segment != known.segment
            if elsewhere or self._plausible(pair.stamp, found.T_world_camera, T_predicted):
                return found
        return None

    def _supersedes(self, found: RelocalizedPose, agree: Mask) -> bool:
        """Returns whether a pose that was found has more support than the corners that agree on another."""
        elsewhere = found.keyframe.segment != self.state.map.segment
        return elsewhere or found.features > int(np.count_nonzero(agree))

    def _plausible(self, stamp: int, T_world_camera: Matrix, T_predicted: Matrix) -> bool:
        """Returns whether the camera can have come that far since it was last measured."""
        motion = self._motion
        speed = TOP_SPEED + float(np.linalg.norm(motion.velocity[:3]))
        reach = 0.3 + speed * (motion.blind_s + (stamp - motion.stamp) * 1e-9)
        return bool(np.linalg.norm(T_world_camera[:3, 3] - T_predicted[:3, 3]) < reach)

    def _relocalised(self, pair: StereoPair, T_tracked: Matrix | None, found: RelocalizedPose) -> TrackResult:
        """Takes up a pose that was found among the pairs kept, and a new map that is tracked meanwhile with it."""
        state, T, by = self.state, found.T_world_camera, found.keyframe
        T_known_newest = None if T_tracked is None else T @ invert(T_tracked)
        self.state = replace(
            state,
            motion=Motion(pair.stamp, T, np.zeros(6)),
            covariance=moved_covariance(by.covariance, by.T_world_camera, T) + found.covariance,
            map=state.map.placed(by, T_known_newest),
        )
        if not self._see_anew(pair):
            return self._result(Status.LOST, f"{len(self.state.points)} corners seen by both", 0, 0.0)
        reason = f"the map found again by {found.features} features"
        return self._placed(Status.RELOCALISED, reason, found.features, 1.0)

    # -- corners -----------------------------------------------------------------------------------------

    def _across(self, pair: StereoPair, pixels: Pixels, points: Points) -> tuple[NDArray[np.float64], Mask]:
        """Returns sightings (N, 3) of pixels (N, 2) with their match in the right image, and which have one."""
        guess = pixels.copy()
        guess[:, 0] -= self.rig.K[0, 0] * self.rig.baseline / np.maximum(points[:, 2], 0.3)
        ends, found = track_both_ways(pair.left, pair.right, pixels, guess, back=0.5)
        disparity = pixels[:, 0] - ends[:, 0] + self.state.offset.pixels
        found &= np.abs(ends[:, 1] - pixels[:, 1]) < self.config.row_error
        found &= disparity > self.config.min_disparity
        return np.column_stack([pixels, ends[:, 0]]), found

    def _replenish(self, pair: StereoPair) -> None:
        """Adds corners where the image has none, with their points."""
        state = self.state
        fresh = detect_corners(pair.left, self.config.corners, state.pixels)
        if not len(fresh):
            return
        known = transform_points(invert(state.poses[-1]), state.points)
        points = np.column_stack([np.zeros((len(fresh), 2)), _depth_guess(fresh, state.pixels, known)])
        sightings, found = self._across(pair, fresh, points)
        sightings = sightings[found]
        new = transform_points(state.poses[-1], self.rig.triangulate(sightings - [0.0, 0.0, state.offset.pixels]))
        first = len(state.points)
        self.state = replace(
            state,
            points=np.concatenate([state.points, new]),
            pixels=np.concatenate([state.pixels, sightings[:, :2]]),
            seen=state.seen.also(len(state.poses) - 1, np.arange(first, first + len(new)), sightings),
        )

    # -- results and state -------------------------------------------------------------------------------

    def _placed(self, status: Status, reason: str, inliers: int, matched: float) -> TrackResult:
        """Returns the result of a measured pose; in a new map it is not known where that is in the old one."""
        since = self.state.map.apart_since
        if since is None:
            return self._result(status, reason, inliers, matched)
        lost = self._motion.stamp - since < self.config.give_up_s * 1e9
        reason += "; a new map, its place in the old one unknown"
        return self._result(Status.LOST if lost else status, reason, inliers, matched)

    def _result(self, status: Status, reason: str, inliers: int, matched: float) -> TrackResult:
        motion = self._motion
        return TrackResult(
            motion.stamp, motion.T_world_camera.copy(), self.state.covariance.copy(), motion.velocity.copy(),
            status, reason, inliers, matched, status in (Status.TRACKING, Status.RELOCALISED),
        )  # fmt: skip

    def _check(self, pair: StereoPair) -> None:
        left, motion = self.state.left, self.state.motion
        if left is not None and left.shape != pair.left.shape:
            raise ValueError(f"image size changed from {left.shape} to {pair.left.shape}: one camera, one size")
        if motion is not None and pair.stamp <= motion.stamp:
            raise ValueError(f"stamp {pair.stamp} ns does not follow the last frame's {motion.stamp} ns")


def _depth_guess(pixels: Pixels, known: Pixels, points: Points) -> NDArray[np.float64]:
    """Returns a depth (N,) for pixels (N, 2): that of the nearest known one, else far away."""
    if not len(known):
        return np.full(len(pixels), 1e3)
    distance = ((pixels[:, None, :] - known[None, :, :]) ** 2).sum(axis=2)
    return np.asarray(points[distance.argmin(axis=1), 2], np.float64)
