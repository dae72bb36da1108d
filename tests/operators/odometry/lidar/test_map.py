"""Scans thinned, and planes made of their points, against planes that are known and against numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.odometry.lidar.map import FEWEST, PlaneMap, _thinnest
from operators.odometry.lidar.scan import MOST, prepare

Array = NDArray[np.float64]

NORMAL = np.array([0.2, -0.3, 1.0]) / np.linalg.norm([0.2, -0.3, 1.0])
AWAY = np.array([50.0, 0.0, 0.0])


def slope(count: int, reach: float = 6.0, noise: float = 0.005, seed: int = 1) -> Array:
    """Points (N, 3) of a plane through (0, 0, 0.3) that is not level."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-reach, reach, (count, 2))
    z = 0.3 - xy @ NORMAL[:2] / NORMAL[2]
    return np.column_stack([xy, z]) + rng.normal(0, noise, count)[:, None] * NORMAL


# -- scans -----------------------------------------------------------------------------------------------------


def test_points_too_near_too_far_and_without_a_place_or_time_are_left_out() -> None:
    points = np.array([[0.4, 0, 0], [0.6, 0, 0], [0, 5, 0], [0, 0, 10.1], [np.nan, 1, 1], [3, 0, 4]], np.float32)
    offsets = np.array([0.0, 0.1, np.nan, 0.3, 0.4, 0.5], np.float32)
    scan, _ = prepare(points, None, 0.5, 10.0, 0.1)
    np.testing.assert_array_equal(scan.points, points[[1, 2, 5]])
    assert (scan.unusable, scan.offsets, scan.count) == (3, None, 3)
    timed, _ = prepare(points, offsets, 0.5, 10.0, 0.1)
    np.testing.assert_array_equal(timed.points, points[[1, 5]])
    assert timed.offsets is not None
    np.testing.assert_allclose(timed.offsets, [0.1, 0.5])
    assert timed.unusable == 4


