"""Boxes from the image boxes of several views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_scene import FOCAL, camera
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.labels import LabelSpace, labels_file
from operators.scene.bodies import shared_volume, upright_iou
from operators.scene.map.cuboid import Box, ImageView, _surface, fit_cuboid, image_boxes, images
from operators.scene.map.voxels import standing_box

K = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1.0]])
ALL = np.ones(4, np.bool_)
BOOK: Box = (np.array([2.5, 0.1, 1.0]), np.array([0.16, 0.04, 0.23]), 0.1)
SIDEWAYS = [0.0, 0.25, -0.3, 0.5, -0.5]
SIMULATOR = LabelSpace.read(Path(labels_file("simulator")))


def view_of(box: Box, y: float, noise: float = 0.0) -> ImageView:
    pose = camera(1, (0.2, y, 1.0), pitch=0.0)
    P = K @ invert(pose.matrix())[:3]
    image = image_boxes(np.array([[*box[0], *box[1], box[2]]]), P, np.array([False]))[0]
    stray = np.random.default_rng(int(1000 + 100 * y)).normal(0, noise, 4)
    return ImageView(P, image + stray, ALL, np.array(pose.position))


def spine(box: Box) -> NDArray[np.float64]:
    """Points on the side of a box that faces the cameras."""
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 4), np.linspace(-0.4, 0.4, 9)), axis=-1).reshape(-1, 2)
    local = np.column_stack([np.full(len(grid), -0.5), grid]) * box[1]
    c, s = np.cos(box[2]), np.sin(box[2])
    return np.asarray(local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) + box[0])


@pytest.mark.parametrize("noise", [0.0, 0.7], ids=["exact", "noisy"])
def test_book_seen_by_its_spine_is_completed_without_overlapping_its_neighbour(noise: float) -> None:
    beside: Box = (BOOK[0] + [0, 0.045, 0], BOOK[1], BOOK[2])
    found = []
    for box in (BOOK, beside):
        points = spine(box)
        views = [view_of(box, y, noise) for y in SIDEWAYS]
        found.append(fit_cuboid(standing_box(points), views, points, SIMULATOR.sizes("book"))[1])
        assert upright_iou(found[-1], box) > (0.7 if noise == 0 else 0.45)
    assert shared_volume(found[0], found[1]) < 0.35 * float(np.prod(BOOK[1]))


def test_without_a_usual_size_views_from_all_around_give_the_box() -> None:
    crate: Box = (np.array([2.5, 0.0, 0.9]), np.array([0.4, 0.3, 0.5]), 0.3)
    views = [view_of(crate, y) for y in (-1.5, -0.7, 0.0, 0.7, 1.5)]
    points = spine(crate)
    fitted = fit_cuboid(standing_box(points), views, points, ())[1]
    assert upright_iou(fitted, crate) > 0.6


def test_edges_that_the_image_cuts_off_do_not_count() -> None:
    table: Box = (np.array([2.5, 0.0, 0.4]), np.array([0.7, 1.5, 0.75]), 0.0)
    whole = [view_of(table, y) for y in (-0.4, 0.0, 0.4)]
    cut = [
        ImageView(v.P, np.minimum(v.box, [500, 500, 150, 500]), ALL & ([True] * 2 + [False, True]), v.eye)
        for v in whole
    ]
    points = spine(table)
    first, second = (fit_cuboid(standing_box(points), v, points, SIMULATOR.sizes("table"))[1] for v in (whole, cut))
    assert upright_iou(first, second) > 0.7


def test_a_box_that_is_partly_behind_the_camera_has_no_image() -> None:
    P = view_of(BOOK, 0.0).P
    assert np.isnan(image_boxes(np.array([[0.2, 0, 1, 0.5, 0.5, 0.5, 0]]), P, np.array([False]))).all()


def test_leaves_inside_their_box_do_not_push_it_away_from_the_viewer() -> None:
    plant: Box = (np.array([2.5, 0.0, 0.9]), np.array([0.12, 0.12, 0.23]), 0.0)
    leaves = spine(plant) + np.array([0.03, 0.0, 0.0])
    center, _, _ = fit_cuboid(
        standing_box(leaves), [view_of(plant, y) for y in SIDEWAYS], leaves, SIMULATOR.sizes("plant"), noise=0.0012
    )[1]
    assert abs(center[0] - 2.5) < 0.02


def test_range_noise_does_not_pull_the_box_towards_the_viewer() -> None:
    far: Box = (np.array([4.7, 0.1, 1.0]), np.array([0.16, 0.04, 0.23]), 0.0)
    points = np.concatenate([spine(far)] * 3)
    points[:, 0] += np.random.default_rng(7).normal(0, 0.0012 * 4.4**2, len(points))
    views = [view_of(far, y) for y in SIDEWAYS]
    start, usual = standing_box(points), SIMULATOR.sizes("book")
    single, accumulated = (
        fit_cuboid(start, views, points, usual, noise=0.0012, raw=raw)[1][0] for raw in (True, False)
    )
    assert abs(single[0] - 4.7) < 0.015 < 4.7 - accumulated[0]


def test_occluder_points_do_not_pull_the_box_towards_the_viewer() -> None:
    """Raw points of a far bottle, of which one in fifteen is of what hides a brink of it."""
    bottle: Box = (np.array([4.5, 0.0, 1.0]), np.array([0.07, 0.07, 0.25]), 0.0)
    rng = np.random.default_rng(5)
    around, z = rng.uniform(np.pi / 2, 3 * np.pi / 2, 45), rng.uniform(0.88, 1.12, 45)
    points = np.column_stack([4.5 + 0.035 * np.cos(around), 0.035 * np.sin(around), z])
    points[::15, 0] -= 0.15
    views = [view_of(bottle, y) for y in SIDEWAYS]
    usual = SIMULATOR.sizes("bottle")
    raw, all_but_outermost = (
        fit_cuboid(standing_box(points), views, points, usual, raw=raw)[1][0] for raw in (True, False)
    )
    assert abs(raw[0] - 4.5) < 0.015
    assert 4.5 - all_but_outermost[0] > 0.03


def test_where_a_sharp_camera_looks_an_edge_strays_by_more_pixels() -> None:
    """Cameras are calibrated to an angle: a view that is off by it leaves the same doubt with four times the pixels."""
    points, usual, sharp = spine(BOOK), SIMULATOR.sizes("book"), np.diag([4.0, 4.0, 1.0])
    views = [view_of(BOOK, y) for y in SIDEWAYS]
    views[2] = replace(views[2], box=views[2].box + 3.0)
    fine = [replace(view, P=sharp @ view.P, box=4 * view.box) for view in views]
    coarse, by_fine = (fit_cuboid(standing_box(points), each, points, usual)[2][2] for each in (views, fine))
    assert by_fine < 2.0 * coarse


def test_fit_reveals_the_view_of_another_thing() -> None:
    beside: Box = (BOOK[0] + [0, 0.07, 0], BOOK[1], BOOK[2])
    views = [view_of(beside if k == 2 else BOOK, y, 0.5) for k, y in enumerate(SIDEWAYS)]
    points = spine(BOOK)
    strays = fit_cuboid(standing_box(points), views, points, SIMULATOR.sizes("book"))[2]
    assert np.argmax(strays) == 2
    assert strays[2] > 2.5 > np.delete(strays, 2).max()


@pytest.mark.parametrize("before", [None, 0], ids=["open", "settled before the room's heading was known"])
def test_shelf_is_aligned_with_the_room_despite_views_of_its_neighbour(before: int | None) -> None:
    """Boxes in the image of a shelf and a part of its neighbour, which some views show as one."""
    shelf: Box = (np.array([2.8, 0.0, 0.7]), np.array([0.31, 1.0, 1.4]), 0.0)
    askew: Box = (shelf[0], np.array([0.31, 1.0, 1.4]), 0.25)
    views = [view_of(askew, y) for y in SIDEWAYS]
    points = spine(askew)
    settled = None if before is None else (before, askew)
    start, usual = standing_box(points), SIMULATOR.sizes("shelf")
    free, along = (fit_cuboid(start, views, points, usual, settled, h)[1][2] for h in (None, 0.0))
    off = [abs(np.remainder(yaw + np.pi / 4, np.pi / 2) - np.pi / 4) for yaw in (free, along)]
    assert off[0] > 0.2
    assert off[1] < 0.05


def boxes_and_views(count: int, views: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Boxes (K, 7), centre, log sizes and heading, and views (3, V, 4); some of the boxes are partly behind."""
    rng = np.random.default_rng(views)
    rows = rng.normal([0, 0, 2.0, -1, -1, -1, 0], 0.4, (count, 7))
    rows[0, 2] = -3.0
    P = np.stack([np.column_stack([K @ np.eye(3), rng.normal(0, 0.3, 3)]) for _ in range(views)], axis=1)
    return rows, P


