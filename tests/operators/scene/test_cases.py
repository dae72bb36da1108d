"""Books that stand in a shelf: their spines show, and their neighbours hide the rest of them."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import FOCAL, camera
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.scene.box_images import CORNERS, image_boxes, images, spines
from operators.scene.box_overlap import upright_iou
from operators.scene.cases import fronts, stands
from operators.scene.cells import Cells, standing_box
from operators.scene.class_sizes import CLASS_SIZES
from operators.scene.cuboid import Box, ImageView, fit_cuboid
from operators.scene.kinds import Kinds
from operators.scene.map_object import MapObject
from operators.scene.matching import MapSettings, Observation, in_image
from operators.scene.object_map import ObjectMap
from operators.scene.range_view import RangeView

Array = NDArray[np.float64]
K = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1.0]])
ALL = np.ones(4, np.bool_)
SIZE = np.array([0.16, 0.036, 0.23])
ROW: list[Box] = [(np.array([2.5, y, 1.0]), SIZE, 0.0) for y in (-0.04, 0.0, 0.04)]
OBLIQUE = [(1.0, 1.2), (1.2, 1.0), (1.1, 1.4), (0.9, 1.1), (1.3, 1.2)]
NAMES = ("book", "shelf", "mug")


def row_of(box: Box) -> Array:
    return np.array([[*box[0], *box[1], box[2]]])


def view_of(box: Box, x: float, y: float, *, hidden: bool) -> ImageView:
    """What a camera at (x, y), which looks at the book, shows of all of it, or of its spine alone."""
    pose = camera(1, (x, y, 1.0), yaw=float(np.arctan2(-y, 2.5 - x)), pitch=0.0)
    P, eye = K @ invert(pose.matrix())[:3], np.array(pose.position)
    image = image_boxes(row_of(box), P, np.array([False]))[0]
    if hidden:
        logs = row_of(box)
        logs[:, 3:6] = np.log(logs[:, 3:6])
        image[::2] = spines(logs, P[:, None], eye[None], 0.0)[0, 0, ::2]
    return ImageView(P, image, ALL, eye)


def spine_points(box: Box) -> Array:
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 4), np.linspace(-0.4, 0.4, 9)), axis=-1).reshape(-1, 2)
    return np.asarray(np.column_stack([np.full(len(grid), -0.5), grid]) * box[1] + box[0])


def fitted(box: Box, front: float | None, *, hidden: bool, before: tuple[int, Box] | None = None) -> Box:
    views = [view_of(box, *place, hidden=hidden) for place in OBLIQUE]
    points = spine_points(box)
    start = standing_box(points)
    return fit_cuboid(start, views, points, CLASS_SIZES["book"], before, 0.0, front=front)[1]


@pytest.mark.parametrize("hidden", [True, False], ids=["between others", "at the end of its row"])
@pytest.mark.parametrize("front", [0.0, np.pi], ids=["into the shelf", "out of it"])
def test_a_book_in_a_shelf_gets_its_place_whether_neighbours_hide_its_cover_or_not(front: float, hidden: bool) -> None:
    for book in ROW:
        assert upright_iou(fitted(book, front, hidden=hidden), book) > 0.6


def test_without_a_shelf_the_same_images_give_a_book_that_is_too_thin_or_turned() -> None:
    assert upright_iou(fitted(ROW[1], None, hidden=True), ROW[1]) < 0.3


def test_a_book_that_settled_as_one_that_shows_its_cover_is_turned_once_its_shelf_is_known() -> None:
    cover: Box = (ROW[1][0], np.array([0.03, 0.12, 0.23]), 0.0)  # as long along the row as a book is deep
    kept, turned = (fitted(ROW[1], front, hidden=True, before=(0, cover)) for front in (None, 0.0))
    assert kept[1][1] > kept[1][0]
    assert upright_iou(turned, ROW[1]) > 0.6


def entry(id: int, class_id: int, box: Box) -> MapObject:
    votes = np.zeros(len(NAMES))
    votes[class_id] = 1.0
    center, size, yaw = box
    c, s = np.cos(yaw), np.sin(yaw)
    made = MapObject(id, Cells(0.03), votes, 3.0, 0, 0)
    made.cells = Cells.of_each([(CORNERS * size) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) + center], 0.03)[0]
    made.center, made.size, made.yaw = box
    return made


@pytest.mark.parametrize(("size", "yaw"), [((0.3, 1.0, 1.4), 0.2), ((1.0, 0.3, 1.4), 0.2 - np.pi / 2)])
def test_what_stands_in_a_shelf_looks_to_its_front(size: tuple[float, float, float], yaw: float) -> None:
    kinds = Kinds((), {k: CLASS_SIZES[name] for k, name in enumerate(NAMES)})
    shelf = entry(1, 1, (np.array([2.5, 0.0, 0.8]), np.array(size), yaw))
    book, mug = (entry(2 + k, class_id, ROW[1]) for k, class_id in enumerate((0, 2)))
    far = entry(4, 0, (np.array([2.5, 1.5, 1.0]), SIZE, 0.0))
    found = fronts([book, mug, far], [shelf], kinds)
    assert abs(np.cos(found[0] - 0.2)) == pytest.approx(1.0)
    assert np.isnan(found[1:]).all()
    assert np.isnan(fronts([book], [], kinds)).all()
    assert fronts([], [shelf], kinds).shape == (0,)


def test_a_lying_book_does_not_stand() -> None:
    assert stands(entry(1, 0, ROW[0]))
    assert not stands(entry(1, 0, (ROW[0][0], np.array([0.16, 0.23, 0.04]), 0.0)))


@pytest.mark.parametrize("hidden", [True, False], ids=["its spine", "all of it"])
def test_what_an_image_shows_of_a_book_in_a_row_agrees_with_that_book(hidden: bool) -> None:
    seen = [Observation(spine_points(ROW[1]), 0, 0.9, image=view_of(ROW[1], *OBLIQUE[0], hidden=hidden))]
    rows = np.concatenate([row_of(box) for box in ROW])
    compared = in_image(seen, rows, np.zeros(3, np.bool_), np.zeros(3))
    alone = in_image(seen, rows, np.zeros(3, np.bool_), np.full(3, np.nan))
    assert compared is not None
    assert alone is not None
    assert compared.iou[0, 1] == pytest.approx(1.0, abs=1e-6)
    assert compared.iou[0, [0, 2]].max() < 0.7
    if hidden:  # whole boxes hold those of several spines, so that they agree as much with any
        assert alone.iou[0].max() < 0.4


SHELF: Box = (np.array([2.58, 0.0, 0.8]), np.array([0.32, 1.0, 1.4]), 0.0)


def mapped(*, shelf: bool) -> list[MapObject]:
    """The books of a map after views of a row of them that stands in a shelf, or in none; each view misses one book."""
    known = ObjectMap(len(NAMES), (), MapSettings(), {k: CLASS_SIZES[name] for k, name in enumerate(NAMES)})
    for k in range(36):
        x, y = OBLIQUE[k % len(OBLIQUE)]
        y += 0.02 * (k % 7)
        shown = [book for j, book in enumerate(ROW) if j != k % 3]
        seen = [Observation(spine_points(book), 0, 0.9, image=view_of(book, x, y, hidden=True)) for book in shown]
        if shelf:
            seen.append(Observation(spine_points(SHELF), 1, 0.9, image=view_of(SHELF, x, y, hidden=False)))
        T = camera(1, (x, y, 1.0), yaw=float(np.arctan2(-y, 2.5 - x)), pitch=0.0).matrix()
        points = np.concatenate([each.points for each in seen])
        known.update((k + 1) * 250_000_000, seen, RangeView((points - T[:3, 3]) @ T[:3, :3], T, 0.012))
    return [each for each in known.confirmed() if each.class_id == 0]


def test_a_row_of_books_seen_at_an_angle_is_mapped_book_by_book_once_its_shelf_is() -> None:
    inside, alone = (mapped(shelf=shelf) for shelf in (True, False))
    assert len(inside) == len(ROW)
    for book in ROW:
        assert max(upright_iou(each.box, book) for each in inside) > 0.5
    assert min(max(upright_iou(each.box, book) for each in alone) for book in ROW) < 0.3


def test_spines_are_the_sides_that_are_seen_whichever_way_a_box_is_written() -> None:
    view = view_of(ROW[0], *OBLIQUE[0], hidden=False)
    one = row_of(ROW[0])
    other = np.array([[*ROW[0][0], SIZE[1], SIZE[0], SIZE[2], np.pi / 2]])
    for rows in (one, other):
        rows[:, 3:6] = np.log(rows[:, 3:6])
    found = [spines(rows, view.P[:, None], view.eye[None], 0.0) for rows in (one, other)]
    np.testing.assert_allclose(found[0], found[1])
    near = images(one, view.P[:, None], CORNERS[CORNERS[:, 0] < 0])
    np.testing.assert_allclose(found[0], near)
    behind = view.eye + np.array([3.0, 0, 0])  # from the other side the other one is seen
    assert not np.allclose(spines(one, view.P[:, None], behind[None], 0.0), near)
