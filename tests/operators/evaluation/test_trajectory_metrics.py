"""Trajectory scores on paths whose errors are known in closed form."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dataflow.messages import Odometry, Pose
from dataflow.messages.geometry import quaternion_from_yaw, transform_matrix
from operators.evaluation import TrajectoryMetrics

STEP = 100_000_000  # ns: 10 Hz
T_WORLD_ODOM = transform_matrix([4.0, -2.0, 1.0], [0.1, 0.7, -0.3, 0.64])


def circle(count: int = 63, radius: float = 2.0) -> np.ndarray:
    """(count, 4, 4) poses of a drive round a circle, heading along it, 0.2 m a step."""
    angle = np.arange(count) * 0.1
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    return transform_matrix(position, quaternion_from_yaw(angle + np.pi / 2))


def truth(T: np.ndarray, k: int, offset: int = 0, frame: str = "camera") -> Pose:
    return Pose.from_matrix(T, stamp=k * STEP + offset, frame="world", child_frame=frame)


def estimate(T: np.ndarray, k: int) -> Odometry:
    return Odometry.from_matrix(T, stamp=k * STEP, frame="odom", child_frame="camera")


def scored(estimates: Sequence[Odometry | Pose], truths: Sequence[Sequence[Pose]], **params: object) -> dict[str, Any]:
    """The figures of estimates with the batch of truths that comes with each."""
    metrics = TrajectoryMetrics(**params)
    metrics.setup()
    for each, batch in zip(estimates, truths, strict=True):
        assert metrics.process(each, tuple(batch)) is None
    assert metrics.finish() is None
    return dict(metrics.summary())


def score(estimated: np.ndarray, true: np.ndarray, offset: int = 0, **params: object) -> dict[str, Any]:
    estimates = [estimate(T, k) for k, T in enumerate(estimated)]
    return scored(estimates, [(truth(T, k, offset),) for k, T in enumerate(true)], **params)


def test_a_path_in_another_frame_has_no_error() -> None:
    path = circle()
    figures = score(np.linalg.inv(T_WORLD_ODOM) @ path, path)
    assert figures["matched"] == 63
    assert figures["path_m"] == pytest.approx(62 * 4 * np.sin(0.05))
    for name in ("ate_rmse_m", "ate_max_m", "rpe_1s_rmse_m", "rpe_1s_rmse_deg", "rpe_1m_rmse_m", "rpe_1m_rmse_deg"):
        assert figures[name] == pytest.approx(0, abs=1e-5), name


def test_a_stream_of_poses_scores_as_odometry_does() -> None:
    path = circle()
    poses = [Pose.from_matrix(T, stamp=k * STEP, frame="odom", child_frame="") for k, T in enumerate(path)]
    assert scored(poses, [(truth(T, k),) for k, T in enumerate(path)]) == score(path, path)


def test_noise_gives_its_own_rmse() -> None:
    """Alternating offsets of 3 cm off the plane cannot be aligned away."""
    path = circle(64)
    off = path.copy()
    off[:, 2, 3] += np.where(np.arange(64) % 2, 0.03, -0.03)
    figures = score(off, path)
    assert figures["ate_rmse_m"] == pytest.approx(0.03, rel=0.01)
    assert figures["ate_median_m"] == pytest.approx(0.03, rel=0.05)


def test_a_constant_drift_is_the_relative_error() -> None:
    """An estimate that moves 1 % too far errs 1 cm a metre of arc, or 2 cm in a second at 2 m/s, less the chord."""
    path = circle()
    far = path.copy()
    far[:, :3, 3] *= 1.01
    figures = score(far, path)
    assert figures["rpe_1s_rmse_m"] == pytest.approx(0.01 * 2 * 2 * np.sin(0.5), rel=1e-3)
    assert figures["rpe_1s_rmse_deg"] == pytest.approx(0, abs=1e-5)
    assert 0.008 < float(figures["rpe_1m_rmse_m"]) < 0.011
    assert figures["ate_rmse_m"] == pytest.approx(0.02, rel=0.05)


def test_drift_is_the_mean_error_of_segments_as_kitti_defines_it() -> None:
    """A straight path measured 2 % too long, that turns by 0.1 degrees a metre."""
    count = 301
    x = np.arange(count) * 1.0
    path = transform_matrix(np.column_stack([x, 0 * x, 0 * x]), quaternion_from_yaw(0 * x))
    far = transform_matrix(np.column_stack([1.02 * x, 0 * x, 0 * x]), quaternion_from_yaw(np.radians(0.1) * x))
    figures = score(far, path)
    assert figures["drift_deg_per_m"] == pytest.approx(0.1, rel=0.02)
    straight = far.copy()
    straight[:, :3, :3] = np.eye(3)
    figures = score(straight, path)
    assert figures["drift_percent"] == pytest.approx(2.0, rel=0.02)
    assert figures["drift_segments"] == 20 + 10 + 0  # those that begin before 200 m and 100 m
    assert "drift_percent" not in score(path[:50], path[:50])


def test_scale_is_found_only_by_sim3() -> None:
    path = circle()
    half = path.copy()
    half[:, :3, 3] *= 0.5
    unscaled = score(half, path)
    assert unscaled["ate_rmse_m"] == pytest.approx(1.0, rel=0.05)
    assert unscaled["rpe_1m_rmse_m"] == pytest.approx(0.5, rel=0.05)  # a metre of the true path, not of the estimate
    found = score(half, path, alignment="sim3")
    assert found["ate_rmse_m"] == pytest.approx(0, abs=1e-6)
    assert found["ate_scale"] == pytest.approx(2.0)


def test_without_alignment_an_offset_is_an_error() -> None:
    path = circle()
    moved = path.copy()
    moved[:, :3, 3] += [0.3, 0.0, 0.4]
    assert score(moved, path, alignment="none")["ate_rmse_m"] == pytest.approx(0.5)
    assert score(moved, path)["ate_rmse_m"] == pytest.approx(0, abs=1e-9)


def test_pose_is_scored_against_the_truth_of_the_same_stamp() -> None:
    """Truth at 100 Hz and batches that come late: neither the denser nor the delayed truth confuses the pairing."""
    path = circle(1001)
    dense = [truth(T, 0, i * STEP // 10) for i, T in enumerate(path)]
    batches = [[], *(dense[10 * (k - 1) : 10 * k] for k in range(1, 100)), dense[990:]]
    figures = scored([estimate(path[10 * k], k) for k in range(101)], batches, rpe_seconds=1)
    assert (figures["matched"], figures["unmatched_estimates"], figures["unmatched_truths"]) == (101, 0, 900)
    assert figures["ate_max_m"] == pytest.approx(0, abs=1e-9)


def test_truth_beyond_the_tolerance_is_no_truth() -> None:
    path = circle(20)
    assert score(path, path, offset=-2_000_000)["matched"] == 0
    assert score(path, path, offset=-2_000_000, tolerance="2ms")["matched"] == 20


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_poses_or_a_path_without_motion_have_no_aligned_error(count: int) -> None:
    figures = score(circle(count), circle(count))
    assert "ate_rmse_m" not in figures
    assert "the absolute error with alignment 'se3' needs 3 matched poses or more" in figures["ate"]
    still = np.repeat(circle(1), 10, axis=0)
    assert "cannot be aligned to the truth by 'se3'" in str(score(still, still)["ate"])
    assert score(still, still, alignment="none")["ate_rmse_m"] == 0


@pytest.mark.parametrize("lost", ["unmatched_estimates", "truths_not_finite", "estimates_not_finite"])
def test_non_finite_poses_are_counted_and_the_others_scored(lost: str) -> None:
    path, nowhere = circle(), {"position": [np.nan, 0, 0]}
    estimates, truths = [estimate(T, k) for k, T in enumerate(path)], [[truth(T, k)] for k, T in enumerate(path)]
    for k in (10, 11):
        if lost == "estimates_not_finite":
            estimates[k] = estimates[k].replace(**nowhere)
            continue
        estimates[k] = estimate(path[k] @ transform_matrix([5.0, 0, 0], [0, 0, 0, 1]), k)  # far off just there
        truths[k] = [truths[k][0].replace(**nowhere)] if lost == "truths_not_finite" else []
    figures = scored(estimates, truths)
    assert (figures["matched"], figures[lost]) == (61, 2)
    assert figures["ate_max_m"] == pytest.approx(0, abs=1e-9)


def test_files_are_read_back_by_evo(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo, of the [dev] extra, is not installed")
    path = circle(12)
    figures = score(path, path, out=str(tmp_path / "made" / "here"))
    folder = tmp_path / "made" / "here"
    read = file_interface.read_tum_trajectory_file(folder / "estimate.tum")
    np.testing.assert_allclose(np.array(read.poses_se3), path, atol=1e-12)
    assert (folder / "ground_truth.tum").read_text().splitlines()[11].startswith("1.000000000 ")
    assert json.loads((folder / "metrics.json").read_text()) == figures


@pytest.mark.parametrize(("apart", "named"), [(0, False), (5 * 10**17, True)])
def test_a_truth_of_another_clock_is_named_with_both_spans(apart: int, named: bool) -> None:
    poses = [estimate(T, k).replace(stamp=10**18 + k * 10**8) for k, T in enumerate(circle(20))]
    truths = [[truth(T, 0).replace(stamp=10**18 + k * 10**8 + apart)] for k, T in enumerate(circle(20))]
    told = str(scored(poses, truths).get("matching", ""))
    assert ("only 0 of 20 poses" in told and "1500000000.000 to" in told) == named


def test_poses_of_other_frames_are_refused_unless_they_are_one_place() -> None:
    given = [Pose.from_matrix(np.eye(4), stamp=1, frame="world", child_frame="base_link")]
    truths = [[Pose.from_matrix(np.eye(4), stamp=1, frame="world", child_frame="base_footprint")]]
    assert scored(given, truths, one_place=("base_link", "base_footprint"))["matched"] == 1
    with pytest.raises(ValueError, match=r"poses 'base_footprint' but .*'base_link'.* `one_place` names both"):
        scored(given, truths)
