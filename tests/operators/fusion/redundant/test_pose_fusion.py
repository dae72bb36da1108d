"""Fusion of poses as an operator: averaged on the manifold, cross-checked, any sensor missing, bad input named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dataflow.messages import Imu, Odometry, Pose, Transforms
from dataflow.operator import Context
from dataflow.testing import Played, play
from operators.fusion import PoseFusion

Array = np.ndarray


def poses(count: int, rng: np.random.Generator, off: float = 0.0, turned: float = 0.0) -> list[Pose]:
    """Poses of a body at rest, 2 cm and 0.02 rad."""
    made = []
    for k in range(count):
        R = Rotation.from_rotvec(rng.normal(0, 0.02, 3) + np.array([0, 0, turned])) * Rotation.from_euler("z", 3.1)
        made.append(
            Pose(
                stamp=(k + 1) * 100_000_000,
                frame="world",
                child_frame="base_link",
                position=np.array([1.0, 2.0, 0.0]) + rng.normal(0, 0.02, 3) + [off, 0, 0],
                orientation=R.as_quat(),
                covariance=np.diag([0.02**2] * 6),
            )
        )
    return made


def orientations(count: int, rng: np.random.Generator) -> list[Imu]:
    return [
        Imu(
            stamp=(k + 1) * 100_000_000,
            frame="base_link",
            angular_velocity=[0, 0, 0],
            linear_acceleration=[0, 0, 9.8],
            orientation=(Rotation.from_rotvec(rng.normal(0, 0.005, 3)) * Rotation.from_euler("z", 3.1)).as_quat(),
            orientation_covariance=np.eye(3) * 0.005**2,
        )
        for k in range(count)
    ]


def body(streams: dict[str, Any]) -> tuple[Played, PoseFusion]:
    operator = PoseFusion()
    return play(operator, {"estimates": streams}), operator


def turned(pose: Any) -> float:
    return float((Rotation.from_quat(pose.orientation) * Rotation.from_euler("z", -3.1)).magnitude())


def test_poses_and_an_orientation_near_half_a_turn_are_averaged_on_the_manifold() -> None:
    rng = [np.random.default_rng(k) for k in range(3)]
    played, _ = body({"camera": poses(50, rng[0]), "lidar": poses(50, rng[1]), "imu": orientations(50, rng[2])})
    assert len(played["pose"]) == 50
    assert np.sqrt(np.mean([turned(p) ** 2 for p in played["pose"]])) < 0.01
    missing, operator = body({"imu": orientations(3, rng[2])})
    assert not missing["pose"]
    assert operator.summary()["ignored, position or orientation unknown"] == 3


def test_contradicting_poses_are_reported_and_inflate_the_covariance() -> None:
    rng = [np.random.default_rng(k) for k in range(2)]
    played, operator = body({"camera": poses(5, rng[0]), "lidar": poses(5, rng[1], off=0.5)})
    assert operator.summary()["two sensors contradicted each other"] == 5
    for pose, status in zip(played["pose"], played["status"], strict=True):
        assert pose.covariance[0, 0] > 0.08**2
        assert status.messages[0] == "sensors contradict each other"


def test_sensor_noisier_than_its_covariance_is_down_weighted() -> None:
    rng = np.random.default_rng(4)
    noisy = [p.replace(position=p.position + rng.normal(0, 0.05, 3)) for p in poses(200, rng)]
    played, _ = body({"a": poses(200, rng), "b": poses(200, rng), "noisy": noisy})
    last = played["status"][-1]
    noise = {name: float(dict(last.pairs(k))["noise"]) for k, name in enumerate(last.names) if k}
    assert noise["estimates/noisy"] > 2.0
    assert max(noise["estimates/a"], noise["estimates/b"]) < 1.7


def test_a_sensor_off_the_base_poses_the_base_with_the_covariance_of_its_lever() -> None:
    T = np.eye(4)
    T[0, 3] = 2.0
    mounts = Transforms.from_matrix(T, stamp=0, frame="base_link", child_frame="mast")
    at = Pose(
        stamp=1,
        frame="world",
        child_frame="mast",
        position=[5.0, 0.0, 0.0],
        orientation=[0, 0, 0, 1],
        covariance=np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 0.1**2]),
    )
    played = play(PoseFusion(), {"estimates": {"mast": [at]}, "extrinsics": [mounts]}, static=("extrinsics",))
    pose = played["pose"][0]
    np.testing.assert_allclose(pose.position, [3.0, 0.0, 0.0], atol=1e-9)
    assert pose.covariance[1, 1] == pytest.approx(1e-4 + (2.0 * 0.1) ** 2)


def test_a_sensor_that_is_silent_for_longer_than_the_window_does_not_count() -> None:
    rng = np.random.default_rng(0)
    one, other = poses(3, rng), poses(1, rng, off=0.02)
    played, operator = body({"camera": one, "lidar": other})
    assert [p.covariance[0, 0] for p in played["pose"]] == pytest.approx([2e-4, 4e-4, 4e-4])
    assert operator.summary()["two sensors contradicted each other"] == 0


def test_two_plays_give_equal_bits() -> None:
    made = [
        body({"camera": poses(9, np.random.default_rng(0)), "imu": orientations(9, np.random.default_rng(1))})[0]
        for _ in range(2)
    ]
    assert made[0].digests() == made[1].digests()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"covariance": np.zeros((6, 6))}, "covariance not positive"),
        ({"covariance": np.full((6, 6), np.nan)}, "not finite"),
        ({"position": [np.nan, 0, 0]}, "not finite"),
    ],
    ids=["zero covariance", "covariance not finite", "position not finite"],
)
def test_a_pose_that_cannot_be_used_is_counted_and_the_others_serve(change: dict[str, Any], words: str) -> None:
    rng = np.random.default_rng(0)
    bad = [p.replace(**change) for p in poses(4, rng)]
    played, operator = body({"camera": bad, "lidar": poses(4, rng)})
    assert operator.summary()[f"ignored, estimates/camera: {words}"] == 4
    assert len(played["pose"]) == 4
    assert np.linalg.norm(played["pose"][-1].position - [1.0, 2.0, 0.0]) < 0.1


def test_poses_that_do_not_come_after_the_last_are_counted() -> None:
    operator = PoseFusion()
    operator.setup()
    pose = poses(1, np.random.default_rng(0))[0]
    for stamp in (10, 10, 9):
        operator.process({"ns/camera/pose": pose.replace(stamp=stamp)}, Context(10))
    assert operator.summary()["ignored, camera/pose: stamp not later than the last"] == 2


def test_unfusable_poses_are_refused_with_the_stream() -> None:
    operator = PoseFusion()
    operator.setup()
    pose = poses(1, np.random.default_rng(0))[0]
    with pytest.raises(ValueError, match="its poses are in 'odom', the fused one is in 'world'"):
        operator.process({"ns/camera/pose": pose.replace(frame="odom")}, Context(pose.stamp))
    operator.on_reset("estimates")
    with pytest.raises(ValueError, match="camera/pose: its messages have no covariance"):
        operator.process({"ns/camera/pose": pose.replace(covariance=None)}, Context(pose.stamp))
    operator.on_reset("estimates")
    told = Odometry(stamp=1, frame="world", child_frame="base_link", position=[0, 0, 0], orientation=[0, 0, 0, 1])
    with pytest.raises(ValueError, match="wheels/odometry: its messages have no covariance"):
        operator.process({"ns/wheels/odometry": told}, Context(1))
    operator.on_reset("estimates")
    sample = orientations(1, np.random.default_rng(0))[0]
    with pytest.raises(ValueError, match="imu/imu: its samples have no orientation with covariance"):
        operator.process({"ns/imu/imu": sample.replace(orientation=None)}, Context(sample.stamp))
