"""The map of a monocular odometry: keyframes, the corners that they saw, and the points that some of these became."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.estimation.bundle import Sightings
from operators.geometry.pinhole import Pixels, Points, project
from operators.geometry.se3 import Matrix
from operators.odometry.features import Gray, Mask
from operators.odometry.keyframes import view_distance
from operators.odometry.mono.adjustment import adjust
from operators.odometry.mono.two_view import triangulate
from operators.odometry.tracking import scaled_covariance

Numbers = NDArray[np.int64]

HOLDING = 4  # older keyframes that hold an adjustment
SHARED = 15  # points that such a keyframe has in common with the newest


@dataclass(frozen=True, eq=False)
class View:
    """A keyframe: its image, its pose, and which corners it saw where."""

    stamp: int
    T_world_camera: Matrix
    gray: Gray
    numbers: Numbers  # (N,) ascending
    pixels: Pixels  # (N, 2)
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))  # of the pose, right perturbation
    T_reference: Matrix | None = None  # where another odometry had the camera, metres


@dataclass(frozen=True, eq=False)
class MonoMap:
    """Keyframes in order of time, and points (L, 3) in the world by the numbers (L,) of their corners, ascending.

    Without points it is the beginning of one: its last keyframe is what the next view is compared with.
    """

    views: tuple[View, ...] = ()
    numbers: Numbers = field(default_factory=lambda: np.zeros(0, np.int64))
    points: Points = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def newest(self) -> View:
        return self.views[-1]

    @property
    def begun(self) -> bool:
        """Returns whether there is anything to track."""
        return len(self.numbers) > 0

    def find(self, numbers: Numbers) -> tuple[NDArray[np.int64], Mask]:
        """Returns the rows of the points that corners became, and which of them became one."""
        return found_in(self.numbers, numbers)

    def seen_in(self, view: View) -> tuple[Numbers, Points, Pixels]:
        """Returns numbers, points in the world and pixels of all points that a view saw."""
        rows, known = self.find(view.numbers)
        return view.numbers[known], self.points[rows[known]], view.pixels[known]

    def typical_depth(self, T_world_camera: Matrix) -> float:
        """Returns the median depth of the newest keyframe's points from a pose, in the map's unit; 1 without any."""
        _, points, _ = self.seen_in(self.newest)
        z = transform_points(invert(T_world_camera), points)[:, 2]
        return float(np.median(z[z > 0])) if (z > 0).any() else 1.0

    # -- what changes it -----------------------------------------------------------------------------------

    def with_view(self, view: View, capacity: int, window: int) -> "MonoMap":
        """Adds a keyframe, forgets the old one that its neighbours make up for, and points without a view."""
        views = [*self.views, view]
        if len(views) > capacity:
            old = views[: len(views) - window]
            gaps = [
                view_distance(old[i - 1].T_world_camera, old[i + 1].T_world_camera, 1.0) for i in range(1, len(old) - 1)
            ]
            del views[1 + int(np.argmin(gaps)) if gaps else 0]
        kept = np.isin(self.numbers, np.concatenate([v.numbers for v in views]))
        return MonoMap(tuple(views), self.numbers[kept], self.points[kept])

    def with_points(self, numbers: Numbers, points: Points) -> "MonoMap":
        """Adds points; a number that has one gets another."""
        fresh = ~np.isin(self.numbers, numbers)
        all_numbers = np.concatenate([self.numbers[fresh], numbers])
        order = np.argsort(all_numbers, kind="stable")
        return replace(self, numbers=all_numbers[order], points=np.concatenate([self.points[fresh], points])[order])

    def without(self, numbers: Numbers) -> "MonoMap":
        """Removes points, with their observations in all views."""
        kept = ~np.isin(self.numbers, numbers)
        views = []
        for view in self.views:
            stays = ~np.isin(view.numbers, numbers)
            views.append(view if stays.all() else replace(view, numbers=view.numbers[stays], pixels=view.pixels[stays]))
        return MonoMap(tuple(views), self.numbers[kept], self.points[kept])

    def grown(self, K: Matrix, angle: float, error: float) -> "MonoMap":
        """Makes points of the newest keyframe's corners that an older one saw under another angle (radians)."""
        here = self.newest
        _, known = self.find(here.numbers)
        waiting = here.numbers[~known]
        pixels = here.pixels[~known]
        done = np.zeros(len(waiting), np.bool_)
        points = np.zeros((len(waiting), 3))
        for view in self.views[:-1]:  # the oldest first: its rays meet at the widest angle
            rows, seen = found_in(view.numbers, waiting)
            some = np.flatnonzero(seen & ~done)
            if not len(some):
                continue
            before = view.pixels[rows[some]]
            found, told = triangulate(view.T_world_camera, here.T_world_camera, before, pixels[some], K)
            good = (told[:, 0] > 0) & (told[:, 1] > 0) & (told[:, 2] > angle)
            for pose, seen_at in ((view.T_world_camera, before), (here.T_world_camera, pixels[some])):
                off = project(transform_points(invert(pose), found), K) - seen_at
                good &= (off**2).sum(axis=1) < error**2
            points[some[good]], done[some[good]] = found[good], True
        return self.with_points(waiting[done], points[done])

    def adjusted(self, K: Matrix, sigma: float, window: int, fixed: int, iterations: int) -> tuple["MonoMap", Numbers]:
        """Adjusts the newest keyframes and the points that two of them saw; returns the numbers that do not fit, too.

        Older keyframes that share points with the newest hold them; without any, the oldest of the window do.
        """
        chosen, fixed = self._neighbours(window, fixed)
        views = [self.views[k] for k in chosen]
        seen, numbers = self._seen_by(views)
        rows, _ = self.find(numbers)
        poses = np.array([v.T_world_camera for v in views])
        result = adjust(K, poses, self.points[rows], seen, sigma, fixed, iterations)
        points = self.points.copy()
        points[rows] = result.points
        moved = list(self.views)
        for k, T in zip(chosen[fixed:], result.poses[fixed:], strict=True):
            moved[k] = replace(self.views[k], T_world_camera=T)
        wrong = _misfits(result.squared, seen, len(numbers))
        return MonoMap(tuple(moved), self.numbers, points), numbers[wrong]

    def _neighbours(self, window: int, fixed: int) -> tuple[list[int], int]:
        """Returns which keyframes to adjust in order of time, and how many of them, the first, stay."""
        begin = max(len(self.views) - window, 0)
        here = self.newest.numbers[self.find(self.newest.numbers)[1]]
        shared = [int(np.isin(here, view.numbers).sum()) for view in self.views[:begin]]
        ranked = sorted(range(begin), key=lambda k: (-shared[k], -k))[:HOLDING]
        older = sorted(k for k in ranked if shared[k] >= SHARED)
        recent = list(range(begin, len(self.views)))
        stay = len(older) if len(older) >= 2 else len(older) + fixed
        return [*older, *recent], min(stay, len(older) + len(recent) - 1)

    def resized(self, factor: float, centre: Points) -> "MonoMap":
        """Scales the map about a place (3,)."""
        views = []
        for view in self.views:
            T = view.T_world_camera.copy()
            T[:3, 3] = centre + factor * (T[:3, 3] - centre)
            views.append(replace(view, T_world_camera=T))
        return MonoMap(tuple(views), self.numbers, centre + factor * (self.points - centre))

    def in_metres(self, factor: float, centre: Points) -> "MonoMap":
        """Scales the map about a place (3,), and its poses' covariances with it: its unit was not known before."""
        known = self.resized(factor, centre)
        views = tuple(replace(v, covariance=scaled_covariance(v.covariance, factor)) for v in known.views)
        return replace(known, views=views)

    def _seen_by(self, views: Sequence[View]) -> tuple[Sightings, Numbers]:
        """Returns the sightings of points that two of some views saw, and the numbers of these points."""
        frames = np.concatenate([np.full(len(v.numbers), k) for k, v in enumerate(views)])
        numbers = np.concatenate([v.numbers for v in views])
        pixels = np.concatenate([v.pixels for v in views])
        known = self.find(numbers)[1]
        frames, numbers, pixels = frames[known], numbers[known], pixels[known]
        unique, inverse, counts = np.unique(numbers, return_inverse=True, return_counts=True)
        often = counts >= 2
        place = np.cumsum(often) - 1
        take = often[inverse]
        return Sightings(frames[take], place[inverse[take]], pixels[take]), unique[often]


def found_in(numbers: Numbers, wanted: Numbers) -> tuple[NDArray[np.int64], Mask]:
    """Returns where ascending numbers have those wanted, and which they have."""
    if not len(numbers):
        return np.zeros(len(wanted), np.int64), np.zeros(len(wanted), np.bool_)
    rows = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
    return rows, np.asarray(numbers[rows] == wanted, np.bool_)


def _misfits(squared: NDArray[np.float64], seen: Sightings, count: int) -> Mask:
    """Returns which points are, in the mean of their sightings or in one of them, far from where they were seen."""
    capped = np.minimum(squared, 1e6)
    times = np.maximum(np.bincount(seen.points, minlength=count), 1)
    mean = np.bincount(seen.points, weights=capped, minlength=count) / times
    worst = np.zeros(count)
    np.maximum.at(worst, seen.points, capped)
    return np.asarray((mean > 9.0) | (worst > 36.0), np.bool_)