@pytest.mark.parametrize(("count", "views"), [(64, 1), (8, 16), (5, 3)])
def test_images_of_boxes_hold_the_corners_as_each_view_projects_them(count: int, views: int) -> None:
    rows, P = boxes_and_views(count, views)
    outline = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    found = images(rows, P, outline)
    for k, row in enumerate(rows):
        c, s = np.cos(row[6]), np.sin(row[6])
        corners = (outline * np.exp(row[3:6])) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) + row[:3]
        for v in range(views):
            seen = corners @ P[:, v, :3].T + P[:, v, 3]
            if seen[:, 2].min() < 0.1:
                assert np.isnan(found[k, v]).all()
                continue
            uv = seen[:, :2] / seen[:, 2:]
            np.testing.assert_allclose(found[k, v], [*uv.min(axis=0), *uv.max(axis=0)], rtol=1e-12)
    assert 0 < np.isnan(found).sum() < found.size


@pytest.mark.parametrize(("count", "cut"), [(12, 0), (45, 4)])  # all points, and all but the outermost
def test_sides_are_compared_with_the_extents_of_points_in_the_axes_of_their_box(count: int, cut: int) -> None:
    rng = np.random.default_rng(count)
    rows, points, eyes = boxes_and_views(9, 1)[0], rng.normal([0, 0, 2.0], 0.5, (count, 3)), rng.normal(0, 1, (4, 3))
    found = _surface(rows, np.concatenate([points, eyes]).T.copy(), count, cut, 0.01, 0.1)
    for k, row in enumerate(rows):
        c, s = np.cos(row[6]), np.sin(row[6])
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        own, seen = np.sort((points - row[:3]) @ turn.T, axis=0), (eyes - row[:3]) @ turn.T
        half = np.exp(row[3:6]) / 2
        beyond = np.concatenate([own[cut] + half, half - own[-1 - cut]])
        beyond += np.tile(0.01 * np.abs(seen).mean(axis=0) ** 2, 2) - 0.1 * np.tile(half, 2)
        shown = np.concatenate([(seen < -half).mean(axis=0), (seen > half).mean(axis=0)]) > 0.3
        np.testing.assert_allclose(found[k], np.where(shown, beyond, np.minimum(beyond, 0)) / 0.02, atol=1e-9)
