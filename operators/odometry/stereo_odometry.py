"""Stereo visual odometry: corners followed in time and across the pair, and a window of frames adjusted to them.

Corners are tracked by Lucas-Kanade from frame to frame and into the right image. Points of the window give the pose
by RANSAC PnP; the last frames and the points that they saw are then adjusted together, so a point is as sure as all
its sightings.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.pinhole import Points
from operators.geometry.se3 import Matrix
from operators.odometry.features import Gray, Mask, Pixels, detect_corners, track_both_ways
from operators.odometry.motion import Motion
from operators.odometry.stereo_adjustment import Sightings, StereoRig, adjust
from operators.odometry.tracking import Status, TrackResult, moved_covariance
from operators.odometry.watch import Flaw, Watch

# Variances are this much larger than residuals say: neighbouring tracks err together (calibrated against truth).
SYSTEMATIC = 500.0


@dataclass(frozen=True)
class StereoOdometryConfig:
    """Settings; the defaults suit a car or a robot with a rectified pair at 10 Hz and more."""

    corners: int = 350
    min_inliers: int = 15
    window: int = 8  # frames adjusted together
    fixed: int = 1  # of these, the oldest; a second one would hold the scale of an offset that is known better by now
    iterations: int = 4
    sigma: float = 0.3  # of a sighting, pixels
    row_error: float = 1.5  # pixels by which a match may leave its row
    min_disparity: float = 1.0  # pixels: farther points tell nothing of translation
    acceleration: float = 5.0  # m/s²
    angular_acceleration: float = 2.0  # rad/s²
    decay_s: float = 1.0  # of the velocity while nothing is measured
    patience_s: float = 0.5  # of prediction until the state is lost

    def __post_init__(self) -> None:
        if self.min_inliers < 6:
            raise ValueError(f"StereoOdometryConfig.min_inliers must be at least 6, got {self.min_inliers}")
        if not 1 <= self.fixed < self.window:
            raise ValueError(
                f"StereoOdometryConfig needs 1 <= fixed < window, got fixed={self.fixed}, window={self.window}"
            )


@dataclass(frozen=True, eq=False)
class StereoState:
    """Holds what an odometry remembers between frames."""

    motion: Motion | None
    covariance: Matrix
    left: Gray | None  # the last left image that was used
    watch: tuple[Watch, Watch]
    poses: NDArray[np.float64]  # (W, 4, 4) T_world_camera of the window
    points: Points  # (M, 3) in the world
    pixels: Pixels  # (M, 2) where the last image shows them
    seen: Sightings
    offset: float = 0.0  # pixels that right columns are off by


class StereoOdometry:
    """Tracks one rectified pair. Deterministic: the same frames give the same bytes, in every process."""

    def __init__(self, rig: StereoRig, config: StereoOdometryConfig | None = None) -> None:
        self.rig = rig
        self.config = config or StereoOdometryConfig()
        self._state = _empty()

    def track(self, left: NDArray[np.uint8], right: NDArray[np.uint8], stamp: int) -> TrackResult:
        """Returns the pose of the next pair: two (H, W) or (H, W, 3) RGB uint8 images, nanoseconds.

        Raises ValueError for a wrong shape or type, a size that changed, or a stamp that does not increase.
        """
        grays = self._check(left, right, stamp)
        flaw = self._watch(*grays)
        state, config = self._state, self.config
        if state.motion is None:
            self._state = replace(state, motion=Motion(stamp, np.eye(4), np.zeros(6)))
            return self._begin(*grays, stamp, flaw, Status.TRACKING, "the first view")
        T_predicted = state.motion.predict(stamp, config.decay_s)
        if flaw is None and state.left is not None:
            # 1. Follow the points from the last image, then into the right one.
            pixels, found = self._follow(state.left, grays[0], T_predicted)
            # 2. Solve for the pose.
            T, agree = self._solve(pixels, found, T_predicted)
            if T is not None:
                return self._measured(*grays, stamp, T, pixels, agree)
            reason = f"{np.count_nonzero(found)} corners followed, too few agree"
        else:
            reason = flaw or "nothing seen yet"
        return self._guessed(*grays, stamp, T_predicted, flaw, reason)

    # -- the steps ---------------------------------------------------------------------------------------

    def _follow(self, last: Gray, gray: Gray, T_predicted: Matrix) -> tuple[Pixels, Mask]:
        guess = self.rig.project(transform_points(invert(T_predicted), self._state.points))[:, :2]
        return track_both_ways(last, gray, self._state.pixels, guess, back=0.7)

    def _solve(self, pixels: Pixels, found: Mask, T_predicted: Matrix) -> tuple[Matrix | None, Mask]:
        chosen = np.flatnonzero(found)
        agree = np.zeros(len(found), np.bool_)
        if len(chosen) < self.config.min_inliers:
            return None, agree
        ok, rotation, translation, inliers = cv2.solvePnPRansac(
            self._state.points[chosen], pixels[chosen], self.rig.K, None, iterationsCount=200,
            reprojectionError=2.0, confidence=0.999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        if not ok or inliers is None or len(inliers) < self.config.min_inliers:
            return None, agree
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
        agree[chosen[inliers.ravel()]] = True
        return invert(T), agree

    def _measured(
        self, left: Gray, right: Gray, stamp: int, T_world_camera: Matrix, pixels: Pixels, agree: Mask
    ) -> TrackResult:
        """Adds a frame to the window, adjusts it, and drops what does not fit."""
        state, config = self._state, self.config
        assert state.motion is not None
        kept = np.flatnonzero(agree)
        points, pixels = state.points[kept], pixels[kept]
        sightings, matched = self._across(left, right, pixels, transform_points(invert(T_world_camera), points))
        poses = np.concatenate([state.poses, T_world_camera[None]])
        seen = _with_points(state.seen, kept)
        here = np.flatnonzero(matched)
        seen = Sightings(
            np.concatenate([seen.frames, np.full(len(here), len(poses) - 1)]),
            np.concatenate([seen.points, here]),
            np.concatenate([seen.pixels, sightings[here]]),
        )
        if len(poses) > config.window:
            poses, seen = poses[1:], _without_first(seen)
        fixed = min(config.fixed, len(poses) - 1)
        adjusted = adjust(self.rig, poses, points, seen, state.offset, config.sigma, fixed, config.iterations)
        T = adjusted.poses[-1]
        good = _fitting(adjusted.squared, seen, len(points)) & (
            transform_points(invert(T), adjusted.points)[:, 2] > 0.3
        )
        misfit = max(1.0, float(np.median(adjusted.squared)) / 2.37)
        step = SYSTEMATIC * misfit * np.linalg.inv(adjusted.information + 1e-6 * np.eye(6))
        blind = state.motion.blind_s > config.patience_s
        self._state = replace(
            state,
            covariance=moved_covariance(state.covariance, state.motion.T_world_camera, T) + step,
            motion=state.motion.measured(stamp, T),
            left=left,
            poses=adjusted.poses,
            offset=adjusted.offset,
            points=adjusted.points[good],
            pixels=pixels[good],
            seen=_with_points(seen, np.flatnonzero(good)),
        )
        self._replenish(left, right)
        count = int(np.count_nonzero(good))
        status = Status.RELOCALISED if blind else Status.TRACKING
        return self._result(status, f"{count} corners", count, len(here) / max(len(kept), 1))

    def _guessed(self, left: Gray, right: Gray, stamp: int, T: Matrix, flaw: str | None, reason: str) -> TrackResult:
        state, config = self._state, self.config
        assert state.motion is not None
        spread = state.motion.spread(stamp, config.acceleration, config.angular_acceleration)
        covariance = moved_covariance(state.covariance, state.motion.T_world_camera, T) + spread
        self._state = replace(state, motion=state.motion.guessed(stamp, T), covariance=covariance)
        assert self._state.motion is not None
        if self._state.motion.blind_s <= config.patience_s:
            return self._result(Status.PREDICTED, reason, 0, 0.0)
        if flaw is None:
            return self._begin(left, right, stamp, flaw, Status.LOST, f"{reason}: the window begins anew")
        return self._result(Status.LOST, reason, 0, 0.0)

    def _begin(self, left: Gray, right: Gray, stamp: int, flaw: str | None, status: Status, reason: str) -> TrackResult:
        """Begins the window at the predicted pose, with a frame that shows anything."""
        assert self._state.motion is not None
        if flaw is not None:
            return self._result(Status.LOST, flaw, 0, 0.0)
        T = self._state.motion.T_world_camera
        none = _empty()
        self._state = replace(
            self._state, left=left, poses=T[None], points=none.points, pixels=none.pixels, seen=none.seen
        )
        self._replenish(left, right)
        if len(self._state.points) < self.config.min_inliers:
            self._state = replace(self._state, left=None)
            return self._result(Status.LOST, f"{len(self._state.points)} corners seen by both", 0, 0.0)
        self._state = replace(self._state, motion=Motion(stamp, T, np.zeros(6)))
        return self._result(status, reason, len(self._state.points), 1.0)

    # -- corners -----------------------------------------------------------------------------------------

    def _across(self, left: Gray, right: Gray, pixels: Pixels, points: Points) -> tuple[NDArray[np.float64], Mask]:
        """Returns sightings (N, 3) of pixels (N, 2) with their match in the right image, and which have one."""
        guess = pixels.copy()
        guess[:, 0] -= self.rig.K[0, 0] * self.rig.baseline / np.maximum(points[:, 2], 0.3)
        ends, found = track_both_ways(left, right, pixels, guess, back=0.5)
        disparity = pixels[:, 0] - ends[:, 0]
        found &= np.abs(ends[:, 1] - pixels[:, 1]) < self.config.row_error
        found &= disparity > self.config.min_disparity
        return np.column_stack([pixels, ends[:, 0]]), found

    def _replenish(self, left: Gray, right: Gray) -> None:
        """Adds corners where the image has none, with their points."""
        state = self._state
        fresh = detect_corners(left, self.config.corners, state.pixels)
        if not len(fresh):
            return
        known = transform_points(invert(state.poses[-1]), state.points)
        points = np.column_stack([np.zeros((len(fresh), 2)), _depth_guess(fresh, state.pixels, known)])
        sightings, found = self._across(left, right, fresh, points)
        sightings = sightings[found]
        new = transform_points(state.poses[-1], self.rig.triangulate(sightings - [0.0, 0.0, state.offset]))
        first = len(state.points)
        self._state = replace(
            state,
            points=np.concatenate([state.points, new]),
            pixels=np.concatenate([state.pixels, sightings[:, :2]]),
            seen=Sightings(
                np.concatenate([state.seen.frames, np.full(len(new), len(state.poses) - 1)]),
                np.concatenate([state.seen.points, np.arange(first, first + len(new))]),
                np.concatenate([state.seen.pixels, sightings]),
            ),
        )

    # -- results and state -------------------------------------------------------------------------------

    def snapshot(self) -> StereoState:
        """Returns all that the next result depends on, as immutable values of plain arrays."""
        return self._state

    def restore(self, state: StereoState) -> None:
        """Goes on from a snapshot of an odometry with the same rig and configuration."""
        self._state = state

    def _result(self, status: Status, reason: str, inliers: int, matched: float) -> TrackResult:
        motion = self._state.motion
        assert motion is not None
        return TrackResult(
            motion.stamp, motion.T_world_camera.copy(), self._state.covariance.copy(), motion.velocity.copy(),
            status, reason, inliers, matched, status in (Status.TRACKING, Status.RELOCALISED),
        )  # fmt: skip

    def _watch(self, left: Gray, right: Gray) -> str | None:
        """Returns what is wrong with the images, or None."""
        last, flaws = self._state.watch, list[str]()
        none = np.zeros((1, 1), np.float32)
        watches = []
        for name, gray, before in (("left", left, last[0]), ("right", right, last[1])):
            watch = Watch().seen(gray, none)
            flaw: Flaw | None = watch.image_flaw(before, gray)
            watches.append(watch)
            if flaw is not None:
                flaws.append(f"{name} image {flaw}")
        self._state = replace(self._state, watch=(watches[0], watches[1]))
        return "; ".join(flaws) or None

    def _check(self, left: NDArray[np.uint8], right: NDArray[np.uint8], stamp: int) -> tuple[Gray, Gray]:
        for name, image in (("left", left), ("right", right)):
            if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
                raise ValueError(f"{name} must be (H, W) or (H, W, 3) uint8, got {image.shape} {image.dtype}")
            if min(image.shape[:2]) < 32:
                raise ValueError(f"{name} must be at least 32 x 32 pixels, got {image.shape}")
        if left.shape[:2] != right.shape[:2]:
            raise ValueError(f"left and right differ in size: {left.shape[:2]} and {right.shape[:2]}")
        state = self._state
        if state.left is not None and state.left.shape != left.shape[:2]:
            raise ValueError(f"image size changed from {state.left.shape} to {left.shape[:2]}: one camera, one size")
        if state.motion is not None and stamp <= state.motion.stamp:
            raise ValueError(f"stamp {stamp} ns does not follow the last frame's {state.motion.stamp} ns")
        return _gray(left), _gray(right)


def _empty() -> StereoState:
    nothing = Sightings(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    return StereoState(
        None,
        np.zeros((6, 6)),
        None,
        (Watch(), Watch()),
        np.zeros((0, 4, 4)),
        np.zeros((0, 3)),
        np.zeros((0, 2)),
        nothing,
    )


def _gray(image: NDArray[np.uint8]) -> Gray:
    gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    return np.ascontiguousarray(gray)


def _with_points(seen: Sightings, kept: NDArray[np.int64]) -> Sightings:
    """Returns the sightings of the points kept, numbered anew."""
    number = np.full(max(int(seen.points.max(initial=-1)), int(kept.max(initial=-1))) + 1, -1, np.int64)
    number[kept] = np.arange(len(kept))
    there = number[seen.points] >= 0
    return Sightings(seen.frames[there], number[seen.points[there]], seen.pixels[there])


def _without_first(seen: Sightings) -> Sightings:
    """Returns the sightings of all frames but the first."""
    later = seen.frames > 0
    return Sightings(seen.frames[later] - 1, seen.points[later], seen.pixels[later])


def _fitting(squared: NDArray[np.float64], seen: Sightings, count: int) -> Mask:
    """Returns which points are seen, and in the median of their sightings where they should be."""
    worst = np.zeros(count)
    times = np.bincount(seen.points, minlength=count)
    np.add.at(worst, seen.points, squared)
    return np.asarray((times > 0) & (worst < 12.0 * np.maximum(times, 1)), np.bool_)


def _depth_guess(pixels: Pixels, known: Pixels, points: Points) -> NDArray[np.float64]:
    """Returns a depth (N,) for pixels (N, 2): that of the nearest known one, else far away."""
    if not len(known):
        return np.full(len(pixels), 1e3)
    distance = ((pixels[:, None, :] - known[None, :, :]) ** 2).sum(axis=2)
    return np.asarray(points[distance.argmin(axis=1), 2], np.float64)
