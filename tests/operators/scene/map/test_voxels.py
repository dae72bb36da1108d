"""Voxels of an object, as a plain dictionary would keep them."""

from __future__ import annotations

import numpy as np
import pytest

from operators.scene.map.voxels import VoxelSet, keys_of

SIDE = 0.1


def view(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-0.3, 0.3, (rng.integers(1, 60), 3))


@pytest.mark.parametrize("seed", range(5))
def test_views_are_added_as_a_dictionary_of_voxels_would_add_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    voxels = VoxelSet(SIDE)
    means: dict[int, tuple[np.ndarray, int, int]] = {}  # by voxel: mean, hits, views that saw through
    for _ in range(6):
        points = view(rng)
        voxels.add(VoxelSet.of(points, SIDE))
        keys = keys_of(points, SIDE)
        for key in np.unique(keys).tolist():
            mean, hits, free = means.get(key, (np.zeros(3), 0, 0))
            own = points[keys == key].mean(axis=0)
            means[key] = (mean * hits + own) / (hits + 1), hits + 1, max(free - 1, 0)
        seen_through = rng.random(len(voxels)) < 0.2
        voxels.carve(seen_through)
        for key, through in zip(sorted(means), seen_through.tolist(), strict=True):
            mean, hits, free = means[key]
            means[key] = mean, hits, free + through
        means = {key: row for key, row in means.items() if not (row[2] >= 3 and row[2] > 0.5 * row[1])}
    rows = [means[key] for key in sorted(means)]
    np.testing.assert_allclose(voxels.points, [mean for mean, _, _ in rows], atol=1e-12)
    np.testing.assert_array_equal(voxels.hits, [hits for _, hits, _ in rows])
    np.testing.assert_array_equal(voxels.free, [free for _, _, free in rows])


def test_sets_of_points_have_the_same_voxels_together_and_alone() -> None:
    rng = np.random.default_rng(1)
    sets = [view(rng), np.zeros((0, 3)), view(rng), view(rng) + 0.01]
    for points, together in zip(sets, VoxelSet.of_each(sets, SIDE), strict=True):
        alone = VoxelSet(SIDE)
        for key in sorted({*keys_of(points, SIDE).tolist()}):
            alone.add(VoxelSet.of(points[keys_of(points, SIDE) == key], SIDE))
        np.testing.assert_array_equal(together.points, alone.points)
        np.testing.assert_array_equal(together.hits, np.ones(len(alone)))


@pytest.mark.parametrize("count", [5, 2000])  # each with each, and by a tree
def test_points_near_voxels_are_those_within_the_distance_of_one(count: int) -> None:
    rng = np.random.default_rng(2)
    voxels, points = VoxelSet.of(view(rng), SIDE), rng.uniform(-0.6, 0.6, (count, 3))
    apart = np.linalg.norm(points[:, None] - voxels.points[None], axis=2).min(axis=1)
    found = voxels.near_each(points, 0.15)
    np.testing.assert_array_equal(found, apart < 0.15)
    assert 0 < found.sum() < count
    assert not VoxelSet(SIDE).near_each(points, 0.15).any()


def test_bounds_are_as_far_apart_as_along_the_axis_of_the_widest_gap() -> None:
    first = VoxelSet.of(np.array([[0.0, 0, 0], [1, 1, 1]]), SIDE)
    second = VoxelSet.of(np.array([[1.2, 0.5, 0.5], [2, 2, 2]]), SIDE)
    assert first.apart(second) == pytest.approx(0.2)
    assert second.apart(first) == first.apart(second)
    assert first.apart(first) < 0
    assert first.apart(VoxelSet(SIDE)) == np.inf


def test_voxels_that_others_have_too_are_theirs_unless_too_few_would_be_left() -> None:
    grid = np.stack(np.meshgrid(np.arange(8), np.arange(8), [0]), axis=-1).reshape(-1, 3) * SIDE + SIDE / 2
    voxels, half, most = VoxelSet.of(grid, SIDE), VoxelSet.of(grid[grid[:, 0] > 0.4], SIDE), VoxelSet.of(grid[5:], SIDE)
    assert {*keys_of(voxels.sure([half, VoxelSet(SIDE)]), SIDE)} == {*keys_of(grid[grid[:, 0] < 0.4], SIDE)}
    assert len(voxels.sure([most])) == len(voxels.sure()) == len(grid)


def test_confirmed_voxels_away_from_those_shown_are_doubted() -> None:
    rng = np.random.default_rng(4)
    voxels, shown = (VoxelSet.of(rng.uniform(-0.5, 0.5, (count, 3)), SIDE) for count in (900, 200))
    confirmed = rng.random(len(voxels)) < 0.6
    apart = np.linalg.norm(voxels.points[:, None] - shown.points[None], axis=2).min(axis=1)
    voxels.doubt(confirmed, shown, 3)
    np.testing.assert_array_equal(voxels.other, 3.0 * (confirmed & (apart >= 1.5 * SIDE)))
    assert 0 < np.count_nonzero(voxels.other) < np.count_nonzero(confirmed)
