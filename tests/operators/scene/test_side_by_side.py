"""Shelves that stand side by side at a wall, seen by one camera: made rooms in which all distances are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.scene.class_sizes import CLASS_SIZES
from operators.scene.cuboid import ImageView
from operators.scene.matching import MapSettings, Observation
from operators.scene.object_map import ObjectMap
from operators.scene.range_view import RangeView
from operators.scene.side_by_side import image_of_part, largest_part

Array = NDArray[np.float64]

WALL, FRONT = 4.35, 4.0  # metres ahead of the camera
LEFT, RIGHT = (0.1, 0.9), (-1.3, -0.2)  # metres along the wall
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def camera(y: float = 0.0) -> Array:
    """The pose of a camera 1.2 m above the floor that looks along x."""
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = [0, y, 1.2]
    return T


def panel(x: float, low: float, high: float, top: float = 1.4) -> Array:
    """Points of an upright surface across x that stands on the floor, 3 cm apart."""
    return np.stack(np.meshgrid([x], np.arange(low, high, 0.03), np.arange(0.0, top, 0.03)), axis=-1).reshape(-1, 3)


def hidden(points: Array, T: Array, x: float, low: float, high: float, top: float = 1.4) -> NDArray[np.bool_]:
    """Which points (N, 3) are behind a panel."""
    way = points - T[:3, 3]
    at = T[:3, 3] + way * (x / way[:, :1])
    return np.asarray((at[:, 2] < top) & (at[:, 1] > low) & (at[:, 1] < high))


def viewed(surfaces: list[Array], T: Array) -> RangeView:
    return RangeView((np.concatenate(surfaces) - T[:3, 3]) @ T[:3, :3], T, 0.012)


def test_shelves_between_which_the_wall_shows_are_two() -> None:
    left, right = panel(FRONT, *LEFT), panel(FRONT, *RIGHT)
    both = np.concatenate([left, right])
    kept = largest_part(both, 0.0, viewed([both, panel(WALL, -3, 3, 2.4)], camera()), 0.1)
    assert kept is not None
    assert (both[kept, 1] < 0).all()
    assert kept.sum() == len(right)


def test_what_hides_the_middle_of_a_shelf_does_not_make_it_two() -> None:
    both = np.concatenate([panel(FRONT, *LEFT), panel(FRONT, *RIGHT)])
    place, wall = (3.0, -0.35, 0.3, 1.6), panel(WALL, -3, 3, 2.4)
    wall, both = (each[~hidden(each, camera(), *place)] for each in (wall, both))
    assert largest_part(both, 0.0, viewed([both, panel(*place), wall], camera()), 0.1) is None


def test_one_shelf_whose_boards_go_through_is_one() -> None:
    boards = np.concatenate([panel(FRONT, -1.0, 0.9, 0.06) + np.array([0, 0, z]) for z in (0.0, 0.45, 0.9, 1.35)])
    sides = np.concatenate([panel(FRONT, -1.0, -0.95), panel(FRONT, 0.85, 0.9)])
    shelf = np.concatenate([boards, sides])
    assert largest_part(shelf, 0.0, viewed([shelf, panel(WALL, -3, 3, 2.4)], camera()), 0.1) is None


@pytest.mark.parametrize(("left", "edge"), [(True, 2), (False, 0)])
def test_the_image_of_a_part_ends_where_the_part_does(left: bool, edge: int) -> None:
    both = np.concatenate([panel(FRONT, *LEFT), panel(FRONT, *RIGHT)])
    T = camera()
    image = ImageView(K @ invert(T)[:3], np.array([200.0, 200, 490, 390]), np.ones(4, np.bool_), T[:3, 3])
    part = image_of_part(image, both, (both[:, 1] > 0) == left)
    assert np.flatnonzero(~part.edges).tolist() == [edge]
    column = 320 - 500 * (LEFT[0] if left else RIGHT[1]) / FRONT
    assert part.box[edge] == pytest.approx(column, abs=4.0)
    assert np.delete(part.box, edge).tolist() == np.delete(image.box, edge).tolist()


def test_shelves_whose_image_boxes_reach_into_each_other_become_two_entries() -> None:
    """In every view each box holds a third of a metre of the other shelf, as those of a detector do."""
    known = ObjectMap(1, [], MapSettings(), {0: CLASS_SIZES["shelf"]})
    wall = panel(WALL, -3, 3, 2.4)
    for k in range(24):
        T = camera(0.4 * np.sin(k))
        behind = hidden(wall, T, FRONT, *LEFT) | hidden(wall, T, FRONT, *RIGHT)
        both = np.concatenate([panel(FRONT, *LEFT), panel(FRONT, *RIGHT)])
        seen = []
        for low, high in ((LEFT[0] - 0.65, LEFT[1]), (RIGHT[0], RIGHT[1] + 0.65)):
            own = both[(both[:, 1] > low) & (both[:, 1] < high)]
            P = K @ invert(T)[:3]
            uv = own @ P[:, :3].T + P[:, 3]
            uv = uv[:, :2] / uv[:, 2:]
            box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
            seen.append(Observation(own, 0, 0.8, None, ImageView(P, box, np.ones(4, np.bool_), T[:3, 3])))
        known.update((k + 1) * 250_000_000, seen, viewed([both, wall[~behind]], T))
    shelves = sorted(known.confirmed(), key=lambda o: float(o.center[1]))
    assert [round(float(o.center[1]), 1) for o in shelves] == pytest.approx([-0.75, 0.5], abs=0.1)
    assert [float(o.size[:2].max()) for o in shelves] == pytest.approx([1.1, 0.8], abs=0.15)
