"""Trajectory errors are those of evo (Grupp 2017), to 1e-9, and the alignment is the one that was applied."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from operators.evaluation.trajectory import (
    Alignment,
    Matches,
    Trajectory,
    absolute_error,
    align,
    frames_apart,
    metres_apart,
    relative_errors,
)

ALIGNMENTS: tuple[Alignment, ...] = ("none", "se3", "sim3")


def walk(rng: np.random.Generator, count: int, step: float = 0.1) -> Trajectory:
    """A random walk at 30 Hz that rests now and then; quaternions of norm 1 within 0.001, as messages allow."""
    steps = rng.normal(0, step, (count, 3)) * (rng.random((count, 1)) > 0.2)
    norms = 1 + rng.uniform(-9e-4, 9e-4, (count, 1))
    stamps = np.arange(count) * 33_333_333 + rng.integers(0, 1000, count)
    orientations = Rotation.random(count, rng=rng).as_quat() * norms
    return Trajectory(stamps.tolist(), list(np.cumsum(steps, axis=0)), list(orientations))


def disturbed(truth: Trajectory, rng: np.random.Generator, size: float) -> Trajectory:
    turns = Rotation.from_rotvec(rng.normal(0, size, (len(truth), 3)))
    return Trajectory(
        truth.stamps,
        [p + rng.normal(0, size, 3) for p in truth.positions],
        list((Rotation.from_quat(np.array(truth.orientations)) * turns).as_quat()),
    )


def mirrored(truth: Trajectory) -> Trajectory:
    return Trajectory(truth.stamps, [p * [1, 1, -1] for p in truth.positions], truth.orientations)


def cases() -> list[tuple[str, Matches]]:
    found = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = walk(rng, int(rng.integers(3, 90)))
        estimates = {
            "noisy": disturbed(truth, rng, 0.05),
            "nearly the same": disturbed(truth, rng, 1e-8),
            "another": disturbed(walk(rng, len(truth)), rng, 0.5),
            "mirrored": mirrored(truth),
            "the same": truth,
        }
        found += [(f"{name} {seed}", Matches(estimate, truth, 0, 0)) for name, estimate in estimates.items()]
    return found


@pytest.fixture(scope="module")
def evo() -> Any:
    return pytest.importorskip("evo.core", reason="evo, which the [dev] extra brings, is not installed")


def as_evo(trajectory: Trajectory) -> Any:
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        positions_xyz=np.array(trajectory.positions),
        orientations_quat_wxyz=np.roll(np.array(trajectory.orientations), 1, axis=1),
        timestamps=np.array(trajectory.stamps) * 1e-9,
    )


def absolute_by_evo(matches: Matches, alignment: Alignment) -> dict[str, float]:
    from evo.core.metrics import APE, PoseRelation

    estimate, truth = as_evo(matches.estimate), as_evo(matches.truth)
    figures = {}
    if alignment != "none":
        _, _, scale = estimate.align(truth, correct_scale=alignment == "sim3")
        figures = {"ate_scale": scale} if alignment == "sim3" else {}
    metric = APE(PoseRelation.translation_part)
    metric.process_data((truth, estimate))
    found = metric.get_all_statistics()
    return {f"ate_{name}_m": found[name] for name in ("rmse", "median", "max")} | figures


def relative_by_evo(matches: Matches, seconds: float, metres: float) -> dict[str, float]:
    from evo.core.filters import FilterException
    from evo.core.metrics import RPE, PoseRelation, Unit

    frames = max(1, round(seconds * 1e9 / float(np.median(np.diff(matches.estimate.stamps)))))
    figures = {}
    for span, delta, unit in ((f"{seconds:g}s", frames, Unit.frames), (f"{metres:g}m", metres, Unit.meters)):
        for relation, symbol in ((PoseRelation.translation_part, "m"), (PoseRelation.rotation_angle_deg, "deg")):
            metric = RPE(relation, delta, unit, all_pairs=True, pairs_from_reference=True)
            try:
                metric.process_data((as_evo(matches.truth), as_evo(matches.estimate)))
            except FilterException:  # no two poses are so far apart
                continue
            figures[f"rpe_{span}_rmse_{symbol}"] = metric.get_all_statistics()["rmse"]
    return figures


@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.usefixtures("evo")
def test_the_absolute_error_is_evos(alignment: Alignment) -> None:
    for name, matches in cases():
        found = absolute_error(matches, alignment)
        assert found == pytest.approx(absolute_by_evo(matches, alignment), rel=1e-9, abs=1e-9), name


@pytest.mark.long
@pytest.mark.parametrize(("seconds", "metres"), [(1.0, 0.5), (0.1, 0.2), (0.01, 3.0), (30.0, 1000.0)])
@pytest.mark.usefixtures("evo")
def test_the_relative_errors_are_evos(seconds: float, metres: float) -> None:
    spans = set()
    for name, matches in cases():
        found = relative_errors(matches, seconds, metres)
        assert found == pytest.approx(relative_by_evo(matches, seconds, metres), rel=1e-9, abs=1e-9), name
        spans |= found.keys()
    assert bool(spans) == (seconds < 30)


@pytest.mark.usefixtures("evo")
def test_collinear_positions_cannot_be_aligned_as_in_evo() -> None:
    from evo.core.geometry import GeometryException

    line = [np.array([float(i), 0.0, 0.0]) for i in range(5)]
    straight = Trajectory(list(range(5)), line, [np.array([0.0, 0.0, 0.0, 1.0])] * 5)
    matches = Matches(straight, straight, 0, 0)
    with pytest.raises(ValueError, match="cannot be aligned to the truth by 'se3': the positions lie on a line"):
        absolute_error(matches, "se3")
    with pytest.raises(GeometryException):
        as_evo(straight).align(as_evo(straight))


@pytest.mark.parametrize("scaled", [False, True])
def test_alignment_recovers_the_applied_transform(scaled: bool) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        R, t = Rotation.random(rng=rng).as_matrix(), rng.normal(0, 5, 3)
        s = float(rng.uniform(0.1, 10)) if scaled else 1.0
        points = rng.normal(0, 1, (int(rng.integers(3, 40)), 3))
        found_R, found_t, found_s = align(points, s * points @ R.T + t, scaled=scaled)
        np.testing.assert_allclose(found_R, R, atol=1e-9)
        np.testing.assert_allclose(found_t, t, atol=1e-8)
        assert found_s == pytest.approx(s)


def test_an_alignment_is_a_rotation_also_where_a_reflection_would_fit_better() -> None:
    points = np.random.default_rng(2).normal(0, 1, (30, 3))
    R, _, _ = align(points, points * [1, 1, -1], scaled=False)
    assert np.linalg.det(R) == pytest.approx(1)


def test_no_other_alignment_is_better() -> None:
    rng = np.random.default_rng(3)
    points, onto = rng.normal(0, 1, (25, 3)), rng.normal(0, 1, (25, 3))
    R, t, s = align(points, onto, scaled=True)
    best = np.square(onto - (s * points @ R.T + t)).sum()
    for _ in range(200):
        turned = R @ Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()
        moved, scale = t + rng.normal(0, 0.05, 3), s * rng.uniform(0.9, 1.1)
        assert np.square(onto - (scale * points @ turned.T + moved)).sum() > best


def test_pairs_are_those_at_the_span_within_a_tenth_of_it() -> None:
    path = Trajectory(list(range(6)), [np.array([x, 0.0, 0.0]) for x in (0, 0.4, 0.95, 1.3, 3.0, 3.05)], [])
    first, second = metres_apart(path, 1.0)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 2), (1, 3)]
    first, second = frames_apart(4, 3)
    assert (first.tolist(), second.tolist()) == ([0], [3])
    assert len(frames_apart(3, 3)[0]) == 0
