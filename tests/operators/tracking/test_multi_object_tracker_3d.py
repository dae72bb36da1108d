"""MultiObjectTracker3D on boxes whose motion is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from repeated import assert_repeats

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Boxes3D, Pose, Tracks, TrackState
from dataflow.messages.geometry import quaternion_from_yaw, quaternion_to_matrix, yaw_of
from dataflow.testing import play
from operators.tracking import MultiObjectTracker3D

FRAME = 100_000_000  # ns


def boxes(k: int, centers: Any, yaws: Any = 0.0, score: float = 0.9, sizes: Any = (0.6, 0.4, 1.7)) -> Boxes3D:
    points = np.array(centers, np.float64).reshape(-1, 3)
    count = len(points)
    return Boxes3D(
        stamp=(k + 1) * FRAME, frame="world", class_names=("person",), centers=points,
        sizes=np.broadcast_to(np.array(sizes, np.float64), (count, 3)),
        orientations=quaternion_from_yaw(np.broadcast_to(np.array(yaws, np.float64), (count,))).reshape(-1, 4),
        scores=np.full(count, score, np.float32), class_ids=np.zeros(count, np.int32),
    )  # fmt: skip


def tracked(given: Sequence[Boxes3D], **params: Any) -> list[Tracks]:
    return play(MultiObjectTracker3D(**params), {"boxes": given})["tracks"]


def ids(message: Tracks, state: TrackState = TrackState.CONFIRMED) -> list[int]:
    return message.ids[message.states == state].tolist()


def test_place_velocity_and_extent_are_those_of_a_noisy_walk() -> None:
    rng = np.random.default_rng(1)
    velocity = np.array([0.9, -0.4, 0.0])
    given = [
        boxes(k, np.array([1, 2, 0.85]) + velocity * k / 10 + rng.normal(0, 0.05, 3), np.arctan2(-0.4, 0.9))
        for k in range(40)
    ]
    last = tracked(given)[-1]
    assert ids(last) == [1]
    error = np.concatenate([last.positions[0] - ([1, 2, 0.85] + velocity * 3.9), last.velocities[0] - velocity])
    np.testing.assert_allclose(error, 0, atol=0.25)
    assert error @ np.linalg.solve(last.covariances[0], error) < 20
    np.testing.assert_allclose(last.sizes[0], [0.6, 0.4, 1.7], atol=1e-6)


def test_a_walker_faces_its_way_though_boxes_leave_half_a_turn_open() -> None:
    given = [boxes(k, [0.1 * k, 0, 0.85], np.pi if k % 2 else 0.0) for k in range(20)]
    last = tracked(given)[-1]
    assert float(yaw_of(last.orientations)[0]) == pytest.approx(0, abs=0.05)


def test_ids_outlast_a_crossing_with_one_of_the_two_hidden() -> None:
    given = []
    for k in range(50):
        rows = [[0.1 * k, 0.0, 0.85]]
        if not 22 <= k <= 28:
            rows.append([5 - 0.1 * k, 0.5, 0.85])
        given.append(boxes(k, rows))
    messages = tracked(given)
    assert ids(messages[25], TrackState.COASTING) == [2]
    assert ids(messages[-1]) == [1, 2]
    assert messages[-1].positions[0, 0] > 4 > 1 > messages[-1].positions[1, 0]


def test_a_pose_puts_boxes_of_a_tilted_sensor_upright() -> None:
    """The optical frame looks along x of the world: its z is the world's x, its y down."""
    R = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    given = [boxes(k, R.T @ [2.0, 0.3, 0.9], sizes=np.abs(R.T @ [0.6, 0.4, 1.7])) for k in range(3)]
    q = np.array([-0.5, 0.5, -0.5, 0.5])
    np.testing.assert_allclose(quaternion_to_matrix(q), R, atol=1e-12)
    poses = [Pose(stamp=m.stamp, frame="map", child_frame="world", position=[1, 0, 0], orientation=q) for m in given]
    last = play(MultiObjectTracker3D(), {"boxes": given, "pose": poses})["tracks"][-1]
    assert last.frame == "map"
    np.testing.assert_allclose(last.positions[0], [3.0, 0.3, 0.9], atol=1e-9)
    np.testing.assert_allclose(last.sizes[0], [0.6, 0.4, 1.7], atol=1e-9)


def test_unusable_boxes_are_counted_and_another_frame_is_refused() -> None:
    played = play(MultiObjectTracker3D(), {"boxes": [boxes(0, [[np.nan, 0, 0], [1, 0, 0]])]})
    status = played["status"][0]
    assert status.pairs(0)["unusable boxes"] == "1"
    poses = [Pose(stamp=2 * FRAME, frame="map", child_frame="world", position=[0, 0, 0], orientation=[0, 0, 0, 1])]
    with pytest.raises(OperatorFailure, match="boxes are in map, those before were in world"):
        play(MultiObjectTracker3D(), {"boxes": [boxes(0, []), boxes(1, [])], "pose": poses})


def test_trackers_repeat_and_a_restored_one_goes_on() -> None:
    rng = np.random.default_rng(2)
    given = [boxes(k, rng.normal(0, 0.04, (4, 3)) + [[j, 0.05 * k, 0] for j in range(4)]) for k in range(20)]
    assert_repeats(MultiObjectTracker3D, [(each,) for each in given], 10)
