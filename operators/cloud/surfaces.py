"""Classifies planes as a robot indoors sees them: floor, wall, table, ceiling or something else."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.cloud.clustering import level_axes
from operators.cloud.plane_search import ASKEW, Plane, Scene, covered_area

Array = NDArray[np.float64]

SURFACES = ("floor", "wall", "table", "ceiling", "other")


@dataclass(frozen=True)
class Rules:
    """Holds what makes a surface what it is. Lengths in metres."""

    table_heights: tuple[float, float]
    """Of a table's top above the floor."""
    table_side: float
    """Shortest side of the rectangle that is seen of a table."""
    wall_side: float
    """Shortest horizontal side that is seen of a wall."""
    wall_area: float
    """Smallest area that is seen of a wall, m²."""
    wall_top: float
    """A wall is seen up to this height above the floor at least."""
    floor_memory: float
    """Largest distance of the floor from where it was before."""
    door_side: float
    """Greatest width of what may be the leaf of a door."""


@dataclass(frozen=True, eq=False)
class Rectangle:
    """The part of a plane that was seen: `T_cloud_rectangle` (4, 4) with z along the normal, its size (2,), and within
    it the convex `hull` (C, 3), counter-clockwise seen from where the normal points."""

    T: Array
    size: Array
    hull: Array


def rectangle(plane: Plane, points: Array, up: Array) -> Rectangle:
    """Returns the smallest rectangle around the points on a plane; that of an upright plane stands on its x side."""
    axes = level_axes(plane.normal) if plane.kind == "level" else _upright_axes(plane.normal, up)
    flat = points @ axes.T
    if plane.kind == "level":
        (u, v), (width, depth), angle = cv2.minAreaRect(flat.astype(np.float32))
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        axes = np.array([[c, s], [-s, c]]) @ axes
        middle, size = np.array([[c, s], [-s, c]]) @ [u, v], np.array([width, depth])
    else:
        low, high = flat.min(axis=0), flat.max(axis=0)
        middle, size = (low + high) / 2, high - low
    T = np.eye(4)
    T[:3, :3] = np.stack([*axes, plane.normal], axis=1)
    T[:3, 3] = middle @ axes - plane.d * plane.normal
    corners = cv2.convexHull((points @ axes.T - middle).astype(np.float32), clockwise=False)[:, 0].astype(np.float64)
    return Rectangle(T, size, corners @ axes + T[:3, 3])


@dataclass(frozen=True, eq=False)
class Surface:
    """A plane, what it is, and the rectangle seen of it."""

    name: str
    plane: Plane
    seen: Rectangle


def recognised(
    scene: Scene, planes: list[Plane], rules: Rules, known_floor: float | None, cell: float, walls: Array | None = None
) -> tuple[list[Surface], float | None]:
    """Returns the surfaces, the floor's parts as one, and the floor's height along up: as known before if none is seen.

    `cell` is the side of the squares that areas are measured in, `walls` (2, 3) what directions walls face, if known.
    """
    seen = [rectangle(plane, scene.points[plane.members], scene.up) for plane in planes]
    names, floor = _names(scene, planes, seen, rules, known_floor, cell, walls)
    floors = [plane for plane, name in zip(planes, names, strict=True) if name == "floor"]
    surfaces = [Surface(*each) for each in zip(names, planes, seen, strict=True) if each[0] != "floor"]
    if floors:
        whole = _joined(floors)
        surfaces.insert(0, Surface("floor", whole, rectangle(whole, scene.points[whole.members], scene.up)))
    return surfaces, floor


def _joined(parts: list[Plane]) -> Plane:
    """Merges segments of one plane: the largest one's normal and offset, with the members and areas of all."""
    largest = max(parts, key=lambda plane: plane.area)
    members = np.sort(np.concatenate([plane.members for plane in parts]))
    return replace(largest, members=members, area=sum(plane.area for plane in parts))


def _names(
    scene: Scene,
    planes: list[Plane],
    rectangles: list[Rectangle],
    rules: Rules,
    known_floor: float | None,
    cell: float,
    walls: Array | None,
) -> tuple[list[str], float | None]:
    heights = [float(-plane.d * (plane.normal @ scene.up)) for plane in planes]
    floor = _floor(scene, planes, heights, rules, known_floor)
    names = []
    for plane, height, seen in zip(planes, heights, rectangles, strict=True):
        if plane.kind == "level":
            names.append(_level(plane, height, seen, scene, rules, floor))
        elif walls is not None and _hangs_askew(plane, seen, rules, walls):
            names.append("other")
        else:
            names.append("wall" if _is_wall(plane, seen, scene, rules, floor, cell) else "other")
    return names, floor


def _hangs_askew(plane: Plane, seen: Rectangle, rules: Rules, walls: Array) -> bool:
    """Returns whether an upright plane is as narrow as a door and turned against the walls, as one that stands ajar."""
    return bool(seen.size[0] <= rules.door_side and np.abs(walls @ plane.normal).max() < math.cos(ASKEW))


def _floor(scene: Scene, planes: list[Plane], heights: list[float], rules: Rules, known: float | None) -> float | None:
    """Returns the height of the lowest level plane that faces up, if it is the floor; the known height if it is not.

    It is where it has next to nothing below it or, once the floor is known, where it is near to it.
    """
    facing_up = [k for k, p in enumerate(planes) if p.kind == "level" and p.normal @ scene.up > 0]
    if known is not None:
        facing_up = [k for k in facing_up if abs(heights[k] - known) <= rules.floor_memory]
    if not facing_up:
        return known
    lowest = min(facing_up, key=lambda k: heights[k])
    below = scene.points @ scene.up < heights[lowest] - 3 * scene.tolerance
    if known is None and below.sum() > 0.05 * len(planes[lowest].members):
        return None
    return heights[lowest]


def _level(plane: Plane, height: float, seen: Rectangle, scene: Scene, rules: Rules, floor: float | None) -> str:
    if plane.normal @ scene.up < 0:
        return "ceiling"
    if floor is None:
        return "other"
    if abs(height - floor) <= rules.floor_memory:
        return "floor"
    lowest, highest = rules.table_heights
    if lowest <= height - floor <= highest and seen.size.min() >= rules.table_side:
        return "table"
    return "other"


def _is_wall(plane: Plane, seen: Rectangle, scene: Scene, rules: Rules, floor: float | None, cell: float) -> bool:
    """Returns whether an upright plane is wide and high enough, and nothing that stands is seen behind it."""
    if seen.size[0] < rules.wall_side or plane.area < rules.wall_area:
        return False
    members = scene.points[plane.members] @ scene.up
    if floor is not None and np.quantile(members, 0.98) - floor < rules.wall_top:
        return False
    axes = seen.T[:3, :2]
    along = (scene.points - seen.T[:3, 3]) @ axes
    distance = plane.distances(scene.points)
    inside = np.abs(along[:, 0]) <= max(seen.size[0] / 2 - 0.15, 0.1)
    behind = inside & (distance < -0.1 - scene.tolerance) & (distance > -1.0)
    behind &= np.abs(scene.normals @ scene.up) < 0.5
    if floor is not None:
        behind &= scene.points @ scene.up > floor + 0.3
    hidden = covered_area(scene.points[behind], plane.normal, cell) if behind.any() else 0.0
    return hidden <= 0.08 * plane.area


def _upright_axes(normal: Array, up: Array) -> Array:
    """Returns the horizontal direction in an upright plane and the one that rises, right-handed with the normal."""
    y = up - (up @ normal) * normal
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, normal), y])
