"""Points that stay: placed by the pose of their own stamp, one a cell, none of what moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dataflow.messages import Message, Odometry, PointCloud
from dataflow.view.layout import layout

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    from rrd_rows import at, draw

    from dataflow.view import SceneState, ViewOptions
    from dataflow.view.visualizers.clouds import KeptPoints, Points


def still(frame: str, stamp: int) -> Points:
    return np.eye(4)


def drawn(kept: KeptPoints, stamp: int, points: list[list[float]]) -> list[list[float]]:
    given = np.array(points, np.float64)
    paint = np.zeros((len(given), 3), np.uint8)
    return [row for _, placed, _ in kept.add(stamp, "sensor", given, paint, still) for row in placed.tolist()]


def test_a_cell_counts_once_and_only_when_it_was_seen_often_enough() -> None:
    kept = KeptPoints(step=0.1, after=3)
    seen = [drawn(kept, t, [[1.01, 0.0, 0.0], [1.02, 0.0, 0.0]]) for t in range(6)]
    assert seen == [[], [], [[1.01, 0.0, 0.0]], [], [], []]


def test_moving_objects_leave_no_kept_points() -> None:
    kept = KeptPoints(step=0.05, after=3)
    moving = [drawn(kept, t, [[0.1 * t, 0.0, 0.0], [0.0, 5.0, 0.0]]) for t in range(20)]
    assert [point for found in moving for point in found] == [[0.0, 5.0, 0.0]]


def test_cloud_waits_for_the_pose_at_its_stamp() -> None:
    poses: dict[int, Points] = {}
    kept = KeptPoints(step=0.1, after=1)
    point, paint = np.array([[1.0, 0.0, 0.0]]), np.array([[9, 8, 7]], np.uint8)
    assert list(kept.add(10, "sensor", point, paint, lambda frame, stamp: poses.get(stamp))) == []
    poses[10] = np.eye(4)
    poses[10][:3, 3] = (0.0, 2.0, 0.0)
    ((stamp, placed, painted),) = kept.add(20, "sensor", point, paint, lambda frame, stamp: poses.get(stamp))
    assert stamp == 10
    assert placed.tolist() == [[1.0, 2.0, 0.0]]
    assert painted.tolist() == [[9, 8, 7]]


def test_clouds_whose_pose_never_comes_do_not_pile_up() -> None:
    kept = KeptPoints(step=0.1, after=1)
    point, paint = np.zeros((1, 3)), np.zeros((1, 3), np.uint8)
    for stamp in range(100):
        assert list(kept.add(stamp, "sensor", point, paint, lambda frame, stamp: None)) == []
    found = list(kept.add(100, "sensor", point, paint, still))
    assert len(found) == 1, "one cell, however many clouds had waited"
    assert found[0][0] > 80


def test_points_too_far_off_for_a_cell_are_left_out() -> None:
    kept = KeptPoints(step=0.001, after=1)
    assert drawn(kept, 0, [[1e9, 0.0, 0.0], [0.0, 0.0, 0.0]]) == [[0.0, 0.0, 0.0]]


def test_kept_cloud_is_drawn_in_the_root_frame_by_the_pose_at_its_stamp(tmp_path: Path) -> None:
    types: dict[str, type[Message]] = {"r/cloud": PointCloud, "r/odometry": Odometry}
    state = SceneState(replace(layout(types), kept=frozenset({"r/cloud"})), ViewOptions(kept_after=2))
    told: list[tuple[str, Message]] = []
    for k in range(4):  # the robot drives on, the wall stays, and each pose comes after its cloud
        pose = {"position": [float(k), 0, 0], "orientation": [0, 0, 0, 1]}
        points = np.array([[5.0 - k, 0.0, 1.0]], np.float32)
        told.append(("r/cloud", PointCloud(stamp=10 * k, frame="base", points=points)))
        told.append(("r/odometry", Odometry(stamp=10 * k, frame="odom", child_frame="base", **pose)))
    found = draw(tmp_path, *told, scene=state)
    (drawn_points,) = at(found, "/r/cloud/space/kept", "Points3D:positions")
    assert np.allclose(drawn_points.values, [[5.0, 0.0, 1.0]])
    assert drawn_points.stamp == 10, "the second cloud that saw it"
    frames = at(found, "/r/cloud/space/kept", "CoordinateFrame:frame")
    assert frames[-1].values == ["odom"]
    assert all(frame.stamp is None for frame in frames), (
        "a viewer that shows later points, too, knows their frame at any time"
    )
    assert state.viewpoint.knows_more
