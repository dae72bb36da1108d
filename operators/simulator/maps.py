"""The true map of what stands still: a grid of free and taken cells, planes, and the surface itself."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Mesh, OccupancyGrid, Planes
from dataflow.messages.geometry import matrix_to_quaternion, transform_points
from operators.simulator.scene import World
from operators.simulator.shapes import Array, Patch

FREE, TAKEN, UNSEEN = 0, 100, -1

_LEAST_WALL, _LEAST_TOP = 3.0, 0.1  # m²: smaller pieces of walls (pictures) and of furniture are left out


def occupancy(world: World, resolution: float, band: tuple[float, float], stamp: int, frame: str) -> OccupancyGrid:
    """Marks the cells of the floor that are taken.

    A cell is taken where the surface of something that stands still lies in it between the two heights of `band` (m),
    free where the robot can get to from its start by steps to free neighbours, and unknown elsewhere: outside, and
    within furniture. The grid has a margin of one cell about the building.
    """
    low, high = (np.array(corner[:2]) for corner in floor_of(world))
    origin = np.floor(low / resolution) * resolution - resolution
    columns, rows = np.ceil((high - origin) / resolution).astype(int) + 1
    taken = np.zeros((rows, columns), np.bool_)
    for thing in world.things:
        if not thing.still or thing.label in ("floor", "ceiling"):
            continue
        T = thing.mover.frame(0.0)
        for patch in thing.parts[0]:
            points = _samples(transform_points(T, patch.vertices)[patch.triangles], resolution / 2)
            points = points[(points[:, 2] >= band[0]) & (points[:, 2] <= band[1])]
            cell = np.floor((points[:, :2] - origin) / resolution).astype(int)
            inside = (cell >= 0).all(axis=1) & (cell < [columns, rows]).all(axis=1)
            taken[cell[inside, 1], cell[inside, 0]] = True
    _, parts = cv2.connectedComponents((~taken).astype(np.uint8), connectivity=4)
    column, row = np.floor((world.path.at([0.0]).position[0] - origin) / resolution).astype(int)
    cells = np.where(parts == parts[row, column], FREE, UNSEEN)
    cells[taken] = TAKEN
    return OccupancyGrid(
        stamp=stamp, frame=frame, resolution=resolution, cells=cells.astype(np.int8), position=np.array([*origin, 0.0])
    )


def surfaces(world: World, stamp: int, frame: str) -> Planes:
    """The rectangles of the building and the tops of tables and shelves, normals into the room."""
    found = list(_rectangles(world))
    normals = np.array([T[:3, 2] for T, _ in found]).reshape(-1, 3)
    centers = np.array([T[:3, 3] for T, _ in found]).reshape(-1, 3)
    return Planes(
        stamp=stamp,
        frame=frame,
        coefficients=np.column_stack([normals, -(normals * centers).sum(axis=1)]),
        centers=centers,
        orientations=matrix_to_quaternion(np.array([T for T, _ in found]).reshape(-1, 4, 4)),
        extents=np.array([extent for _, extent in found]).reshape(-1, 2),
    )


def mesh(world: World, stamp: int, frame: str) -> Mesh:
    """All that stands still, each vertex with the tint of its material."""
    vertices, normals, triangles, colors, count = [], [], [], [], 0
    for thing in world.things:
        if thing.still:
            T = thing.mover.frame(0.0)
            for patch in thing.parts[0]:
                vertices.append(transform_points(T, patch.vertices))
                normals.append(patch.normals @ T[:3, :3].T)
                triangles.append(patch.triangles + count)
                colors.append(np.tile(np.rint(255 * np.array(patch.material.tint)), (len(patch.vertices), 1)))
                count += len(patch.vertices)
    return Mesh(
        stamp=stamp,
        frame=frame,
        vertices=np.concatenate(vertices).astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.uint32),
        normals=np.concatenate(normals).astype(np.float32),
        colors=np.clip(np.concatenate(colors), 0, 255).astype(np.uint8),
    )


def floor_of(world: World) -> tuple[Array, Array]:
    """Lowest and highest corner of the floor."""
    corners = np.concatenate([thing.vertices(0.0) for thing in world.things if thing.label == "floor"])
    return corners.min(axis=0), corners.max(axis=0)


def _rectangles(world: World) -> Iterator[tuple[Array, Array]]:
    """`T_world_rectangle` (4, 4), z its normal, and the extents (2,)."""
    for thing in world.things:
        if not thing.still:
            continue
        T = thing.mover.frame(0.0)
        for patch in thing.parts[0]:
            if np.ptp(patch.normals, axis=0).max() > 1e-6:
                continue
            T_rectangle, extent = _rectangle(patch, T)
            area = float(extent.prod())
            building = thing.label in ("floor", "wall", "ceiling") and area >= _LEAST_WALL
            top = thing.label in ("table", "shelf") and T_rectangle[2, 2] > 0.99 and area >= _LEAST_TOP
            if building or top:
                yield T_rectangle, extent


def _rectangle(patch: Patch, T: Array) -> tuple[Array, Array]:
    """The rectangle of a flat patch whose triangles begin with two corners along one of its sides."""
    points = transform_points(T, patch.vertices)
    a, b = points[patch.triangles[0, :2]]
    R = np.empty((3, 3))
    R[:, 2] = T[:3, :3] @ patch.normals[0]
    R[:, 0] = (b - a) / np.linalg.norm(b - a)
    R[:, 1] = np.cross(R[:, 2], R[:, 0])
    own = points @ R
    low, high = own.min(axis=0), own.max(axis=0)
    T_rectangle = np.eye(4)
    T_rectangle[:3, :3], T_rectangle[:3, 3] = R, R @ ((low + high) / 2)
    return T_rectangle, (high - low)[:2]


def _samples(corners: Array, spacing: float) -> Array:
    """Points (N, 3) on triangles (T, 3, 3), none farther from its neighbours than `spacing`."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps: NDArray[np.int64] = np.maximum(1, np.ceil(longest / spacing)).astype(np.int64)
    found = []
    for n in np.unique(steps):
        u, v = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        kept = u + v <= n
        weights = np.stack([n - u[kept] - v[kept], u[kept], v[kept]], axis=1) / n
        found.append(np.einsum("wk,tkx->twx", weights, corners[steps == n]).reshape(-1, 3))
    return np.concatenate(found) if found else np.zeros((0, 3))
