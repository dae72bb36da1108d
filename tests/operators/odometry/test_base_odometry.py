"""BaseOdometry on a camera whose place on the robot is known."""

from __future__ import annotations

import numpy as np
import pytest
from operator_runs import assert_resumes_alike

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Odometry, Path, Transforms
from dataflow.messages.geometry import invert, matrix_to_quaternion, quaternion_from_yaw, transform_matrix, yaw_of
from dataflow.testing import play
from operators.geometry.se3 import about_fixed_axes, exp
from operators.odometry import BaseOdometry

T_BASE_CAMERA = transform_matrix([0.1, 0.05, 1.1], [-0.45, 0.55, -0.55, 0.45])
MOUNT = Transforms.from_matrix(T_BASE_CAMERA, stamp=0, frame="base_link", child_frame="camera")


def seen(T_start_base: np.ndarray, covariance: np.ndarray | None = None) -> Odometry:
    """The camera's own odometry while the base moves."""
    T = invert(T_BASE_CAMERA) @ T_start_base @ T_BASE_CAMERA
    fixed = None if covariance is None else about_fixed_axes(covariance, T)
    return Odometry.from_matrix(T, stamp=1, frame="odom", child_frame="camera", pose_covariance=fixed)


def on_base(sensor: Odometry) -> Odometry:
    (made,) = play(BaseOdometry(), {"sensor": [sensor], "extrinsics": [MOUNT]}, static=["extrinsics"])["odometry"]
    return made


def test_the_bases_pose_is_that_of_the_base() -> None:
    T = transform_matrix([1.5, -0.4, 0.0], quaternion_from_yaw(0.7))
    made = on_base(seen(T))
    np.testing.assert_allclose(made.matrix(), T, atol=1e-9)
    assert (made.frame, made.child_frame) == ("odom_base", "base_link")


def keyframes(frame: str = "odom", stamp: int = 1) -> Path:
    """The camera where the base stood at (0, 0), and turned at (1.5, -0.4)."""
    there = transform_matrix([1.5, -0.4, 0.0], quaternion_from_yaw(0.7))
    T = np.stack([invert(T_BASE_CAMERA) @ base @ T_BASE_CAMERA for base in (np.eye(4), there)])
    return Path(
        stamp=stamp, frame=frame, positions=T[:, :3, 3], orientations=matrix_to_quaternion(T[:, :3, :3]), stamps=[0, 1]
    )


def test_keyframes_of_the_sensor_become_those_of_the_base_and_are_given_once() -> None:
    sensor = [seen(np.eye(4)).replace(stamp=k) for k in (1, 2, 3)]
    given = {"sensor": sensor, "extrinsics": [MOUNT], "path": [keyframes()]}
    played = play(BaseOdometry(), given, static=["extrinsics"])
    (made,) = played["keyframes"]
    assert (made.frame, len(played["odometry"])) == ("odom_base", 3)
    np.testing.assert_allclose(made.positions, [[0, 0, 0], [1.5, -0.4, 0]], atol=1e-9)
    assert made.orientations is not None
    np.testing.assert_allclose(yaw_of(made.orientations), [0, 0.7], atol=1e-9)
    assert made.stamps.tolist() == [0, 1]


def test_keyframes_in_another_frame_than_the_poses_are_refused() -> None:
    given = {"sensor": [seen(np.eye(4))], "extrinsics": [MOUNT], "path": [keyframes("map")]}
    with pytest.raises(OperatorFailure, match="the path is in 'map', the sensor's poses are in 'odom'"):
        play(BaseOdometry(), given, static=["extrinsics"])


@pytest.mark.long
def test_covariance_is_that_of_the_base_by_sampling() -> None:
    rng = np.random.default_rng(0)
    spread = np.diag([1e-4, 2e-4, 1e-4, 1e-5, 4e-5, 2e-5])
    T = transform_matrix([1.5, -0.4, 0.0], quaternion_from_yaw(0.7))
    made = on_base(seen(T, spread))
    T_camera = invert(T_BASE_CAMERA) @ T @ T_BASE_CAMERA
    drawn = [T_camera @ exp(rng.multivariate_normal(np.zeros(6), spread)) for _ in range(4000)]
    places = np.array([(T_BASE_CAMERA @ t @ invert(T_BASE_CAMERA))[:3, 3] for t in drawn])
    np.testing.assert_allclose(made.pose_covariance[:3, :3], np.cov(places.T), atol=1.5e-5)


def test_extrinsics_without_the_sensor_are_refused() -> None:
    other = Transforms.from_matrix(np.eye(4), stamp=0, frame="base_link", child_frame="lidar")
    with pytest.raises(OperatorFailure, match="no transform between 'camera' and 'base_link'"):
        play(BaseOdometry(), {"sensor": [seen(np.eye(4))], "extrinsics": [other]}, static=["extrinsics"])


def test_a_pose_without_scale_turns_and_gives_none_beside_the_base() -> None:
    unknown = np.diag([np.inf, np.inf, np.inf, 1e-4, 4e-4, 9e-4])
    sensor = Odometry.from_matrix(np.eye(4), stamp=5, frame="odom", child_frame="camera", pose_covariance=unknown)
    turned = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    here = Transforms.from_matrix(turned, stamp=0, frame="base_link", child_frame="camera")
    operator = BaseOdometry()
    operator.setup()
    posed = operator.process(sensor, here)["odometry"]
    covariance = posed.pose_covariance
    assert covariance is not None
    assert np.isinf(np.diag(covariance)[:3]).all()
    np.testing.assert_allclose(np.diag(covariance)[3:], [9e-4, 1e-4, 4e-4])
    turned[0, 3] = 0.1
    beside = Transforms.from_matrix(turned, stamp=0, frame="base_link", child_frame="camera")
    assert operator.process(sensor, beside) == {}
    assert operator.summary() == {"poses without scale": 1}


def test_a_pose_that_is_not_finite_gives_none_and_is_counted() -> None:
    good = seen(np.eye(4))
    poses = [good, good.replace(stamp=good.stamp + 1, position=[np.nan, 0, 0]), good.replace(stamp=good.stamp + 2)]
    operator = BaseOdometry()
    played = play(operator, {"sensor": poses, "extrinsics": [MOUNT]}, static=["extrinsics"])
    assert [m.stamp - good.stamp for m in played["odometry"]] == [0, 2]
    assert operator.summary() == {"poses not finite": 1}


def test_restored_operator_resumes_alike() -> None:
    rng, firings = np.random.default_rng(4), []
    for k in range(5):
        T = transform_matrix([0.1 * k, 0.03 * k, 0], quaternion_from_yaw(0.1 * k))
        firings.append((seen(T, np.diag(rng.uniform(1e-5, 1e-3, 6))).replace(stamp=k + 1), MOUNT))
    assert_resumes_alike(BaseOdometry, firings, 3)
