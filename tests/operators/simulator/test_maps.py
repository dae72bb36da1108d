"""The true map says what rays find: which cells are free, where planes and surfaces lie."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from dataflow.messages.geometry import quaternion_to_matrix
from operators.simulator import maps
from operators.simulator.rendering.native import open3d
from operators.simulator.scene import Builder, Light, World
from operators.simulator.shapes import Array, Material, box, pose, sheet
from operators.simulator.things.furnishing import FLOOR
from operators.simulator.trajectory import Trajectory
from operators.simulator.worlds.make import NAMES, make_world

BAND = (0.05, 1.5)


@functools.lru_cache
def world(name: str) -> World:
    return make_world(name, 1, speed=0.5, hold=0.0, movers=True)


def room() -> World:
    """A floor of 4 by 3 m with a tall box of 1 by 1 m, and a board that hangs at 1.8 m."""
    builder, stuff = Builder(), Material("plain")
    builder.surface("floor", (sheet((-2, -1.5, 0), (4, 0, 0), (0, 3, 0), stuff, 0.5),))
    builder.surface("wall", (sheet((-2, -1.5, 0), (4, 0, 0), (0, 0, 2.5), stuff, 0.5),))
    builder.put("box", box((1.0, 1.0, 2.0), stuff, center=(0, 0, 1.0)), pose(0.525, 0.025), on=FLOOR)
    builder.put("table", box((0.6, 0.8, 0.04), stuff, center=(0, 0, 1.8)), pose(-1.2, 0, 0, 0.3), on=FLOOR)
    path = Trajectory(np.array([(-1.0, -1.0), (-0.6, -1.0), (-0.6, 1.0), (-1.0, 1.0)]))
    return World("test", tuple(builder.things), (Light((0, 0, 2), 1.0),), 0.5, path, np.zeros((0, 3)), (0,) * 6, ())


def cells_at(grid: maps.OccupancyGrid, points: Array) -> np.ndarray:
    column, row = np.floor((points - grid.position[:2]) / grid.resolution).astype(int).T
    return np.asarray(grid.cells[row, column])


def test_cells_are_free_taken_or_never_seen() -> None:
    grid = maps.occupancy(room(), 0.05, BAND, 0, "world")
    centre, side = np.array([[0.51, 0.01]]), np.array([[0.03, 0.0], [1.02, 0.3], [0.5, 0.52], [-1.0, -1.49]])
    free = np.array([[-1.2, 0.0], [1.5, 1.0], [0.5, -1.0], [-1.9, 1.4]])
    assert cells_at(grid, centre).tolist() == [-1]  # in the box
    assert cells_at(grid, side).tolist() == [100] * 4  # the box's sides, the wall
    assert cells_at(grid, free).tolist() == [0] * 4  # below the board too, which hangs above the band


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_the_map_agrees_with_rays_through_the_world(name: str) -> None:
    """Level rays from the path end in taken cells and pass through cells that are not."""
    here, o3d = world(name), open3d()
    grid = maps.occupancy(here, 0.05, BAND, 0, "world")
    assert (cells_at(grid, here.path.outline()) == 0).all()
    surface = maps.mesh(here, 0, "world")
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(surface.vertices), o3d.core.Tensor(surface.triangles))
    rng = np.random.default_rng(0)
    start = here.path.outline(60)[rng.integers(0, 60, 400)]
    angle = rng.uniform(-np.pi, np.pi, 400)
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(400)], axis=1)
    origin = np.column_stack([start, rng.uniform(0.1, 1.4, 400)])
    rays = np.concatenate([origin, direction], axis=1).astype(np.float32)
    reach = scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)["t_hit"].numpy()
    assert np.isfinite(reach).all()
    ends = origin + direction * (reach[:, None] + 1e-3)
    around = np.array([(dx, dy) for dx in (-0.03, 0, 0.03) for dy in (-0.03, 0, 0.03)])
    hit = np.array([(cells_at(grid, ends[:, :2] + offset) == 100) for offset in around]).any(axis=0)
    assert hit.all()


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_points_of_true_surfaces_lie_on_the_true_mesh(name: str) -> None:
    here, o3d = world(name), open3d()
    planes, surface = maps.surfaces(here, 0, "world"), maps.mesh(here, 0, "world")
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(surface.vertices), o3d.core.Tensor(surface.triangles))
    assert planes.centers is not None
    assert planes.extents is not None
    assert planes.orientations is not None
    rng = np.random.default_rng(0)
    for k in range(planes.count):
        n, d = planes.coefficients[k, :3], planes.coefficients[k, 3]
        R = quaternion_to_matrix(planes.orientations[k])
        np.testing.assert_allclose(R[:, 2], n, atol=1e-9)
        local = rng.uniform(-0.5, 0.5, (20, 2)) * planes.extents[k]
        points = planes.centers[k] + local @ R[:, :2].T
        np.testing.assert_allclose(points @ n + d, 0, atol=1e-9)
        gap = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32)), nthreads=1).numpy()
        assert gap.max() < 1e-3
    upright = np.abs(planes.coefficients[:, 2]) < 1e-6
    tables = sum(thing.label == "table" for thing in here.objects())
    level = (planes.coefficients[:, 2] > 0.99) & (planes.centers[:, 2] > 0.3) & (planes.centers[:, 2] < 1.2)
    assert upright.sum() >= 4
    assert level.sum() >= tables
    assert np.isclose(planes.centers[:, 2], 0, atol=1e-9).any()
