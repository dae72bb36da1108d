"""Bundle adjustment of a window of keyframes of one camera: poses and points that best explain where points were seen.

Levenberg and Marquardt over reprojections, reweighted by Cauchy's function; points are eliminated by the Schur
complement. Triggs et al., "Bundle adjustment, a modern synthesis", 2000.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.pinhole import Pixels, Points
from operators.geometry.se3 import Matrix

CAUCHY = 2.0  # residuals of this many sigmas count half
NEAR = 1e-3  # of the map's unit; nearer points are behind or in the lens


@dataclass(frozen=True, eq=False)
class Views:
    """Says who saw what where: frames (S,) and points (S,) by index, pixels (S, 2)."""

    frames: NDArray[np.int64]
    points: NDArray[np.int64]
    pixels: Pixels


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
    K: Matrix, poses: NDArray[np.float64], points: Points, seen: Views, sigma: float, fixed: int, iterations: int
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


def _errors(K: Matrix, poses: NDArray[np.float64], points: Points, seen: Views, sigma: float) -> _Errors:
    inverse = np.array([invert(T) for T in poses])
    R = inverse[seen.frames, :3, :3]
    p = np.einsum("sij,sj->si", R, points[seen.points]) + inverse[seen.frames, :3, 3]
    z = np.maximum(p[:, 2], NEAR)
    u, v = K[0, 0] * p[:, 0] / z + K[0, 2], K[1, 1] * p[:, 1] / z + K[1, 2]
    r = (np.column_stack([u, v]) - seen.pixels) / sigma
    # What lies behind counts as a constant, so that no step gains by putting a point there.
    chi = np.where(p[:, 2] > NEAR, (r * r).sum(axis=1), 1e6)
    return _Errors(r, p, R, float(np.log1p(chi / CAUCHY**2).sum()))


def _step(
    K: Matrix, poses: NDArray[np.float64], points: Points, seen: Views, at: _Errors, sigma: float, fixed: int,
    damping: float,
) -> tuple[NDArray[np.float64], Points]:  # fmt: skip
    """Returns poses and points after a damped step of Gauss and Newton."""
    count, size, free = len(poses), len(points), len(poses) - fixed
    p, R, r = at.points, at.rotations, at.residuals
    z = np.maximum(p[:, 2], NEAR)
    D = np.zeros((len(p), 2, 3))
    D[:, 0, 0], D[:, 0, 2] = K[0, 0] / z / sigma, -K[0, 0] * p[:, 0] / z**2 / sigma
    D[:, 1, 1], D[:, 1, 2] = K[1, 1] / z / sigma, -K[1, 1] * p[:, 1] / z**2 / sigma
    weight = np.where(p[:, 2] > NEAR, 1.0 / (1.0 + (r * r).sum(axis=1) / CAUCHY**2), 0.0)
    # d p / d x of the pose's right perturbation is [-I, [p]x]; of the point, R.
    Jp = np.empty((len(p), 2, 6))
    Jp[:, :, :3] = -D
    Jp[:, :, 3:] = np.cross(D, p[:, None, :])
    Jl = D @ R
    WJp, WJl = weight[:, None, None] * Jp, weight[:, None, None] * Jl
    H, b = np.zeros((count, 6, 6)), np.zeros((count, 6))
    np.add.at(H, seen.frames, WJp.transpose(0, 2, 1) @ Jp)
    np.add.at(b, seen.frames, np.einsum("sij,si->sj", WJp, r))
    V, c = np.zeros((size, 3, 3)), np.zeros((size, 3))
    np.add.at(V, seen.points, WJl.transpose(0, 2, 1) @ Jl)
    np.add.at(c, seen.points, np.einsum("sij,si->sj", WJl, r))
    index = np.arange(3)
    V[:, index, index] += damping * V[:, index, index] + 1e-9
    V_inverse = np.linalg.inv(V)
    E = np.zeros((count, size, 6, 3))
    E[seen.frames, seen.points] = WJp.transpose(0, 2, 1) @ Jl
    A = E[fixed:].transpose(0, 2, 1, 3).reshape(6 * free, size, 3)
    B = np.einsum("amj,mjk->amk", A, V_inverse).reshape(6 * free, 3 * size)
    S = np.zeros((6 * free, 6 * free))
    for i in range(free):
        block = slice(6 * i, 6 * i + 6)
        S[block, block] = H[fixed + i] + np.diag(damping * np.diag(H[fixed + i]) + 1e-9)
    S -= B @ A.reshape(6 * free, 3 * size).T
    x = -np.linalg.solve(S, b[fixed:].ravel() - B @ c.ravel())
    moved = poses.copy()
    for i, twist in enumerate(x.reshape(free, 6)):
        moved[fixed + i] = poses[fixed + i] @ se3.exp(twist)
    steps = np.einsum("mij,mj->mi", V_inverse, -c - np.einsum("amj,a->mj", A, x))
    return moved, points + steps
