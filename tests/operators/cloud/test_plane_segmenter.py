"""PlaneSegmenter on rooms whose surfaces are known."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from repeated import assert_repeats

from dataflow.messages import Boxes3D, Planes, PointCloud, Pose
from dataflow.messages.geometry import invert, transform_points
from dataflow.testing import play
from operators.cloud import PlaneSegmenter
from operators.cloud.clustering import level_axes
from operators.cloud.plane_search import covered_area

HEIGHT = 1.2
"""Of the sensor above the floor, metres."""


def patch(
    corner: Any, along: Any, up: Any, density: float, rng: np.random.Generator, noise: float = 0.004
) -> np.ndarray:
    """Points on a rectangle, so many on a square metre, with noise across it."""
    a, b = np.array(along, float), np.array(up, float)
    count = int(density * np.linalg.norm(a) * np.linalg.norm(b))
    s, t = rng.uniform(0, 1, (2, count, 1))
    normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    return np.array(corner) + s * a + t * b + rng.normal(0, noise, (count, 1)) * normal


def room(*, floor: bool = True, table: bool = True, cupboard: bool = False, seed: int = 0) -> dict[str, np.ndarray]:
    """Surfaces in the world: floor at 0, walls at x = 3 and y = 2, a table top at 0.75."""
    rng = np.random.default_rng(seed)
    parts = {
        "wall x": patch((3, -2, 0), (0, 4, 0), (0, 0, 2.4), 700, rng),
        "wall y": patch((0, 2, 0), (3, 0, 0), (0, 0, 2.4), 700, rng),
        "ball": rng.normal((1.8, -0.8, 0.9), 0.04, (120, 3)),
    }
    if floor:
        parts["floor"] = patch((0, -2, 0), (3, 0, 0), (0, 4, 0), 700, rng)
    if table:
        parts["table"] = patch((1.2, -1.2, 0.75), (1.2, 0, 0), (0, 0.8, 0), 1500, rng)
    if cupboard:
        parts["cupboard"] = patch((2.4, -0.4, 0), (0, 1.0, 0), (0, 0, 1.4), 1500, rng)
    return parts


def cloud(parts: dict[str, np.ndarray], T_world_sensor: np.ndarray, stamp: int = 1) -> PointCloud:
    points = transform_points(invert(T_world_sensor), np.concatenate(list(parts.values())))
    return PointCloud(stamp=stamp, frame="camera", points=points.astype(np.float32))


def optical(pitch: float = 0.3, yaw: float = 0.2) -> np.ndarray:
    """The pose of a camera that looks ahead and down by `pitch`."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    forward = np.array([cy * cp, sy * cp, -sp])
    right = np.array([sy, -cy, 0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[2, 3] = HEIGHT
    return T


def pose(T: np.ndarray, stamp: int = 1) -> Pose:
    return Pose.from_matrix(T, stamp=stamp, frame="world", child_frame="camera")


def segmented(given: PointCloud, T: np.ndarray | None = None, **params: Any) -> tuple[Planes, Boxes3D, PointCloud]:
    streams: dict[str, Any] = {"cloud": [given]} | ({} if T is None else {"pose": [pose(T)]})
    played = play(PlaneSegmenter(**params), streams)
    (planes,), (surfaces,), (rest,) = played["planes"], played["surfaces"], played["rest"]
    return planes, surfaces, rest


def test_floor_walls_and_table_are_found_with_their_planes_and_points() -> None:
    T, parts = optical(), room()
    planes, surfaces, rest = segmented(cloud(parts, T), T)
    assert sorted(surfaces.labels()) == ["floor", "table", "wall", "wall"]
    expected = {
        "floor": [([0, 0, 1], 0.0)],
        "table": [([0, 0, 1], -0.75)],
        "wall": [([-1, 0, 0], 3.0), ([0, -1, 0], 2.0)],
    }
    for k, name in enumerate(surfaces.labels()):
        normal = T[:3, :3] @ planes.coefficients[k, :3]
        d = planes.coefficients[k, 3] - normal @ T[:3, 3]
        off = min(np.abs(normal - n).max() + abs(d - e) for n, e in expected[name])
        assert off < 0.02, name
    of = np.repeat(np.arange(len(parts)), [len(p) for p in parts.values()])
    for name in ("floor", "table"):
        found = planes.labels == surfaces.labels().index(name)
        true = of == list(parts).index(name)
        assert (found & true).sum() / (found | true).sum() > 0.93
    assert planes.inlier_counts.tolist() == np.bincount(planes.labels[planes.labels >= 0]).tolist()
    assert 110 <= rest.count <= 200  # the ball, and little else


def test_table_rectangle_covers_its_visible_part() -> None:
    T = optical()
    _, surfaces, _ = segmented(cloud(room(), T), T)
    k = surfaces.labels().index("table")
    assert sorted(surfaces.sizes[k, :2]) == pytest.approx([0.8, 1.2], abs=0.06)
    center = transform_points(T, surfaces.centers[k][None])[0]
    np.testing.assert_allclose(center, [1.8, -0.8, 0.75], atol=0.03)


def test_plane_hull_covers_its_visible_part() -> None:
    T, parts = optical(), room()
    corner = parts["table"][:, 0] + parts["table"][:, 1] > 1.6  # a table that lacks one
    parts["table"] = parts["table"][~corner]
    planes, surfaces, _ = segmented(cloud(parts, T), T)
    table = planes.hull(surfaces.labels().index("table"))
    flat = transform_points(T, table)
    assert np.ptp(flat[:, 2]) < 0.02
    x, y = flat[:, 0], flat[:, 1]
    area = 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()  # above 0 where they go round counter-clockwise
    assert area == pytest.approx(1.2 * 0.8 - 0.5 * 0.4**2, abs=0.04)  # of voxel means: 1 cm less on all sides
    for k in range(planes.count):
        assert np.abs(planes.hull(k) @ planes.coefficients[k, :3] + planes.coefficients[k, 3]).max() < 1e-6
        outward = np.cross(np.roll(planes.hull(k), -1, axis=0) - planes.hull(k), planes.coefficients[k, :3])
        on = planes.hull(k) @ outward.T - np.einsum("ij,ij->i", planes.hull(k), outward)
        assert on.max() < 1e-4  # no corner lies outside of an edge


def test_up_is_the_parameter_without_a_pose() -> None:
    T = optical()
    given = cloud(room(), T)
    _, surfaces, _ = segmented(given, up=tuple(T[2, :3]))
    assert sorted(surfaces.labels()) == ["floor", "table", "wall", "wall"]


def test_an_upright_plane_with_a_wall_behind_it_is_no_wall_and_stays_in_the_rest() -> None:
    T, parts = optical(), room(table=False, cupboard=True)
    planes, surfaces, rest = segmented(cloud(parts, T), T)
    assert sorted(surfaces.labels()) == ["floor", "other", "wall", "wall"]
    assert planes.inlier_counts[surfaces.labels().index("other")] > 0.9 * len(parts["cupboard"])
    assert rest.count > len(parts["cupboard"])


def leaf(angle: float, seed: int = 3) -> np.ndarray:
    """The leaf of a door, 0.85 m wide, that hangs in the wall at x = 3 and stands open by an angle."""
    along = 0.85 * np.array([-np.sin(angle), np.cos(angle), 0])
    return patch((2.99, 0.2, 0), along, (0, 0, 2.0), 1500, np.random.default_rng(seed))


@pytest.mark.parametrize("degrees", [12, 25])
def test_a_door_that_stands_ajar_is_no_wall_and_no_part_of_one(degrees: float) -> None:
    T, parts = optical(), room(table=False)
    behind = (parts["wall x"][:, 1] > 0.2) & (parts["wall x"][:, 1] < 1.05) & (parts["wall x"][:, 2] < 2.0)
    parts["wall x"] = parts["wall x"][~behind]
    parts["door"] = leaf(np.radians(degrees))
    planes, surfaces, _ = segmented(cloud(parts, T), T)
    assert sorted(surfaces.labels()) == ["floor", "other", "wall", "wall"]
    of = np.repeat(np.arange(len(parts)), [len(p) for p in parts.values()])
    door = planes.labels == surfaces.labels().index("other")
    assert (of[door] == list(parts).index("door")).mean() > 0.97
    normals = planes.coefficients[[name == "wall" for name in surfaces.labels()], :3] @ T[:3, :3].T
    assert np.abs(normals).max(axis=1) == pytest.approx(1, abs=1e-3)


def test_walls_seen_before_tell_that_a_door_seen_alone_stands_ajar() -> None:
    T, parts = optical(), room(table=False)
    alone = {"floor": parts["floor"], "door": leaf(np.radians(25))}
    clouds = [cloud(parts, T, 1), cloud(alone, T, 2)]
    played = play(PlaneSegmenter(), {"cloud": clouds, "pose": [pose(T, 1), pose(T, 2)]})
    labels = [surfaces.labels() for surfaces in played["surfaces"] if isinstance(surfaces, Boxes3D)]
    assert sorted(labels[1]) == ["floor", "other"]
    _, surfaces, _ = segmented(clouds[1], T)
    assert sorted(surfaces.labels()) == ["floor", "wall"]  # nothing has told of walls there


def test_walls_that_meet_at_no_right_angle_are_found() -> None:
    T, parts = optical(), room(table=False)
    parts["wall y"] = patch((0, 2.6, 0), (3, -1.2, 0), (0, 0, 2.4), 700, np.random.default_rng(2))
    _, surfaces, _ = segmented(cloud(parts, T), T)
    assert sorted(surfaces.labels()) == ["floor", "wall", "wall"]


def test_the_floor_is_remembered_where_only_a_table_is_seen() -> None:
    T = optical()
    clouds = [cloud(room(), T, 1), cloud(room(floor=False), T, 2)]
    played = play(PlaneSegmenter(), {"cloud": clouds, "pose": [pose(T, 1), pose(T, 2)]})
    _, second = played["surfaces"]
    assert sorted(second.labels()) == ["table", "wall", "wall"]


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.full((50, 3), np.nan), np.random.default_rng(0).uniform(0, 1, (4, 3))]
)
def test_a_cloud_too_small_for_planes_is_a_warning(points: np.ndarray) -> None:
    given = PointCloud(stamp=1, frame="camera", points=points.astype(np.float32))
    played = play(PlaneSegmenter(), {"cloud": [given]})
    (status,), (planes,), (rest,) = played["status"], played["planes"], played["rest"]
    assert status.levels.tolist() == [1]
    assert "no plane in the cloud" in status.messages[0]
    assert planes.count == 0
    assert rest.count == np.isfinite(points).all(axis=1).sum()


