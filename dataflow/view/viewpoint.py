"""The viewpoint from which a scene is looked at: what its sensors have seen is in view."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dataflow.view.frames import FrameTree

Vector = npt.NDArray[np.float64]
_ONE_SIDED = 0.5
"""Length of the mean direction of points that lie more to one side of their sensor than all round it."""
FARTHEST = 50.0
"""Metres: half of what is in view, at most."""
_NEWEST = 4
"""Clouds seen to one side that are remembered: those at the end of a run."""
_ASIDE = (-0.97, 1.05, 0.4)
"""From where one looks: ahead, up and to the side."""
_HIGH, _WIDE = 0.38, 0.5
"""Tangents of half of what is in view: the viewer's angle is some 50 degrees, less room for names; a view is wide."""
MOST_PLACES = 2048
"""Sets of places that are kept; of more, every second one, and so on."""


@dataclass(frozen=True, slots=True)
class ViewerPose:
    """A viewpoint in the drawing frame, metres. `up` is a unit vector along an axis."""

    up: Vector
    position: Vector | None = None
    target: Vector | None = None


@dataclass(slots=True)
class Viewpoint:
    """Frames, ranges and positions that messages have given so far."""

    optical: dict[str, None] = field(default_factory=dict)
    """Optical frames, in the order in which they came."""
    posed: dict[str, None] = field(default_factory=dict)
    """Frames that messages placed."""
    _ranges: list[float] = field(default_factory=list)
    _around: list[Vector] = field(default_factory=list)
    _kept: list[Vector] = field(default_factory=list)
    _places: list[Vector] = field(default_factory=list)
    _newest: deque[Vector] = field(default_factory=lambda: deque(maxlen=_NEWEST))
    _passed: int = 0  # sets of places since the last one that was kept
    _stride: int = 1
    _ahead: Vector | None = None  # the direction in which one looks, decided once

    def saw_range(self, distances: npt.ArrayLike) -> None:
        """Distances (N,) in metres at which things were seen: they set how far back to look from."""
        d = np.asarray(distances, np.float64)
        d = d[np.isfinite(d) & (d > 0)]
        if d.size and len(self._ranges) < 256:
            self._ranges.append(float(np.median(d)))

    def saw_points(self, T: Vector | None, points: npt.ArrayLike) -> None:
        """Points (N, 3) of a cloud in its sensor's frame show how far things are; with the frame's pose `T` in the root
        frame, those of a scan all round also where the place is, and the newest what there is at the end."""
        p = np.asarray(points, np.float64).reshape(-1, 3)
        distances = np.linalg.norm(p, axis=1)
        self.saw_range(distances)
        p, distances = p[distances > 0], distances[distances > 0]
        if len(p) < 16 or T is None:
            return
        if np.linalg.norm((p / distances[:, None]).mean(axis=0)) >= _ONE_SIDED:
            self._newest.append(p @ T[:3, :3].T + T[:3, 3])
        elif len(self._around) < 16:
            self._around.append(p @ T[:3, :3].T + T[:3, 3])

    def saw_places(self, T: Vector | None, points: npt.ArrayLike) -> None:
        """Points (N, 3) where something was, in a frame of pose `T` in the root frame."""
        self._passed += 1
        if T is None or self._passed < self._stride:
            return
        self._passed = 0
        p = np.asarray(points, np.float64).reshape(-1, 3)
        self._places.append(p[np.isfinite(p).all(axis=1)] @ T[:3, :3].T + T[:3, 3])
        if len(self._places) >= MOST_PLACES:
            self._places, self._stride = self._places[::2], 2 * self._stride

    @property
    def knows_more(self) -> bool:
        """Returns whether the end of a run shows more than its beginning: points that stay, or a way."""
        return bool(self._kept) or len(self._places) > 1

    def kept_points(self, points: npt.ArrayLike) -> None:
        """Points (N, 3) in the root frame that stay: the viewpoint is so far off that they are in view."""
        p = np.asarray(points, np.float64).reshape(-1, 3)
        self._kept.append(p[:: max(len(p) // 64, 1)])

    def outlook(self, tree: FrameTree, *, whole: bool = False) -> ViewerPose:
        """Chooses the viewpoint from which everything seen is in view. `whole`: the run is over.

        From behind and above the cameras, or else the robot; where a sensor scans all round, so high that the whole
        place is in view, since the robot will drive about in it; and once it is over the whole way, unless it is long.
        Up is +z (REP 103), unless the root is itself like an optical frame (y down), as in
        data sets whose world is their first camera.
        """
        up = np.array([0.0, 0.0, 1.0])
        cameras = [T for frame in self.optical if (T := tree.pose(frame)) is not None]
        if cameras and all(T[1, 1] > 0.7 and T[2, 2] > 0.7 for T in cameras):
            up = np.array([0.0, -1.0, 0.0])
        if cameras:
            at, ahead = cameras[0][:3, 3], cameras[0][:3, 2]
        else:
            robot = next((T for frame in self.posed if (T := tree.pose(frame)) is not None), None)
            if robot is None and not self._ranges:
                return ViewerPose(up)
            at, ahead = (np.zeros(3), np.eye(3)[0]) if robot is None else (robot[:3, 3], robot[:3, 0])
        level = ahead - up * (ahead @ up)
        if np.linalg.norm(level) < 0.2:
            level = np.eye(3)[0] - up * up[0]
        level /= np.linalg.norm(level)
        if self._ahead is None:
            self._ahead = level
        level = self._ahead
        reach = float(np.clip(np.median(self._ranges) if self._ranges else 3.0, 1.0, 30.0))
        side = np.cross(level, up)
        clouds, way = self._around + self._kept, list[Vector]()
        if whole and len(self._places) > 1 and _extent(self._places, up) <= FARTHEST:
            clouds, way = clouds + list(self._newest), self._places
        if clouds or way:
            axes = np.array([level, up, side])
            beside = 0.0 if clouds else (reach if self._ranges else 1.0)  # what was seen on the way lies beside it
            return _fitted(np.concatenate([*_usual(clouds, 3), *_usual(way, 1)]), axes, beside)
        position = at - level * (0.75 * reach) + up * (0.6 * reach) + side * (0.45 * reach)
        return ViewerPose(up, position, at + level * (0.75 * reach))


def _usual(sets: list[Vector], share: float) -> list[Vector]:
    """All points of some sets, drawn into the box that has all but a share (per cent) on each side; none of none."""
    if not sets:
        return []
    points = np.concatenate(sets)
    lower, upper = np.percentile(points, [share, 100 - share], axis=0)
    return [np.clip(points, lower, upper)]


def _fitted(points: Vector, axes: Vector, beside: float) -> ViewerPose:
    """The nearest viewpoint in a fixed direction from which all points (N, 3) are in view, and `beside` metres farther.

    `axes` are the unit vectors ahead, up and to the side. A point at depth q along the view and height h in the image
    is in view from the distance d where |h - c| <= (d - q) tan: the least d, and the c to aim at, follow from the
    largest q + h / tan and q - h / tan.
    """
    back = np.asarray(_ASIDE) @ axes
    away = float(np.linalg.norm(back))
    back = back / away
    right = np.cross(axes[1], back)
    right /= np.linalg.norm(right)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    from_middle = points - middle
    near, target, distance = from_middle @ back, middle.copy(), 1.0
    for axis, tangent in ((np.cross(back, right), _HIGH), (right, _WIDE)):
        along = from_middle @ axis / tangent
        above, below = float((near + along).max()), float((near - along).max())
        target += axis * ((above - below) / 2 * tangent)
        distance = max(distance, (above + below) / 2)
    distance = min(max(distance + beside, away), 2 * away * FARTHEST)
    return ViewerPose(axes[1], target + distance * back, target)


def _extent(places: list[Vector], up: Vector) -> float:
    """Half the diagonal, in the plane, of what nearly all places lie in."""
    lower, upper = np.percentile(np.concatenate(places), [3, 97], axis=0)
    return float(np.linalg.norm((upper - lower)[up == 0]) / 2)
