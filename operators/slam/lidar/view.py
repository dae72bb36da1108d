"""Views that a map keeps of its places for a LiDAR, and how one is measured against others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.cloud.registration import FEWEST, Prepared, Registered, Settings, best_of, explained, failure, refine
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.odometry.lidar.fit import Fit, Prior, fit
from operators.odometry.lidar.map import PlaneMap, thinned
from operators.odometry.lidar.scan import SPARSER, Scan
from operators.odometry.lidar.search import ANY_TURN, around, places
from operators.slam.keyframe_graph import Node
from operators.slam.lidar.scan_context import Context, describe

Array = NDArray[np.float64]

PER_TURN = 0.5  # metres that a turn by a radian counts in a change of view
_SIDE, _LEVELS = 2.0, 3  # planes, as in the odometry
_ABOUT, _MOST = 2.5, 6  # metres around a view, and views there, that another is measured against
_SEARCH = 3.0  # metres to each side of a view that looks alike
_STARTS = 5  # poses found there that are refined
_OFF = (0.15, 0.05)  # metres and radians by which the planes may correct the registration
_GUESS = np.diag([0.3**-2.0] * 3 + [0.1**-2.0] * 3)  # information of where a scan is expected, which hardly counts


@dataclass(frozen=True, eq=False)
class LidarView:
    """A scan: points (N, 3), deskewed and thinned, in the sensor's frame; metres. `far` bounds its
    description, `voxel` is that of its registration."""

    points: NDArray[np.float32]
    far: float
    voxel: float

    @cached_property
    def context(self) -> Context:
        return describe(self.points.astype(np.float64), self.far)

    @cached_property
    def prepared(self) -> Prepared:
        return Prepared.of_cloud(self.points, self.voxel)


@dataclass(frozen=True, eq=False)
class LidarSight:
    """Holds how a scan was measured against those around a known one; `registered` is what the two alone say."""

    T_known_seen: Matrix
    covariance: Matrix  # (6, 6), right perturbation
    registered: Registered


@dataclass(frozen=True)
class LidarEyes:
    """Compares scans: by `judge`, and by `expected` where the map predicts the pose. `noise` is the standard
    deviation of a range, metres, and `correlation` the number of points whose errors are alike."""

    judge: Settings
    expected: Settings
    noise: float
    correlation: float
    min_inliers: float

    def distance(self, T_a: Matrix, T_b: Matrix) -> float:
        """Returns metres, and half a metre for each radian."""
        T = invert(T_a) @ T_b
        cosine = np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
        return float(np.linalg.norm(T[:3, 3]) + PER_TURN * np.arccos(cosine))

    def sight(self, nodes: Mapping[int, Node[LidarView]], known: int, seen: int, expected: bool) -> LidarSight | str:
        """Registers the two scans, and measures the pose against the planes of the scans around the known one.

        Without a predicted pose, poses around the known one are tried in all headings, and if two of them
        explain the scans as well, neither is believed.
        """
        one, other = nodes[known].view, nodes[seen].view
        assert one is not None
        assert other is not None
        if min(len(one.prepared.points), len(other.prepared.points)) < FEWEST:
            return "too few points"
        planes = _planes(nodes, known, seen)
        if expected:
            return self._near(one, other, planes, invert(nodes[known].T) @ nodes[seen].T)
        found = self._searched(one, other, planes)
        return found.reason or self._checked(self._fitted(other, planes, found.T), found)

    def _near(self, one: LidarView, other: LidarView, planes: PlaneMap, guess: Matrix) -> LidarSight | str:
        """Measures a scan that is expected near a guess; the guess stands along unconstrained directions."""
        fitted = self._fitted(other, planes, guess)
        found = explained(other.prepared, one.prepared, fitted.T, self.expected)
        if not found.reason:
            return self._checked(fitted, found)
        found = refine(other.prepared, one.prepared, guess, self.expected)
        return found.reason or self._checked(self._fitted(other, planes, found.T), found)

    def _searched(self, one: LidarView, other: LidarView, planes: PlaneMap) -> Registered:
        poses, scores = around(other.points.astype(np.float64), planes, np.eye(4), _SEARCH, ANY_TURN, 2 * self.noise)
        starts = places(poses, scores, _STARTS)
        if not starts:
            return failure("nothing of the scan lies on surfaces that were seen there")
        return best_of([refine(other.prepared, one.prepared, T, self.judge) for T in starts], self.judge.voxel)

    def _fitted(self, view: LidarView, planes: PlaneMap, guess: Matrix) -> Fit:
        points = view.points.astype(np.float64)
        scan = Scan(points, None, thinned(points, SPARSER * view.voxel), 0)
        return fit(scan, planes, Prior(guess, _GUESS), lambda _: np.zeros(6), self.noise)

    def _checked(self, fitted: Fit, found: Registered) -> LidarSight | str:
        if fitted.inliers < self.min_inliers:
            return f"{fitted.inliers:.0%} of the points on planes agree with them"
        off = se3.log(invert(found.T) @ fitted.T)
        if np.linalg.norm(off[:3]) > _OFF[0] or np.linalg.norm(off[3:]) > _OFF[1]:
            return "the planes say something else than the points"
        covariance = np.linalg.inv(fitted.information / self.correlation + _GUESS)
        return LidarSight(fitted.T, np.asarray(covariance, np.float64), found)


def _planes(nodes: Mapping[int, Node[LidarView]], known: int, seen: int) -> PlaneMap:
    """Returns the planes of the scans around a known one, in its frame; of none that was taken on the way to `seen`."""
    here, new = nodes[known], nodes[seen]
    ranked = []
    for k, node in nodes.items():
        distance = float(np.linalg.norm((node.T - here.T)[:3, 3]))
        if node.view is None or node.island != here.island or distance >= _ABOUT or abs(k - known) > 2 * _MOST:
            continue
        if node.island != new.island or new.travel - node.travel > 0.5 * (new.travel - here.travel):
            ranked.append((distance, k, node.view))
    planes = PlaneMap(_SIDE, _LEVELS)
    for _, k, view in sorted(ranked, key=lambda item: item[:2])[:_MOST]:
        T = invert(here.T) @ nodes[k].T
        planes.add(view.points @ T[:3, :3].T + T[:3, 3], 0)
    return planes
