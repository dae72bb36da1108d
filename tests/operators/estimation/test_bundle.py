"""Eliminating points changes no step: the same as that of the whole system, solved densely."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.estimation.bundle import PosesAndPoints, pose_jacobian
from operators.estimation.least_squares import gauss_newton_step
from operators.geometry import se3

Array = NDArray[np.float64]
POSES, POINTS, SEEN, RESIDUALS, SHARED = 3, 12, 30, 2, 2


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_step_is_that_of_the_whole_system(shared: bool, damping: float) -> None:
    rng = np.random.default_rng(3)
    pairs = rng.permutation((POSES + 1) * (POINTS - 1))[:SEEN]  # the last point is never seen
    poses, points = pairs // (POINTS - 1) - 1, pairs % (POINTS - 1)
    by_pose, by_point = rng.normal(size=(SEEN, RESIDUALS, 6)), rng.normal(size=(SEEN, RESIDUALS, 3))
    by_shared = rng.normal(size=(SEEN, RESIDUALS, SHARED))
    residuals, weights = rng.normal(size=(SEEN, RESIDUALS)), rng.uniform(0, 1, (SEEN, RESIDUALS))

    system = PosesAndPoints(
        poses, points, (POSES, POINTS), by_pose, by_point, residuals, weights, by_shared if shared else None
    )
    system.damp_poses(damping, 0.1)
    system.damp_points(damping, 0.2)
    step = gauss_newton_step(*system.reduced())
    found = np.concatenate([step, system.points_step(step).ravel()])

    extra = SHARED if shared else 0
    J = np.zeros((SEEN, RESIDUALS, 6 * POSES + extra + 3 * POINTS))
    for s in range(SEEN):
        if poses[s] >= 0:
            J[s, :, 6 * poses[s] : 6 * poses[s] + 6] = by_pose[s]
        J[s, :, 6 * POSES : 6 * POSES + extra] = by_shared[s, :, :extra]
        at = 6 * POSES + extra + 3 * points[s]
        J[s, :, at : at + 3] = by_point[s]
    flat = J.reshape(SEEN * RESIDUALS, -1)
    H = flat.T @ (weights.reshape(-1, 1) * flat)
    scale = np.repeat([damping, 0.0, damping], [6 * POSES, extra, 3 * POINTS])
    least = np.repeat([0.1, 0.0, 0.2], [6 * POSES, extra, 3 * POINTS])
    whole = -np.linalg.solve(H + np.diag(scale * np.diag(H) + least), flat.T @ (weights.ravel() * residuals.ravel()))
    np.testing.assert_allclose(found, whole, atol=1e-10)


def test_pose_jacobian_is_that_of_the_points_in_the_camera() -> None:
    rng = np.random.default_rng(4)
    T, world, J = se3.exp(rng.normal(size=6)), rng.normal(size=(5, 3)), rng.normal(size=(5, 2, 3))

    def residuals(pose: Array) -> Array:
        return np.asarray(np.einsum("srj,sj->sr", J, (world - pose[:3, 3]) @ pose[:3, :3]))

    found = pose_jacobian(J, (world - T[:3, 3]) @ T[:3, :3])
    for k, d in enumerate(1e-6 * np.eye(6)):
        difference = (residuals(T @ se3.exp(d)) - residuals(T @ se3.exp(-d))) / 2e-6
        np.testing.assert_allclose(found[:, :, k], difference, atol=1e-8)
