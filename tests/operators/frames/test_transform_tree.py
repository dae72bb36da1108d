"""TransformTree on streams of different rates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from operator_runs import assert_resumes_alike, texts

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Number, Odometry, Pose, Transforms
from dataflow.operator import Context
from dataflow.testing import Played, play
from operators.frames import TransformTree
from operators.geometry import se3

MS = 1_000_000
TWIST = np.array([0.5, 0, 0, 0, 0, 0.4])  # a second
T_base_lidar = se3.exp(np.array([0.1, 0, 0.6, 0, 0, 0.2]))


def true_pose(stamp: int) -> np.ndarray:
    return se3.exp(TWIST * stamp * 1e-9)


def odometry(*milliseconds: float, child: str = "base") -> list[Odometry]:
    return [
        Odometry.from_matrix(true_pose(round(t * MS)), stamp=round(t * MS), frame="odom", child_frame=child)
        for t in milliseconds
    ]


def questions(*milliseconds: float) -> list[Number]:
    return [Number(stamp=round(t * MS), value=0.0) for t in milliseconds]


def mount(frame: str = "base", child: str = "lidar") -> Transforms:
    return Transforms.from_matrix(T_base_lidar, stamp=0, frame=frame, child_frame=child)


def looked_up(moving: Any, at: list[Number], fixed: Any = None, **params: Any) -> tuple[Played, dict[str, Any]]:
    operator = TransformTree(**({"frame": "odom", "child": "lidar"} | params))
    streams = {"moving": moving if isinstance(moving, dict) else {"odometry": moving}, "at": at}
    streams["fixed"] = {"mounts": [mount()] if fixed is None else fixed}
    played = play(operator, streams, static=["fixed"])
    return played, dict(operator.summary())


def test_the_lidar_is_found_at_its_own_stamps_between_those_of_the_odometry() -> None:
    played, counts = looked_up(odometry(*range(0, 1001, 50)), questions(*range(30, 1000, 100)))
    assert [pose.stamp for pose in played["pose"]] == [t * MS for t in range(30, 1000, 100)]
    for pose in played["pose"]:
        assert (pose.frame, pose.child_frame) == ("odom", "lidar")
        np.testing.assert_allclose(pose.matrix(), true_pose(pose.stamp) @ T_base_lidar, atol=1e-9)
    assert counts == {"asked": 10, "answered": 10}
    assert not played["status"]


def test_questions_may_be_more_frequent_than_transforms() -> None:
    played, counts = looked_up(odometry(0, 200, 400, 600), questions(*range(10, 600, 20)))
    assert counts["answered"] == counts["asked"] - counts.get("unanswered at the end", 0)
    assert len(played["pose"]) >= 20
    for pose in played["pose"]:
        np.testing.assert_allclose(pose.matrix(), true_pose(pose.stamp) @ T_base_lidar, atol=1e-9)


def test_a_question_waits_only_so_long() -> None:
    played, counts = looked_up(odometry(0, 100), questions(50, 150, 1000), patience="300ms")
    assert [pose.stamp for pose in played["pose"]] == [50 * MS]
    assert counts == {"asked": 3, "answered": 1, "dropped: too late": 1, "unanswered at the end": 1}
    assert "is known up to 100000000" in texts(played)[0]


def test_questions_before_and_in_gaps_are_dropped_at_once_with_their_reason() -> None:
    played, counts = looked_up(odometry(100, 200, 5000, 5100), questions(50, 1000, 5050), gap="1s")
    assert counts["dropped: too early"] == 1
    assert counts["dropped: gap"] == 1
    assert [pose.stamp for pose in played["pose"]] == [5050 * MS]


def test_a_chain_of_moving_transforms_is_joined() -> None:
    arm = [
        Transforms.from_matrix(
            se3.exp(np.array([0, 0, t * 1e-3, 0, 0, 0])), stamp=t * MS, frame="base", child_frame="arm"
        )
        for t in range(5, 1000, 70)
    ]
    hand = [mount("arm", "hand")]
    played, counts = looked_up(
        {"odometry": odometry(*range(0, 1001, 50)), "arm": arm}, questions(333), hand, child="hand"
    )
    (pose,) = played["pose"]
    expected = true_pose(333 * MS) @ se3.exp(np.array([0, 0, 0.333, 0, 0, 0])) @ T_base_lidar
    np.testing.assert_allclose(pose.matrix(), expected, atol=1e-9)
    assert counts["answered"] == 1


def test_an_unknown_frame_is_named() -> None:
    played, counts = looked_up(odometry(*range(0, 1001, 50)), questions(20), child="camera")
    assert counts == {"asked": 1, "dropped: unknown frame": 1}
    assert texts(played) == ["no frame 'camera'; there are base, lidar, odom"]


def test_transforms_that_contradict_the_tree_are_left_out_and_counted() -> None:
    streams = {
        "odometry": odometry(0, 100, 200),
        "other": [Pose.from_matrix(np.eye(4), stamp=50 * MS, frame="world", child_frame="base")],
        "loop": [Pose.from_matrix(np.eye(4), stamp=60 * MS, frame="lidar", child_frame="odom")],
        "same": odometry(100),
    }
    played, counts = looked_up(streams, questions(120))
    assert len(played["pose"]) == 1
    assert counts["left out: second parent"] == counts["left out: loop"] == counts["left out: repeated"] == 1
    assert "'base' is in 'odom', and is told in 'world' as well" in texts(played)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_transform_that_is_not_finite_is_left_out_and_counted(wrong: float) -> None:
    moving = odometry(0, 100, 200)
    moving[1] = moving[1].replace(position=[wrong, 0, 0])
    played, counts = looked_up(moving, questions(50, 150))
    assert counts == {"asked": 2, "left out: not finite": 1, "answered": 2}
    assert texts(played) == ["'base' in 'odom' is not finite"]
    for pose in played["pose"]:
        np.testing.assert_allclose(pose.matrix(), true_pose(pose.stamp) @ T_base_lidar, atol=1e-9)


def test_fixed_transforms_that_contradict_each_other_stop_the_graph() -> None:
    ring = Transforms(
        stamp=0,
        frames=("a", "b"),
        child_frames=("b", "a"),
        translations=np.zeros((2, 3)),
        rotations=np.array([[0, 0, 0, 1.0]] * 2),
    )
    with pytest.raises(OperatorFailure, match="would close a loop"):
        looked_up(odometry(0, 100), questions(50), [ring])


def test_extrapolation_answers_at_once() -> None:
    played, counts = looked_up(odometry(0, 50, 100), questions(120), extrapolation="50ms")
    (pose,) = played["pose"]
    np.testing.assert_allclose(pose.matrix(), true_pose(120 * MS) @ T_base_lidar, atol=1e-9)
    assert counts == {"asked": 1, "answered": 1}


def test_restored_operator_resumes_alike() -> None:
    moving, fixed = odometry(0, 50, 100, 150), {"m": mount()}
    firings = [({"odometry": m}, None, Context(m.stamp), fixed) for m in moving]
    firings += [({}, m, Context(m.stamp), fixed) for m in questions(70, 160)]
    firings.sort(key=lambda firing: firing[2].stamp)
    assert_resumes_alike(lambda: TransformTree(frame="odom", child="lidar"), firings, 2)
