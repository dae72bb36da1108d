"""From where a scene is looked at: what was seen and driven is in view, and fills it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from dataflow.view.frames import FramePriority
from dataflow.view.viewpoint import ViewerPose

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    from dataflow.view.scene import SceneState


def in_image(looked: ViewerPose, points: np.ndarray) -> np.ndarray:
    """Where points are in a view of 50 degrees that is 1.2 times as wide as high: its edges are at -1 and 1."""
    assert looked.position is not None
    assert looked.target is not None
    ahead = (looked.target - looked.position) / np.linalg.norm(looked.target - looked.position)
    right = np.cross(ahead, looked.up)
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(right, ahead), ahead])
    x, y, depth = axes @ (points - looked.position).T
    half = np.tan(np.radians(25))
    return np.where(depth > 0, np.array([x / depth / (1.2 * half), y / depth / half]), np.inf)


def in_view(looked: ViewerPose, points: np.ndarray) -> bool:
    return bool(np.abs(in_image(looked, points)).max() < 1)


def fills(looked: ViewerPose, points: np.ndarray) -> float:
    """The larger share of the view's width and height that points take up."""
    return float(np.ptp(in_image(looked, points), axis=1).max() / 2)


def test_where_a_sensor_scans_all_round_the_whole_place_is_in_view() -> None:
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    room = np.column_stack([3 + 5 * np.cos(turn), 4 * np.sin(turn), np.linspace(-0.5, 2, 64)])
    ahead = np.abs(room)
    around, before = SceneState(), SceneState()
    for scene, points in ((around, room - [1, 0, 0]), (before, ahead)):
        scene.tree.place("world", "lidar", np.array([[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
                         owner="r/base", rank=FramePriority.TREE, stamp=0)  # fmt: skip
        scene.viewpoint.saw_points(scene.tree.pose("lidar"), points)

    looked = around.viewpoint.outlook(around.tree)
    assert in_view(looked, room)
    assert looked.position is not None
    assert looked.target is not None
    assert looked.position[2] > 4
    assert np.linalg.norm(looked.position - looked.target) > 5
    nearer = before.viewpoint.outlook(before.tree).position
    assert nearer is not None
    assert nearer[2] < looked.position[2]


def test_the_whole_way_of_a_run_without_ranges_is_in_view_when_it_is_over() -> None:
    scene, away = SceneState(), np.eye(4)
    away[:3, 3] = [10, 0, 0]
    for x in np.linspace(0, 40, 5000):
        scene.viewpoint.saw_places(away, [x, 4 * np.sin(x), 0])
    scene.viewpoint.posed.setdefault("base")
    scene.tree.place("world", "base", np.eye(4), owner="r/base", rank=FramePriority.TREE, stamp=0)
    assert scene.viewpoint.knows_more

    begun = scene.viewpoint.outlook(scene.tree)
    over = scene.viewpoint.outlook(scene.tree, whole=True)

    x = np.linspace(11, 49, 100)
    way = np.column_stack([x, 4 * np.sin(x - 10), np.zeros(100)])
    assert begun.target is not None
    assert np.linalg.norm(begun.target) < 5
    assert in_view(over, way)
    assert fills(over, way) > 0.5


@pytest.mark.parametrize("far", [1.0, 4.0])
def test_viewpoint_covers_the_trajectory_and_the_last_camera_view(far: float) -> None:
    scene, shift = SceneState(), np.eye(4)
    ahead = np.stack(np.meshgrid([2.0 * far, 3.0 * far], np.linspace(-far, far, 9), np.linspace(-0.3, far, 9)), -1)
    for x in np.linspace(0, 3, 40):
        shift[0, 3] = x
        scene.tree.place("world", "camera", shift, owner="r/camera", rank=FramePriority.TREE, stamp=round(1e9 * x))
        scene.viewpoint.saw_places(np.eye(4), [x, 0, 0])
        scene.viewpoint.saw_points(scene.tree.pose("camera"), ahead.reshape(-1, 3))
    scene.viewpoint.posed.setdefault("camera")

    over = scene.viewpoint.outlook(scene.tree, whole=True)

    seen = np.concatenate([ahead.reshape(-1, 3) + np.array([3, 0, 0]), [[0, 0, 0], [3, 0, 0]]])
    assert in_view(over, seen)
    assert fills(over, seen) > 0.5


def test_a_way_too_long_to_be_in_view_leaves_the_view_as_it_was() -> None:
    scene = SceneState()
    for x in range(0, 300, 3):
        scene.viewpoint.saw_places(np.eye(4), [x, 0, 0])
    scene.viewpoint.saw_range(np.full(10, 2.0))
    before, over = (scene.viewpoint.outlook(scene.tree, whole=whole).position for whole in (False, True))
    assert np.array_equal(before, over)
