"""The surfaces of a room in a cloud: floor, walls, table tops."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Boxes3D, Diagnostics, Odometry, Planes, PointCloud, Pose, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import matrix_to_quaternion
from dataflow.operator import Counts, In, Operator, Out, Param, Remembered, Sampled
from operators.cloud.clustering import level_axes
from operators.cloud.filtering import finite, selected
from operators.cloud.gravity import standing, told, unit
from operators.cloud.plane_search import Plane, Scene, Search, find_planes, tolerances
from operators.cloud.surfaces import SURFACES, Rules, Surface, recognised
from operators.status import counted_status

_FADES = 0.9  # share of what walls said before that a cloud leaves
_ENOUGH = 1.0  # m² of wall
_AGREED = 0.9  # length of the mean of unit vectors at four times the angle: half of them within 4 degrees
Array = NDArray[np.float64]
Labels = NDArray[np.int32]
_THICKNESS = 0.02  # metres, of a surface's box


class WallDirections(Remembered):
    """Averages the normals of walls, which turn by 90 degrees from one to the next in most buildings.

    Angles are those of a frame whose z is up, and that stays. Where walls do not agree, there is no common direction.
    Coughlan and Yuille, "Manhattan world", 1999.
    """

    _sum: complex
    _weight: float

    def __init__(self) -> None:
        self._sum, self._weight = 0j, 0.0

    def add(self, normals: Array, areas: Array) -> None:
        """Takes the normals (N, 3) of walls, in the frame that stays, and their areas (N,), m²."""
        self._sum, self._weight = _FADES * self._sum, _FADES * self._weight
        angles = np.arctan2(normals[:, 1], normals[:, 0])
        self._sum += complex((areas * np.exp(4j * angles)).sum())
        self._weight += float(areas.sum())

    @property
    def axes(self) -> Array | None:
        """The two directions (2, 3), level and across each other; None where walls are few or do not agree."""
        if self._weight < _ENOUGH or abs(self._sum) < _AGREED * self._weight:
            return None
        angle = math.atan2(self._sum.imag, self._sum.real) / 4
        c, s = math.cos(angle), math.sin(angle)
        return np.array([[c, s, 0.0], [-s, c, 0.0]])


@dataclass
class State(Counts):
    """Holds the height of the floor, m, the stamp of the last cloud that was looked at, and the directions of walls."""

    floor: float | None = None
    looked: int | None = None
    walls: WallDirections = field(default_factory=WallDirections)


class PlaneSegmenter(Operator):
    """Finds level and upright planes in a cloud and labels floor, wall, table top and ceiling.

    The cloud is in its sensor's frame. Up comes from `pose`, whose own frame has z up, else from the parameter `up`.
    The floor is the lowest level plane with next to nothing below it; its height is remembered, so that tables are
    told where no floor is seen. Without a floor so far, level planes are `other`. A wall is wide and high, and nothing
    that stands is seen behind it. Upright planes need not be vertical beyond `tilt`; slopes are not looked for.

    Walls that agree within right angles, over time where there is a pose, give directions: planes across these are
    looked for first, and what is as narrow as a door and turned against them is a door that stands ajar, no wall.

    Method: RANSAC (Fischler and Bolles, 1981) along and across gravity, votes by normals as in Schnabel, Wahl and
    Klein, "Efficient RANSAC for point-cloud shape detection", 2007, least squares over the voters; directions of walls
    as in Coughlan and Yuille, "Manhattan world", 1999.
    """

    cloud: In[PointCloud] = In(doc="points in the frame of their sensor, which is the origin")
    pose: Sampled[Pose | Odometry] = Sampled(required=False, doc="the sensor or its robot in a frame whose z is up")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the cloud's frame and that of the pose, where they differ"
    )
    planes: Out[Planes] = Out(
        doc="every plane with the rectangle and the hull seen of it, and the plane of every point"
    )
    surfaces: Out[Boxes3D] = Out(doc="the same planes in the same order as flat boxes with a class")
    rest: Out[PointCloud] = Out(doc="the points on no floor, wall, table top or ceiling")
    status: Out[Diagnostics] = Out(
        doc="how many of each were found; a warning where the cloud is too small for any, or its pose is not finite"
    )

    period: float = Param(0.0, ge=0, doc="clouds that come sooner after the last one looked at are left out", unit="s")
    up: tuple[float, float, float] = Param((0.0, 0.0, 1.0), doc="direction up in the cloud's frame where no pose comes")
    voxel: float = Param(0.05, gt=0.005, doc="side of the voxels that planes are looked for in", unit="m")
    distance: float = Param(0.02, gt=0, doc="a point this near to a plane is on it", unit="m")
    growth: float = Param(0.003, ge=0, doc="and this times its squared distance from the sensor: its noise", unit="1/m")
    normal_angle: float = Param(0.6, gt=0, lt=1.5, doc="a point that votes has a normal within this", unit="rad")
    tilt: float = Param(0.1, gt=0, lt=0.5, doc="a plane leans by no more than this", unit="rad")
    gap: float = Param(0.3, gt=0, doc="level planes so far apart are two", unit="m")
    min_area: float = Param(0.25, gt=0, doc="smallest area of a plane", unit="m²")
    trials: int = Param(200, ge=10, le=5000, doc="random samples per plane")
    min_table: float = Param(0.4, gt=0, doc="lowest top of a table above the floor", unit="m")
    max_table: float = Param(1.1, gt=0, doc="highest top of a table above the floor", unit="m")
    table_side: float = Param(0.4, gt=0, doc="shortest side that is seen of a table", unit="m")
    wall_side: float = Param(0.6, gt=0, doc="shortest width that is seen of a wall", unit="m")
    wall_area: float = Param(0.5, gt=0, doc="smallest area that is seen of a wall", unit="m²")
    wall_top: float = Param(1.2, gt=0, doc="a wall is seen up to this height above the floor at least", unit="m")
    door_side: float = Param(1.05, ge=0, doc="a plane no wider and turned against the walls is no wall", unit="m")
    floor_memory: float = Param(0.1, gt=0, doc="the floor is within this of where it was", unit="m")
    state: State

    def setup(self) -> None:
        """Raises ValueError for an up of length 0 and for table heights the wrong way round."""
        self._up = unit(self.up)
        if self.min_table >= self.max_table:
            raise ValueError(f"min_table {self.min_table} m must be below max_table {self.max_table} m")
        self._search = Search(
            voxel=self.voxel,
            distance=self.distance,
            growth=self.growth,
            normal_angle=self.normal_angle,
            tilt=self.tilt,
            gap=self.gap,
            min_area=self.min_area,
            trials=self.trials,
        )
        self._rules = Rules(
            table_heights=(self.min_table, self.max_table),
            table_side=self.table_side,
            wall_side=self.wall_side,
            wall_area=self.wall_area,
            wall_top=self.wall_top,
            floor_memory=self.floor_memory,
            door_side=self.door_side,
        )

    def process(
        self, cloud: PointCloud, pose: Pose | Odometry | None = None, extrinsics: Transforms | None = None
    ) -> dict[str, Any]:
        """Raises ValueError where no transform relates the cloud's frame to that of the pose."""
        if self.state.looked is not None and cloud.stamp - self.state.looked < self.period * 1e9:
            return {}
        self.state.looked = cloud.stamp
        T = standing(cloud, pose, extrinsics)
        up, height = (self._up, 0.0) if T is None else (T[2, :3], float(T[2, 3]))
        lost = pose is not None and not told(pose)
        usable = np.flatnonzero(finite(cloud.points) & (not lost))
        points = cloud.points[usable]
        surfaces: list[Surface] = []
        labels = np.full(cloud.count, -1, np.int32)
        if len(points):
            scene = Scene.of_cloud(points, up, self._search)
            known = None if self.state.floor is None else self.state.floor - height
            surfaces, floor = self._surfaces(scene, known, _turned(up) if T is None else T[:3, :3])
            self.state.floor = None if floor is None else floor + height
            if T is None:
                self.state.walls = WallDirections()  # the sensor may have turned when the next cloud comes
            labels[usable] = self._labels(points, scene, [surface.plane for surface in surfaces])
        named = np.array([surface.name != "other" for surface in surfaces] + [False])
        found = Counter(surface.name for surface in surfaces)
        self.state.counts.update(
            {name: found[name] for name in SURFACES} | {"clouds": 1, "clouds without": not surfaces}
        )
        self.state.counts["poses not finite"] += lost
        return {
            "planes": _planes(surfaces, labels),
            "surfaces": _boxes(cloud, surfaces, labels),
            "rest": _without(cloud, named[labels]),
            "status": _status(cloud, found, self.state.floor is not None, lost),
        }

    def _surfaces(self, scene: Scene, floor: float | None, R: Array) -> tuple[list[Surface], float | None]:
        """Returns the surfaces and the floor's height; walls that agree so far, else those of this cloud, have a say.

        `R` (3, 3) turns the cloud's frame to one whose z is up, and that stays.
        """
        cell = 2 * self.voxel
        before = self.state.walls.axes
        axes = None if before is None else before @ R
        planes = find_planes(scene, self._search, self.rng, axes)
        surfaces, found = recognised(scene, planes, self._rules, floor, cell, axes)
        walls = [s for s in surfaces if s.name == "wall" and s.seen.size[0] > self.door_side]
        self.state.walls.add(_rows([R @ s.plane.normal for s in walls], 3), np.array([s.plane.area for s in walls]))
        if before is None and (now := self.state.walls.axes) is not None:
            planes = find_planes(scene, self._search, self.rng, now @ R)
            surfaces, found = recognised(scene, planes, self._rules, floor, cell, now @ R)
        return surfaces, found

    def _labels(self, points: NDArray[np.float32], scene: Scene, planes: list[Plane]) -> Labels:
        """Returns the plane (N,) of every point: that of its voxel, or -1 where the point itself lies off it."""
        of_voxel = np.full(len(scene.points), -1, np.int32)
        for k, plane in enumerate(planes):
            of_voxel[plane.members] = k
        labels = of_voxel[scene.of]
        exact = points.astype(np.float64)
        tolerance = 1.5 * tolerances(exact, self._search)
        for k, plane in enumerate(planes):
            off = (labels == k) & (np.abs(plane.distances(exact)) > tolerance)
            labels[off] = -1
        return labels


