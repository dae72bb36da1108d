"""Groups of places within reach of each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from operators.scene.lifting.frustums import _DENSE, LiftSettings, ProjectedCloud, _divided, _image, _linked, lift

REACH = 0.1


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 100, _DENSE, _DENSE + 1])
def test_places_linked_directly_or_by_others_are_one_group(count: int) -> None:
    places = np.random.default_rng(count).uniform(0, 0.5, (count, 3))
    near = np.linalg.norm(places[:, None] - places[None], axis=2) <= REACH
    _, expected = connected_components(near, directed=False)
    groups = _linked(places, REACH)
    assert (np.unique(groups, return_inverse=True)[1] == expected).all()  # numbered in the order of their first places


def test_a_chain_is_one_group_whatever_its_order() -> None:
    places = np.stack([np.arange(50) * 0.09, np.zeros(50), np.zeros(50)], axis=1)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(50)
        assert (_linked(places[order], REACH) == 0).all()


@pytest.mark.parametrize(("count", "cut"), [(60, 0), (99, 0), (250, 2)])
def test_one_in_a_hundred_pixels_may_stray_from_the_image_of_a_thing(count: int, cut: int) -> None:
    u, v = np.random.default_rng(count).uniform(0, 100, (2, count))
    seen = ProjectedCloud(
        np.zeros((count, 3)), np.stack([u, v], axis=1), np.ones(count, bool), np.array([0, 0, 1.0]), grain=1.5
    )
    low, high = np.sort(u)[[cut, -1 - cut]], np.sort(v)[[cut, -1 - cut]]
    assert _image(seen, u, v) == (low[0] - 1.5, high[0] - 1.5, low[1] + 1.5, high[1] + 1.5)


def test_points_in_two_boxes_go_to_the_one_whose_middle_is_nearer_by_its_sides() -> None:
    pixels = np.random.default_rng(5).uniform(0, 100, (300, 2))
    boxes = np.array([[0.0, 0, 60, 100], [40, 0, 100, 80]])
    inside = [np.flatnonzero(((pixels >= box[:2]) & (pixels <= box[2:])).all(axis=1)) for box in boxes]
    kept = _divided(np.ascontiguousarray(pixels.T), boxes, [(0, inside[0], 0.9), (1, inside[1], 0.8)], ())
    away = [np.abs((pixels - (b[:2] + b[2:]) / 2) / (b[2:] - b[:2])).max(axis=1) for b in boxes]
    both = np.intersect1d(*inside)
    second = np.concatenate([np.setdiff1d(inside[1], both), both[away[1][both] < away[0][both]]])
    np.testing.assert_array_equal(kept[1], np.sort(second))
    np.testing.assert_array_equal(kept[0], np.setdiff1d(inside[0], second))


def behind_slats(slats: int) -> ProjectedCloud:
    """A chair's back of slats 2 m away, before a wall at 3 m, which shows between them and around it; f = 500."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(200.0, 440, 4), np.arange(140.0, 340, 4)))
    back = (np.abs(u - 320) <= 50) & (np.abs(v - 240) <= 50)
    depth = np.where(back & ((v - 190) % (100 / slats) < 8), 2.0, 3.0)
    points = np.column_stack([(u - 320) / 500, (v - 240) / 500, np.ones(len(u))]) * depth[:, None]
    return ProjectedCloud(points, np.column_stack([u, v]), np.ones(len(u), bool), np.array([0.0, -1, 0]), grain=2.0)


@pytest.mark.parametrize("slats", [4, 5])
def test_a_wall_that_shows_through_a_chairs_back_is_not_the_chair(slats: int) -> None:
    seen = behind_slats(slats)
    (found,) = lift(seen, np.array([[268.0, 188, 372, 292]]), [-1], [], LiftSettings())
    assert set(seen.points[found.points, 2]) == {2.0}


def test_cup_in_front_of_a_boxed_object_is_excluded_from_it() -> None:
    seen = behind_slats(4)
    seen.points[:] *= 3.0 / seen.points[:, 2:]
    cup = (np.abs(seen.pixels - [320, 240]) <= 15).all(axis=1)
    seen.points[cup] *= 2 / 3
    (found,) = lift(seen, np.array([[268.0, 188, 372, 292]]), [-1], [], LiftSettings())
    assert set(seen.points[found.points, 2]) == {3.0}


def test_pixel_columns_return_the_points_between_two_places() -> None:
    rng = np.random.default_rng(3)
    u, v = rng.uniform(0, 640, 4000), rng.uniform(0, 480, 4000)
    inside = rng.random(4000) < 0.8
    seen = ProjectedCloud(np.zeros((4000, 3)), np.stack([u, v], axis=1), inside, np.array([0, 0, 1.0]))
    for left, right in [(100.3, 231.7), (-50.0, 12.0), (630.0, 900.0), (-9.0, -2.0), (700.0, 800.0)]:
        first, last = seen.columns.between(left, right)
        rows = seen.columns.order[first:last]
        assert set(np.flatnonzero(inside & (u >= left) & (u <= right))) <= set(rows)
        assert inside[rows].all()
        assert ((u[rows] > left - 1) & (u[rows] < right + 1)).all()
