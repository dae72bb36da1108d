"""Tracks a LiDAR scan by scan in a map built from its scans, and detects when it is lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from dataflow.operator import Remembered
from operators.cloud.deskewing import deskewed
from operators.geometry import se3
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.lidar.fit import Fit, Prior, fit
from operators.odometry.lidar.map import PlaneMap
from operators.odometry.lidar.motion import LidarMotion, as_left, as_right, corrected
from operators.odometry.lidar.scan import Scan, prepare
from operators.odometry.lidar.search import ANY_TURN, apart, around, places
from operators.odometry.tracking import Status

FEWEST = 50  # points of a scan, and half as many in planes, that a pose may rest on
_EPOCH = (1.0, 0.35)  # metres, radians: what the sensor moves until the map's new voxels count as younger
_UNSURER = 2.25  # times the variance of the last epoch: a new one begins, however little the sensor moved,
_SURE = np.diag([0.01**2] * 3 + [1e-3**2] * 3)  # and that much more
_REACH = 3.0  # metres to each side that a search for the pose covers
_BASIN = 0.5  # metres: nearer to the truth a fit needs no search
_LOST_REACH, _FARTHEST = 6.0, 20.0  # metres that a search for a lost sensor covers at most, and for a velocity: time
_TURN, _LARGEST_TURN = np.radians(4.0), np.radians(24.0)  # steps and reach of headings beside the predicted one
_START_TURN = np.radians(20.0)  # per second, of a sensor whose velocity is unknown
_STARTS, _LOST_STARTS, _FAR_STARTS = 3, 5, 12  # of which a pose is fitted
_RIVAL, _FAR_RIVAL = 0.03, 0.05  # a second place whose agreement is that near to the best one's makes a pose ambiguous


@dataclass(frozen=True)
class TrackerConfig:
    """Lengths in metres, times in seconds."""

    near: float
    far: float
    spacing: float | None
    voxel: float
    levels: int
    noise: float
    correlation: float
    acceleration: float
    angular_acceleration: float
    start_speed: float
    min_known: float
    min_inliers: float
    patience: float
    give_up: float


@dataclass(frozen=True, eq=False)
class Tracked:
    """The pose `T` (4, 4) of the sensor, covariance (6, 6) of its right perturbation, velocity (6,) in its axes.

    `blind` (K, 6) are unit twists in the sensor's axes that the scan did not constrain. `velocity_covariance` is None
    where the velocity was not measured. `points` (N, 3) are the scan's, thinned and deskewed, in the sensor's frame at
    the stamp; None where the pose or the velocity was not measured.
    """

    state: Status
    reason: str
    T: Matrix
    covariance: Matrix
    velocity: Vector
    velocity_covariance: Matrix | None
    blind: NDArray[np.float64]
    counts: Mapping[str, int]
    points: NDArray[np.float64] | None = None


class LidarTracker(Remembered):
    """Fits every scan to a map of planes, starting from constant velocity, and adds it to the map.

    Bad scans are bridged by the prediction; after `patience` the sensor is lost and looked for around where it was;
    after `give_up` a new map begins at the last pose, and the covariance holds the error of that.
    """

    _map: PlaneMap
    _motion: LidarMotion | None
    _spacing: float | None
    _epochs: list[Matrix]  # covariances, left perturbations: voxels' births index them
    _epoch_T: Matrix
    _first: Scan | None  # put into the map as it was taken: to be put right when the velocity is known
    _pruned_at: Vector
    _missed: int  # scans since the last measured pose

    def __init__(self, config: TrackerConfig) -> None:
        self._config, self._spacing = config, config.spacing
        self._map = PlaneMap(config.voxel, config.levels)
        self._motion, self._first, self._missed = None, None, 0
        self._epochs, self._epoch_T, self._pruned_at = [], np.eye(4), np.zeros(3)

    def track(self, points: NDArray[np.float32], offsets: NDArray[np.float32] | None, stamp: int) -> Tracked:
        """Takes a scan: points (N, 3) in the sensor's frame, when each was measured after the stamp, s, or None.

        Raises ValueError for a stamp that is not later than the last.
        """
        if self._motion is not None and stamp <= self._motion.stamp:
            raise ValueError(f"a scan at {stamp} does not come after the last pose, at {self._motion.stamp}")
        near, far = self._config.near, self._config.far
        scan, spacing = prepare(points, offsets, near, far, self._spacing)
        if scan.count < FEWEST:
            return self._unmeasured(scan, stamp, f"{scan.count} usable points")
        self._spacing = spacing
        if self._motion is None:
            return self._begin(scan, stamp)
        if self._motion.seconds(stamp) > self._patience(stamp) + self._config.give_up:
            return self._anew(scan, stamp)
        lost = self._motion.seconds(stamp) > self._patience(stamp)
        starts = self._starts(scan, stamp, lost)
        if self._first is not None and self._first.offsets is not None:
            fits = self._second(scan, stamp, starts)
        else:
            fits = self._fitted(scan, stamp, starts)
        far = lost or self._far(stamp)
        reason = self._doubt(fits[0], stamp, lost, far)
        if far and not reason:
            fresh = self._motion.fresh and not lost
            reason = _elsewhere(fits, _FAR_RIVAL if fresh else _RIVAL, anywhere=lost or fresh)
        if reason:
            return self._unmeasured(scan, stamp, reason)
        return self._measured(scan, stamp, fits[0], Status.RELOCALISED if lost else Status.TRACKING)

    @property
    def _last(self) -> LidarMotion:
        assert self._motion is not None
        return self._motion

    def _patience(self, stamp: int) -> float:
        """Returns the seconds without a measured pose until the sensor is lost at a stamp: two scans at least."""
        motion = self._motion
        if not self._missed or motion is None:
            return float("inf")  # no scan was bad
        return max(self._config.patience, 2.5 * motion.seconds(stamp) / (self._missed + 1))

    def _begin(self, scan: Scan, stamp: int) -> Tracked:
        self._motion = LidarMotion(stamp, np.eye(4), np.zeros(6), np.zeros((6, 6)))
        self._first = scan
        self._epochs = [np.zeros((6, 6))]
        self._map.add(scan.points, 0, np.zeros(3))
        return self._result(Status.TRACKING, "the map begins here", scan, self._motion, np.zeros((6, 6)))

    def _anew(self, scan: Scan, stamp: int) -> Tracked:
        """Begins a new map where the sensor may be."""
        T, covariance = self._blindly(stamp)
        gone = self._last.seconds(stamp)
        self._motion, self._missed = LidarMotion(stamp, T, np.zeros(6), as_left(covariance, T)), 0
        self._map = PlaneMap(self._config.voxel, self._config.levels)
        self._first, self._epochs, self._epoch_T = scan, [self._last.covariance], T
        self._map.add(scan.points @ T[:3, :3].T + T[:3, 3], 0, T[:3, 3])
        reason = f"nothing was measured for {gone:.1f} s: a new map begins here"
        return self._result(Status.LOST, reason, scan, self._motion, covariance)

    def _starts(self, scan: Scan, stamp: int, lost: bool) -> list[Matrix]:
        """Returns where to look: at the predicted pose, and around it where the sensor may be far from there."""
        T = self._last.predicted(stamp, self._patience(stamp))
        reach, turn = self._strays(stamp)
        if lost:
            unseen = self._last.seconds(stamp) - self._patience(stamp)
            turns = ANY_TURN
            reach = min(_REACH + float(np.linalg.norm(self._last.velocity[:3])) * unseen, _LOST_REACH)
        elif reach < _BASIN:
            return [T]
        else:
            turns = np.arange(-int(turn / _TURN), int(turn / _TURN) + 1) * _TURN
        best, scores = around(scan.points[scan.sample], self._map, T, reach, turns, self._config.noise)
        if not lost and not self._far(stamp):
            return [T, *best[:_STARTS]]
        return [T, *places(best, scores, _LOST_STARTS if lost else _FAR_STARTS)]

    def _strays(self, stamp: int) -> tuple[float, float]:
        """Returns how far from the prediction the sensor may be, in metres and radians, as far as is searched."""
        config, dt = self._config, self._last.seconds(stamp)
        if self._last.fresh:
            return min(config.start_speed * dt, _FARTHEST), min(_START_TURN * dt, _LARGEST_TURN)
        turn = 0.5 * config.angular_acceleration * dt**2
        return min(0.5 * config.acceleration * dt**2, _FARTHEST), min(turn, _LARGEST_TURN)

    def _far(self, stamp: int) -> bool:
        """Returns whether the sensor may be where a fit from the prediction is right by chance only."""
        return self._strays(stamp)[0] > (_REACH if self._last.fresh else _BASIN)

    def _fitted(self, scan: Scan, stamp: int, starts: list[Matrix]) -> list[Fit]:
        """Returns the pose that each start leads to, that of the most agreement first."""
        motion = self._last
        config = self._config
        spread = motion.spread(stamp, config.acceleration, config.angular_acceleration, config.start_speed)
        certain = np.asarray(np.linalg.inv(spread), np.float64)

        def velocity(T: Matrix) -> Vector:
            return motion.sweep_velocity(T, stamp)

        fits = [fit(scan, self._map, Prior(T, certain), velocity, config.noise) for T in starts]
        return sorted(fits, key=lambda found: -found.inliers * found.paired)

    def _second(self, scan: Scan, stamp: int, starts: list[Matrix]) -> list[Fit]:
        """Returns the fit of the second scan, which shows by what velocity both are to be deskewed, and its rivals.

        As they were taken, both are skewed alike, so the motion between them comes out nearly right.
        """
        motion, first = self._last, self._first
        assert first is not None
        found, *others = self._fitted(replace(scan, offsets=None), stamp, starts)
        points = deskewed(first.points, first.offsets, motion.velocity_to(found.T, stamp))
        self._map = PlaneMap(self._config.voxel, self._config.levels)
        self._map.add(points @ motion.T[:3, :3].T + motion.T[:3, 3], 0, motion.T[:3, 3])
        return [*self._fitted(scan, stamp, [found.T]), *others]

    def _doubt(self, found: Fit, stamp: int, lost: bool, far: bool) -> str:
        """Returns why a fit is not to be believed, or nothing; more is asked of one that may be `far` away."""
        config = self._config
        unsearched = lost or (self._last.fresh and self._missed > 0)  # it may be beyond all that was searched
        min_known = max(config.min_known, 0.5) if unsearched else config.min_known
        min_inliers = max(config.min_inliers, 0.7) if far else config.min_inliers
        if found.known < min_known:
            return f"{found.known:.0%} of the scan lie in mapped places"
        if found.paired < FEWEST / 2:
            return f"{found.paired} points lie on planes of the map"
        if found.inliers < min_inliers:
            return f"{found.inliers:.0%} of the points on planes agree with them"
        if not lost:
            off = se3.log(invert(self._last.predicted(stamp, self._patience(stamp))) @ found.T)
            spread = self._last.spread(stamp, config.acceleration, config.angular_acceleration, config.start_speed)
            if off @ np.linalg.solve(spread, off) > 50:
                step, turn = np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))
                return f"it would mean a jump of {step:.2f} m and {turn:.1f} degrees from the motion so far"
        return ""

    def _measured(self, scan: Scan, stamp: int, found: Fit, state: Status) -> Tracked:
        motion, config = self._last, self._config
        self._first, self._missed = None, 0
        spread = motion.spread(stamp, config.acceleration, config.angular_acceleration, config.start_speed)
        share = np.bincount(found.births, found.weights, len(self._epochs)) / found.weights.sum()
        of_map = np.tensordot(share, np.array(self._epochs), 1)
        information = found.information / config.correlation
        covariance, own = corrected(found.T, information, spread, of_map, motion.covariance)
        dt = motion.seconds(stamp)
        if state is Status.RELOCALISED:  # a way crossed unseen is no evidence on the velocity
            self._motion = LidarMotion(stamp, found.T, np.zeros(6), covariance)
            points = None
        else:
            velocity, sweep = motion.velocity_to(found.T, stamp), motion.sweep_velocity(found.T, stamp)
            self._motion = LidarMotion(stamp, found.T, velocity, covariance, False, motion.stamp, motion.T)
            points = deskewed(scan.points, scan.offsets, sweep)
            self._grow(points)
        reason = "; ".join(_told_nothing(twist) for twist in found.blind)
        counts = {"points on planes": found.paired, "agreeing, %": round(100 * found.inliers)}
        own_velocity = None if self._motion.fresh else 2 * own / dt**2
        measured = self._result(
            state, reason, scan, self._motion, as_right(covariance, found.T), own_velocity, found.blind, counts
        )
        return replace(measured, points=points)

    def _grow(self, points: NDArray[np.float64]) -> None:
        """Adds a scan's points (N, 3), seen from the pose just measured, to the map."""
        motion = self._last
        moved = se3.log(invert(self._epoch_T) @ motion.T)
        unsurer = np.linalg.eigvalsh(motion.covariance - _UNSURER * self._epochs[-1] - _SURE)[-1] > 0
        if unsurer or np.linalg.norm(moved[:3]) > _EPOCH[0] or np.linalg.norm(moved[3:]) > _EPOCH[1]:
            self._epochs.append(motion.covariance)
            self._epoch_T = motion.T
        origin = motion.T[:3, 3]
        self._map.add(points @ motion.T[:3, :3].T + origin, len(self._epochs) - 1, origin)
        if np.linalg.norm(motion.T[:3, 3] - self._pruned_at) > 0.1 * self._config.far:
            self._pruned_at = motion.T[:3, 3].copy()
            self._map.keep(self._pruned_at, 1.2 * self._config.far)

    def _unmeasured(self, scan: Scan, stamp: int, reason: str) -> Tracked:
        self._missed += 1
        if self._motion is None:
            nowhere = LidarMotion(stamp, np.eye(4), np.zeros(6), np.zeros((6, 6)))
            return self._result(Status.LOST, f"{reason}, and there is no map yet", scan, nowhere, np.zeros((6, 6)))
        T, covariance = self._blindly(stamp)
        lost = self._motion.seconds(stamp) > self._patience(stamp)
        velocity = np.zeros(6) if lost else self._motion.velocity
        there = replace(self._motion, T=T, velocity=velocity)
        return self._result(Status.LOST if lost else Status.PREDICTED, reason, scan, there, covariance)

    def _blindly(self, stamp: int) -> tuple[Matrix, Matrix]:
        """Returns the predicted pose and the covariance of its right perturbation."""
        config = self._config
        T = self._last.predicted(stamp, self._patience(stamp))
        spread = self._last.spread(stamp, config.acceleration, config.angular_acceleration, config.start_speed)
        return T, as_right(self._last.covariance, T) + spread

    def _result(
        self, state: Status, reason: str, scan: Scan, motion: LidarMotion, covariance: Matrix,
        velocity_covariance: Matrix | None = None, blind: NDArray[np.float64] | None = None,
        counts: Mapping[str, int] | None = None,
    ) -> Tracked:  # fmt: skip
        own = {"points": scan.count, "points left out": scan.unusable, "voxels": len(self._map)}
        none = np.zeros((0, 6))
        return Tracked(
            state, reason, motion.T, covariance, motion.velocity, velocity_covariance,
            none if blind is None else blind, own | dict(counts or {}),
        )  # fmt: skip


def _elsewhere(fits: list[Fit], rival: float, *, anywhere: bool) -> str:
    """Returns why a sensor may as well be elsewhere than where the first of some fits has it, or nothing.

    Where it may be `anywhere`, no prediction stands in for what the scan does not constrain.
    """
    best, *others = fits
    for twist in best.blind if anywhere else ():
        if twist[:3].any():
            return _told_nothing(twist)
    least = (1 - rival) * best.inliers * best.paired
    if any(other.inliers * other.paired > least and apart(best.T, other.T) for other in others):
        return "ambiguous: the scan lies on the map in another place as well"
    return ""


def _told_nothing(twist: Vector) -> str:
    axis = twist[:3] if twist[:3].any() else twist[3:]
    x, y, z = (0.0 if abs(c) < 5e-3 else c for c in axis * np.sign(axis[np.argmax(np.abs(axis))]))
    return f"nothing constrains {'motion along' if twist[:3].any() else 'turning about'} ({x:.2f}, {y:.2f}, {z:.2f})"