def test_a_pose_of_another_frame_without_extrinsics_is_named() -> None:
    operator = PlaneSegmenter()
    operator.setup()
    T = optical()
    stranger = Pose.from_matrix(T, stamp=1, frame="world", child_frame="base")
    with pytest.raises(ValueError, match="the pose is that of 'base', the cloud in 'camera'"):
        operator.process(cloud(room(), T), stranger)
    with pytest.raises(ValueError, match="is no direction"):
        PlaneSegmenter(up=(0.0, 0.0, 0.0)).setup()


@pytest.mark.long
def test_segmenters_repeat_and_a_restored_one_remembers_the_floor() -> None:
    T = optical()
    parts = [room(seed=0), room(seed=1), room(floor=False)]
    assert_repeats(PlaneSegmenter, [(cloud(each, T, k), pose(T, k)) for k, each in enumerate(parts, 1)], 2)


def test_clouds_within_the_period_are_skipped_also_after_restoring() -> None:
    T, second = optical(), 1_000_000_000
    stamps = [1, second // 2, second + 1, second + 2]
    calls = [(cloud(room(seed=k), T, stamp), pose(T, stamp)) for k, stamp in enumerate(stamps)]
    made = assert_repeats(partial(PlaneSegmenter, period=1.0), calls, 3)
    assert [bool(each) for each in made] == [True, False, True, False]


@pytest.mark.parametrize("normal", [(0, 0, 1.0), (0.6, 0, 0.8), (-0.36, 0.48, -0.8)])
def test_the_area_of_a_plane_is_that_of_the_cells_that_hold_points(normal: tuple[float, float, float]) -> None:
    points = np.random.default_rng(6).uniform(-3, 3, (500, 3))
    axes = level_axes(np.array(normal))
    np.testing.assert_allclose(axes @ np.array([*axes, normal]).T, np.eye(3)[:2], atol=1e-12)
    cells = {tuple(cell) for cell in np.floor(points @ axes.T / 0.25).astype(int).tolist()}
    assert covered_area(points, np.array(normal), 0.25) == len(cells) * 0.25 * 0.25
