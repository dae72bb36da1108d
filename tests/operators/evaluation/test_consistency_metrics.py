"""Consistency of covariances: honest ones lie in the band, and those that are not do not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dataflow.messages import Diagnostics, Odometry, Pose
from dataflow.testing import play
from operators.evaluation import ConsistencyMetrics

SECOND = 10**9


def figures(factor: float, *, flat: bool = False, **params: object) -> dict[str, float | int | str]:
    """Of 400 poses whose covariances are `factor` times what their errors have."""
    rng = np.random.default_rng(0)
    A = rng.normal(0, 0.1, (6, 6))
    C = A @ A.T + np.eye(6) * 1e-3
    given = C * factor
    if flat:
        given[2, :] = given[:, 2] = 0.0
    estimates, truths = [], []
    for k in range(400):
        error, R, place = (
            rng.multivariate_normal(np.zeros(6), C),
            Rotation.random(random_state=k),
            rng.uniform(-5, 5, 3),
        )
        names = {"stamp": (k + 1) * SECOND, "frame": "world", "child_frame": "base"}
        truths.append(Pose(**names, position=place, orientation=R.as_quat()))
        turned = (Rotation.from_rotvec(error[3:]).inv() * R).as_quat()
        estimates.append(Odometry(**names, position=place - error[:3], orientation=turned, pose_covariance=given))
    operator = ConsistencyMetrics(**params)
    play(operator, {"estimate": estimates, "ground_truth": truths})
    return dict(operator.summary())


def test_honest_covariances_lie_in_the_band() -> None:
    found = figures(1.0)
    for part in ("pose", "position", "orientation"):
        assert found[f"{part}_nees_mean"] == pytest.approx(1.0, abs=0.08)
        assert found[f"{part}_above_95_percent"] == pytest.approx(5.0, abs=3.0)
        assert str(found[f"{part}_band_95_percent"]).endswith(", in")


@pytest.mark.parametrize(("factor", "mean"), [(0.25, 4.0), (4.0, 0.25)], ids=["too sure", "too unsure"])
def test_covariances_that_are_not_honest_lie_outside(factor: float, mean: float) -> None:
    found = figures(factor)
    assert found["pose_nees_mean"] == pytest.approx(mean, rel=0.1)
    assert str(found["pose_band_95_percent"]).endswith(", out")


@pytest.mark.long
def test_directions_without_variance_do_not_count() -> None:
    found = figures(1.0, flat=True)
    assert found["position_nees_mean"] == pytest.approx(1.0, abs=0.1)
    assert figures(1.0, planar=True)["heading_nees_mean"] == pytest.approx(1.0, abs=0.15)


def test_frames_that_differ_are_named() -> None:
    operator = ConsistencyMetrics()
    operator.setup()
    pose = Pose(stamp=1, frame="map", child_frame="base", position=[0, 0, 0], orientation=[0, 0, 0, 1])
    with pytest.raises(ValueError, match="the ground truth is in 'world' but the estimate 'map'"):
        operator.process(pose, (pose.replace(frame="world"),))
    operator.process(pose, ())
    operator.finish()
    assert operator.summary()["estimates without finite covariance"] == 1


@pytest.mark.parametrize(("noise", "word"), [(1.0, "in"), (2.0, "out")], ids=["honest", "too sure"])
def test_innovations_of_a_filter_are_judged_by_sensor(noise: float, word: str) -> None:
    total = float(np.square(np.random.default_rng(0).normal(0, noise, 300)).sum())
    status = Diagnostics(
        stamp=SECOND, names=("filter", "robot/fix", "robot/silent"), messages=("", "", ""),
        levels=np.zeros(3, np.uint8), keys=("nis", "freedom", "nis", "freedom"),
        values=(f"{total:.3f}", "300", "0.000", "0"), owners=np.array([1, 1, 2, 2], np.int32),
    )  # fmt: skip
    pose = Pose(stamp=2 * SECOND, frame="world", position=[0, 0, 0], orientation=[0, 0, 0, 1], covariance=np.eye(6))
    operator = ConsistencyMetrics()
    play(operator, {"estimate": [pose], "ground_truth": [pose], "status": [status]})
    found = operator.summary()
    assert found["robot/fix, nis"] == pytest.approx(total / 300, abs=1e-5)
    assert str(found["robot/fix, nis_band_95_percent"]).endswith(f", {word}")
    assert not any(name.startswith("robot/silent") for name in found)


def test_a_truth_that_is_not_finite_is_counted_and_the_others_score() -> None:
    poses = [
        Odometry(
            stamp=k, frame="world", child_frame="base", position=[0.1, 0, 0], orientation=[0, 0, 0, 1],
            pose_covariance=np.eye(6) * 0.01,
        )
        for k in range(5)
    ]  # fmt: skip
    truths = [p.replace(position=[np.nan if p.stamp == 2 else 0.0, 0, 0]) for p in poses]
    operator = ConsistencyMetrics()
    play(operator, {"estimate": poses, "ground_truth": truths})
    figures = operator.summary()
    assert (figures["matched"], figures["truths not finite"]) == (4, 1)
    assert figures["position_nees_mean"] == pytest.approx(1 / 3)