def _turned(up: Array) -> Array:
    """Returns a rotation (3, 3) that takes `up` (3,) to z."""
    x, y = level_axes(up)
    return np.stack([x, y, up])


def _planes(surfaces: list[Surface], labels: Labels) -> Planes:
    return Planes(
        coefficients=_rows([[*s.plane.normal, s.plane.d] for s in surfaces], 4),
        centers=_rows([s.seen.T[:3, 3] for s in surfaces], 3),
        orientations=_orientations(surfaces),
        extents=_rows([s.seen.size for s in surfaces], 2),
        hulls=_rows([corner for s in surfaces for corner in s.seen.hull], 3),
        hull_counts=np.array([len(s.seen.hull) for s in surfaces], np.int64),
        inlier_counts=_members(surfaces, labels),
        labels=labels,
    )


def _boxes(cloud: PointCloud, surfaces: list[Surface], labels: Labels) -> Boxes3D:
    return Boxes3D(
        stamp=cloud.stamp,
        frame=cloud.frame,
        class_names=SURFACES,
        centers=_rows([s.seen.T[:3, 3] for s in surfaces], 3),
        sizes=_rows([[*s.seen.size, _THICKNESS] for s in surfaces], 3),
        orientations=_orientations(surfaces),
        scores=np.ones(len(surfaces), np.float32),
        class_ids=np.array([SURFACES.index(s.name) for s in surfaces], np.int32),
        point_counts=_members(surfaces, labels),
    )


