"""A map of RGB-D views whose poses are corrected when a camera comes back to where it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry.se3 import Matrix
from operators.odometry.keyframes import view_distance
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.tracking import moved_covariance
from operators.slam.keyframe_graph import KeyframeGraph, Node
from operators.slam.place_graph import WINDOW, PlaceGraph
from operators.slam.sensor_model import Eyes, KeyframeResult, PlaceSettings, Sighting
from operators.slam.visual.bundle import adjust_newest
from operators.slam.visual.map_points import MapPoints
from operators.slam.visual.place_index import PlaceIndex
from operators.slam.visual.view import Judge, View, ViewMatch, sight

DRIFT = np.diag([0.002**2] * 3 + [0.001**2] * 3)  # what odometry may be off besides: it errs more where things move
LEAST = np.diag([0.0005**2] * 3 + [0.0003**2] * 3)  # of a sight: calibration errs alike in all


@dataclass(frozen=True)
class GraphSettings(PlaceSettings):
    """Settings of a visual map; angles are of view: rotation plus baseline over depth, radians."""

    spacing: float = 0.2
    travel: float = 1.5
    reach: float = 0.7
    same: float = 0.12
    aside: float = 0.6
    beside: int = 2
    near: int = 2
    alike: int = 2
    searched: int = 4
    likeness: float = 0.01
    least: Matrix = field(default_factory=LEAST.copy)
    judge: Judge = field(default_factory=Judge)


@dataclass(frozen=True, eq=False)
class CameraEyes:
    """Compares views by features and depth; `depth` is typical of what the newest one sees, metres."""

    fitter: Fitter
    judge: Judge
    depth: float

    def distance(self, T_a: Matrix, T_b: Matrix) -> float:
        return view_distance(T_a, T_b, self.depth)

    def sight(self, nodes: Mapping[int, Node[View]], known: int, seen: int, expected: bool) -> ViewMatch | str:
        """Features place a view; where they are too few, it is looked for where the map expects it."""
        one, other = nodes[known].view, nodes[seen].view
        assert one is not None
        assert other is not None
        T_expected = invert(nodes[known].T) @ nodes[seen].T if expected else None
        found = sight(one, other, self.fitter, self.judge.inliers, T_expected)
        if found is None:
            return "too few features agree"
        return self.judge.doubt(found) or found


class _Looks:
    """The place index of views."""

    def __init__(self) -> None:
        self._index = PlaceIndex()

    def add(self, key: int, view: View) -> None:
        self._index.add(key, view.descriptors)

    def likeness(self, view: View) -> dict[int, float]:
        return dict(zip(self._index.keys, self._index.likeness(view.descriptors).tolist(), strict=True))


class VisualGraph(PlaceGraph[View]):
    """The map that a camera makes."""

    graph: KeyframeGraph[View]
    points: MapPoints

    def __init__(self, settings: GraphSettings) -> None:
        super().__init__(settings, _Looks, between)
        self._judge = settings.judge
        self.points = MapPoints()

    def add(self, keyframe: Keyframe, fitter: Fitter, found_again: bool) -> KeyframeResult:
        """Takes a keyframe of the odometry, and what fits its poses.

        `found_again`: the odometry has found its own map again, so that its pose jumped.
        """
        return self.grow(
            keyframe.stamp, keyframe.T_world_camera, keyframe.covariance, keyframe.segment, found_again,
            CameraEyes(fitter, self._judge, keyframe.surface.typical_depth),
            lambda: View.of(keyframe, fitter.camera),
        )  # fmt: skip

    def withdraw(self, since: int) -> None:
        """Forgets what views from a stamp on, at a place that was taken back, added to the map."""
        super().withdraw(since)
        self.points.forget(self.nodes, self.graph.newest)

    def _adjust(self, number: int, view: View, eyes: Eyes[View]) -> None:
        """Adjusts the newest nodes and the points that they share with each other and with views around."""
        assert isinstance(eyes, CameraEyes)
        new = self.nodes[number]
        here = self.tied if new.island in self.tied else {new.island}
        around = [
            k
            for k, node in self.nodes.items()
            if k != number and node.island in here and eyes.distance(node.T, new.T) < self._settings.reach
        ]
        self.points.see(number, view, self.nodes, around, eyes.fitter.camera)
        adjust_newest(self.graph, self.points, eyes.fitter, WINDOW)

    def _confirmed(self, k: int, number: int, seen: Sighting) -> bool:
        """Leaves out surprises that rest on one plane, since two views of a repeated pattern say the same."""
        if isinstance(seen, ViewMatch) and seen.relief < self._judge.relief:
            return False
        return super()._confirmed(k, number, seen)


def between(node: Node[View], T_odom: Matrix, covariance_odom: Matrix) -> Matrix:
    """Returns the covariance (6, 6) of the motion from a node to a pose of the same odometry.

    It is what the odometry's own covariance has grown by; where that fell, since an older keyframe was found again,
    both count in full.
    """
    carried = moved_covariance(node.covariance_odom, node.T_odom, T_odom)
    grown = covariance_odom - carried
    if np.linalg.eigvalsh(grown)[0] < -1e-9:
        grown = covariance_odom + carried
    return np.asarray(grown + DRIFT, np.float64)
