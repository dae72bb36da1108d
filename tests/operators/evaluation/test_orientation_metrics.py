"""Orientation errors are divided as defined, and scored at the truth's stamps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dataflow.messages import Imu, Pose, Transforms
from dataflow.testing import play
from operators.evaluation import OrientationMetrics
from operators.evaluation.orientation_metrics import differences, errors, without_mean_heading


def test_heading_and_inclination_errors_equal_the_rotations() -> None:
    truth = Rotation.random(20, rng=1)
    yaw, tilt = Rotation.from_euler("z", 0.3), Rotation.from_rotvec([0.1, 0.0, 0.0])
    total, heading, inclination = errors(differences((yaw * truth).as_quat(), truth.as_quat()))
    np.testing.assert_allclose(heading, 0.3)
    np.testing.assert_allclose(inclination, 0, atol=1e-12)
    np.testing.assert_allclose(total, 0.3)
    total, heading, inclination = errors(differences((yaw * tilt * truth).as_quat(), truth.as_quat()))
    np.testing.assert_allclose(heading, 0.3)
    np.testing.assert_allclose(inclination, 0.1)
    np.testing.assert_allclose(total, (yaw * tilt).magnitude())


def test_the_mean_heading_goes_and_the_rest_stays() -> None:
    truth = Rotation.random(20, rng=2)
    off = Rotation.from_euler("z", np.linspace(2.9, 3.1, 20)[:, None])
    estimate = (off * truth).as_quat() * np.where(np.arange(20) % 2, 1, -1)[:, None]
    _, heading, _ = errors(without_mean_heading(differences(estimate, truth.as_quat())))
    np.testing.assert_allclose(heading.max(), 0.1, atol=1e-9)


def imu(stamp: int, q: np.ndarray | None, frame: str = "imu") -> Imu:
    return Imu(stamp=stamp, frame=frame, angular_velocity=np.zeros(3), linear_acceleration=np.zeros(3), orientation=q)


def test_a_truth_of_another_frame_is_brought_over_by_the_extrinsics() -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [0.2, 0.3, 0.4]).as_matrix()
    extrinsics = Transforms.from_matrix(T, stamp=0, frame="base", child_frame="imu")
    base = Rotation.from_euler("xyz", [0.1, 0.0, 1.0])
    truth = Pose(stamp=5, frame="world", child_frame="base", position=np.zeros(3), orientation=base.as_quat())
    estimate = imu(5, (Rotation.from_euler("z", 0.02) * base * Rotation.from_matrix(T[:3, :3])).as_quat())
    operator = OrientationMetrics()
    streams = {"estimate": [estimate], "ground_truth": [truth], "extrinsics": [extrinsics]}
    play(operator, streams, static=["extrinsics"])
    assert operator.summary()["total_rmse_deg"] == pytest.approx(np.degrees(0.02))
    assert operator.summary()["inclination_rmse_deg"] == pytest.approx(0, abs=1e-6)
    without = OrientationMetrics()
    without.setup()
    with pytest.raises(ValueError, match="orients 'base' but the estimate 'imu'"):
        without.process(estimate, (truth,))


def test_samples_without_orientation_or_partner_do_not_count() -> None:
    q = np.array([0.0, 0, 0, 1])
    truths = [Pose(stamp=s, frame="w", position=np.zeros(3), orientation=q) for s in (1, 10_000_000)]
    operator = OrientationMetrics()
    play(operator, {"estimate": [imu(1, None), imu(10_000_001, q)], "ground_truth": truths})
    assert (operator.summary()["matched"], operator.summary()["unmatched_truths"]) == (1, 1)