@pytest.mark.parametrize(("median", "spacing"), [(0.8, 0.05), (8.0, 0.2), (60.0, 0.5)])
def test_points_are_kept_as_far_apart_as_suits_the_ranges(median: float, spacing: float) -> None:
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(9000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = (ways * median * rng.uniform(0.9, 1.1, (9000, 1))).astype(np.float32)
    scan, found = prepare(points, None, 0.1, 100.0, None)
    assert found == pytest.approx(spacing, rel=0.02)
    cells = np.unique(np.floor(points / np.float32(found)), axis=0)
    assert 0.75 * len(cells) < len(scan.points) <= len(cells)  # some share a hash
    sparser = np.unique(np.floor(scan.points / (4 * found)), axis=0)
    assert 0.75 * min(len(sparser), MOST / 2) < scan.count <= min(len(sparser), MOST)


# -- planes ----------------------------------------------------------------------------------------------------


def test_the_thinnest_direction_is_the_last_eigenvector() -> None:
    rng = np.random.default_rng(2)
    roots = rng.normal(size=(200, 3, 3)) * rng.uniform(0.01, 3.0, (200, 1, 3))
    spread = roots @ roots.transpose(0, 2, 1)
    normals, thin, narrow = _thinnest(spread)
    values, axes = np.linalg.eigh(spread)
    np.testing.assert_allclose(thin, values[:, 0], atol=1e-6)
    np.testing.assert_allclose(narrow, values[:, 1], atol=1e-6)
    clear = values[:, 1] > 1.1 * values[:, 0] + 1e-4
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", normals, axes[:, :, 0]))[clear], 1.0, atol=1e-4)


def test_a_map_of_a_slope_has_its_plane_wherever_it_was_seen() -> None:
    planes = PlaneMap(2.0, 3)
    planes.add(slope(12000), birth=0)
    asked = slope(300, reach=5.5, noise=0.0, seed=2)
    pairs = planes.pairs(asked)
    assert len(pairs.points) > 0.97 * len(asked)
    assert pairs.known > 0.97
    np.testing.assert_allclose(np.abs(pairs.normals @ NORMAL), 1.0, atol=2e-3)
    off = np.einsum("ij,ij->i", asked[pairs.points] - pairs.centers, pairs.normals)
    assert np.abs(off).max() < 0.02
    assert np.median(np.sqrt(pairs.thickness)) == pytest.approx(0.005, rel=0.2)
    assert (np.sqrt(pairs.slopes) < 0.02).all()


def test_points_that_come_in_parts_make_the_planes_that_they_make_at_once() -> None:
    points = slope(2000, reach=2.0)
    once, parts = PlaneMap(2.0, 2), PlaneMap(2.0, 2)
    once.add(points, birth=0)
    for k in range(4):
        parts.add(points[k::4], birth=k)
    asked = slope(200, reach=1.9, noise=0.0, seed=3)
    a, b = once.pairs(asked), parts.pairs(asked)
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", a.normals, b.normals)), 1.0, atol=1e-3)
    np.testing.assert_allclose(np.einsum("ij,ij->i", b.centers - a.centers, a.normals), 0.0, atol=5e-3)
    assert set(b.births.tolist()) == {0}  # the first to open a voxel
    assert len(once) == len(parts)


def test_few_points_a_line_of_them_and_a_bush_make_no_plane() -> None:
    rng = np.random.default_rng(4)
    few = slope(FEWEST - 1, reach=0.4) + np.full(3, 0.5)
    line = np.column_stack([np.linspace(10.1, 11.9, 300), np.full((300, 2), 0.5)]) + rng.normal(0, 0.005, (300, 3))
    bush = rng.uniform(20.1, 21.9, (600, 3))
    for points, known in ((few, 0.0), (line, 1.0), (bush, 1.0)):
        planes = PlaneMap(2.0, 1)
        planes.add(points, birth=0)
        pairs = planes.pairs(points)
        assert not len(pairs.points)
        assert pairs.known == known


def test_two_walls_in_one_large_voxel_are_planes_of_smaller_ones() -> None:
    rng = np.random.default_rng(5)
    floor = np.column_stack([rng.uniform(0.02, 1.98, (3000, 2)), np.full(3000, 0.1)])
    wall = np.column_stack([np.full(3000, 0.1), rng.uniform(0.02, 1.98, (3000, 2))])
    planes = PlaneMap(2.0, 3)
    planes.add(np.concatenate([floor, wall]) + rng.normal(0, 0.003, (6000, 3)), birth=0)
    pairs = planes.pairs(np.array([[1.5, 1.5, 0.1], [0.1, 1.5, 1.5]]))
    assert pairs.points.tolist() == [0, 1]
    np.testing.assert_allclose(np.abs(pairs.normals), [[0, 0, 1], [1, 0, 0]], atol=0.02)


def test_scan_lines_that_cross_are_no_surface_where_beams_pass_between_them() -> None:
    rng = np.random.default_rng(6)
    column = np.column_stack([np.full(12, 8.4), np.full(12, 1.9), np.linspace(0.1, 1.9, 12)])
    ceiling = np.column_stack([np.full(12, 8.4), np.linspace(0.1, 1.9, 12), np.full(12, 1.9)])
    lines = np.concatenate([column, ceiling]) + rng.normal(0, 0.005, (24, 3))
    beyond = np.column_stack([np.full(400, 15.0), rng.uniform(-1, 2, 400), rng.uniform(-1, 4, 400)])
    seen, unknown = PlaneMap(2.0, 1), PlaneMap(2.0, 1)
    seen.add(np.concatenate([lines, beyond]), 0, np.array([0.0, 0.5, 1.0]))
    unknown.add(np.concatenate([lines, beyond]), 0)
    assert len(unknown.pairs(lines).points) == len(lines)
    assert not len(seen.pairs(lines).points)
    wall = np.column_stack([np.full(600, 8.4), rng.uniform(0.05, 1.95, (600, 2))]) + rng.normal(0, 0.005, (600, 3))
    seen = PlaneMap(2.0, 1)
    seen.add(np.concatenate([wall, beyond[np.abs(beyond[:, 1]) > 2]]), 0, np.array([0.0, 0.5, 1.0]))
    assert len(seen.pairs(wall).points) > 0.99 * len(wall)


def test_a_plane_is_as_old_as_its_first_fit_not_as_its_voxel() -> None:
    planes, rng = PlaneMap(2.0, 1), np.random.default_rng(7)
    planes.add(rng.uniform(0.1, 1.9, (3, 3)) * [1, 1, 0] + [0, 0, 1], birth=0)
    flat = np.column_stack([rng.uniform(0.1, 1.9, (60, 2)), rng.normal(1.0, 0.002, 60)])
    planes.add(flat, birth=4)
    assert set(planes.pairs(flat).births.tolist()) == {4}


def test_map_keeps_near_planes_and_forgets_the_rest() -> None:
    planes, far = PlaneMap(2.0, 2), slope(4000, reach=3.0) + AWAY
    planes.add(np.concatenate([slope(4000, reach=3.0), far]), birth=3)
    before = len(planes)
    planes.keep(AWAY, 10.0)
    assert len(planes) == pytest.approx(before / 2, rel=0.2)
    assert planes.pairs(slope(50, reach=2.5)).known == 0.0
    pairs = planes.pairs(slope(50, reach=2.5, seed=8) + AWAY)
    assert pairs.known == 1.0
    np.testing.assert_allclose(np.abs(pairs.normals @ NORMAL), 1.0, atol=5e-3)
    planes.add(slope(4000, reach=3.0, seed=9), birth=4)
    assert set(planes.pairs(slope(50, reach=2.5)).births.tolist()) == {4}


def test_a_map_grows_beyond_its_first_rows_and_asks_of_an_empty_one_are_answered() -> None:
    planes = PlaneMap(2.0, 3)
    planes.add(np.zeros((0, 3)), birth=0)
    empty = planes.pairs(np.ones((3, 3)))
    assert (len(planes), empty.known, len(empty.points)) == (0, 0.0, 0)
    assert planes.pairs(np.zeros((0, 3))).known == 0.0
    planes.add(slope(60000, reach=40.0), birth=0)
    assert len(planes) > 3 * 1024
    pairs = planes.pairs(slope(500, reach=39.0, seed=2))
    np.testing.assert_allclose(np.abs(pairs.normals @ NORMAL), 1.0, atol=0.05)