def _rows(rows: list[Any], width: int) -> Array:
    return np.array(rows, np.float64).reshape(-1, width)


def _orientations(surfaces: list[Surface]) -> Array:
    return matrix_to_quaternion(np.array([s.seen.T for s in surfaces]).reshape(-1, 4, 4))


def _members(surfaces: list[Surface], labels: Labels) -> NDArray[np.int64]:
    return np.bincount(labels[labels >= 0], minlength=len(surfaces)).astype(np.int64)


def _without(cloud: PointCloud, taken: NDArray[np.bool_]) -> PointCloud:
    """Returns the finite points that are on no surface, with their colours and normals."""
    kept = finite(cloud.points) & ~taken
    return selected(cloud, kept, fields=("colors", "intensities", "normals"))


def _status(cloud: PointCloud, found: Mapping[str, int], floor_known: bool, lost: bool) -> Diagnostics:
    text = ", ".join(f"{found[name]} {name}" for name in SURFACES if found[name]) or "no plane in the cloud"
    if not floor_known:
        text += "; no floor so far, so level planes have no class"
    if lost:
        text = "the pose is not finite, so up is unknown, and no plane was looked for"
    level = Level.OK if found and floor_known else Level.WARN
    counts = {"points": cloud.count} | {name: found[name] for name in SURFACES}
    return counted_status("plane_segmenter", cloud.stamp, text, level, counts)
