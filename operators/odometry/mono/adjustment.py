"""Bundle adjustment of a window of keyframes of one camera: poses and points that best explain where points were seen.

Levenberg and Marquardt over reprojections, reweighted by Cauchy's function. Triggs et al., "Bundle adjustment, a
modern synthesis", 2000.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.estimation.bundle import PosesAndPoints, Sightings, pose_jacobian
from operators.estimation.kernels import cauchy
from operators.estimation.least_squares import gauss_newton_step
from operators.geometry import se3
from operators.geometry.pinhole import Points, project_clamped, projection_jacobian
from operators.geometry.se3 import Matrix

CAUCHY = 2.0  # residuals of this many sigmas count half
NEAR = 1e-3  # of the map's unit; nearer points are behind or in the lens


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Poses (W, 4, 4), points (M, 3) in the world, squared errors (S,) of the sightings in sigmas."""

    poses: NDArray[np.float64]
    points: Points
    squared: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Errors:
    residuals: NDArray[np.float64]  # (S, 2) in sigmas
    points: Points  # (S, 3) in the camera that sees them
    rotations: NDArray[np.float64]  # (S, 3, 3) R_camera_world
    cost: float

    @property
    def squared(self) -> NDArray[np.float64]:
        return np.asarray(np.where(self.points[:, 2] > NEAR, (self.residuals**2).sum(axis=1), np.inf))


def adjust(
    K: Matrix, poses: NDArray[np.float64], points: Points, seen: Sightings, sigma: float, fixed: int, iterations: int
) -> Adjusted:
    """Improves poses T_world_camera (W, 4, 4) after the first `fixed` ones, and points (M, 3) in the world.

    With one fixed pose the scale is free, and what is adjusted keeps nearly the one that it has.
    """
    now, damping = _errors(K, poses, points, seen, sigma), 1e-4
    for _ in range(iterations):
        new_poses, new_points = _step(K, poses, points, seen, now, sigma, fixed, damping)
        then = _errors(K, new_poses, new_points, seen, sigma)
        if then.cost >= now.cost:
            damping *= 10.0
            if damping > 1.0:
                break
            continue
        settled = now.cost - then.cost < 1e-4 * now.cost
        poses, points, now, damping = new_poses, new_points, then, max(0.2 * damping, 1e-7)
        if settled:
            break
    return Adjusted(np.array([se3.orthonormalised(T) for T in poses]), points, now.squared)


def _errors(K: Matrix, poses: NDArray[np.float64], points: Points, seen: Sightings, sigma: float) -> _Errors:
    p, R = seen.in_cameras(poses, points)
    r = (project_clamped(p, K, NEAR) - seen.pixels) / sigma
    # What lies behind counts as a constant, so that no step gains by putting a point there.
    chi = np.where(p[:, 2] > NEAR, (r * r).sum(axis=1), 1e6)
    return _Errors(r, p, R, float(np.log1p(chi / CAUCHY**2).sum()))


def _step(
    K: Matrix, poses: NDArray[np.float64], points: Points, seen: Sightings, at: _Errors, sigma: float, fixed: int,
    damping: float,
) -> tuple[NDArray[np.float64], Points]:  # fmt: skip
    """Returns poses and points after a damped step of Gauss and Newton."""
    free = len(poses) - fixed
    p, R, r = at.points, at.rotations, at.residuals
    D = projection_jacobian(p, K, NEAR) / sigma
    weight = np.where(p[:, 2] > NEAR, cauchy((r * r).sum(axis=1) / CAUCHY**2), 0.0)
    system = PosesAndPoints(
        seen.frames - fixed, seen.points, (free, len(points)), pose_jacobian(D, p), D @ R, r, weight[:, None]
    )
    system.damp_points(damping, 1e-9)
    system.damp_poses(damping, 1e-9)
    x = gauss_newton_step(*system.reduced())
    moved = poses.copy()
    for i, twist in enumerate(x.reshape(free, 6)):
        moved[fixed + i] = poses[fixed + i] @ se3.exp(twist)
    return moved, points + system.points_step(x)
