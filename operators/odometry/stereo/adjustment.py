"""Bundle adjustment of a window of stereo frames: poses and points that best explain where points were seen.

Gauss-Newton over left column, row and right column of every sighting, reweighted by Cauchy's function.
Triggs et al., "Bundle adjustment, a modern synthesis", 2000.

A pair that is rectified imperfectly has disparities that are off by a constant, which scales all depths and, with
them, the way. Near and far points then disagree on how far the camera came, so the constant is estimated as well:
each window counts for what it shows with all poses and points free, so the first few settle it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.estimation.bundle import PosesAndPoints, Sightings, pose_jacobian
from operators.estimation.kernels import cauchy
from operators.estimation.least_squares import gauss_newton_step
from operators.geometry import se3
from operators.geometry.pinhole import Points, project_clamped, projection_jacobian
from operators.geometry.se3 import Matrix

CAUCHY = 2.0  # residuals of this many sigmas count half
# Information on the disparities' offset, 1/px², as windows have it. They share most of their sightings, and tracks
# near each other err together, so an offset is far less certain than their sum suggests.
FIRST = 100.0  # of an unknown rig, that it has none: a fifth of what a window shows
MOST = 2e4  # of the past, some 40 windows: rigs bend
NEAR = 0.3  # metres; nearer points are behind or in the lens


@dataclass(frozen=True, eq=False)
class StereoRig:
    """A rectified pair: K (3, 3) of the left image, baseline in metres."""

    K: Matrix
    baseline: float

    def __post_init__(self) -> None:
        if self.K.shape != (3, 3) or not np.isfinite(self.K).all() or self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise ValueError("StereoRig.K must be a finite (3, 3) matrix with positive focal lengths")
        if not (np.isfinite(self.baseline) and self.baseline > 0):
            raise ValueError(f"StereoRig.baseline must be positive metres, got {self.baseline}")

    def check_same(self, other: "StereoRig") -> None:
        """Raises ValueError unless another has the same geometry: views are comparable only within one calibration."""
        if not np.array_equal(self.K, other.K) or self.baseline != other.baseline:
            raise ValueError("the calibration changed (K or the baseline is another): one rig, one calibration")

    def project(self, points: Points) -> NDArray[np.float64]:
        """Returns (N, 3) left column, row, right column of points (N, 3) in the left camera; z at least NEAR."""
        left = project_clamped(points, self.K, NEAR)
        return np.column_stack([left, left[:, 0] - self.K[0, 0] * self.baseline / np.maximum(points[:, 2], NEAR)])

    def triangulate(self, sightings: NDArray[np.float64]) -> Points:
        """Returns points (N, 3) in the left camera of sightings (N, 3) with a positive disparity."""
        z = self.K[0, 0] * self.baseline / (sightings[:, 0] - sightings[:, 2])
        x = (sightings[:, 0] - self.K[0, 2]) / self.K[0, 0] * z
        y = (sightings[:, 1] - self.K[1, 2]) / self.K[1, 1] * z
        return np.column_stack([x, y, z])

    def jacobian(self, points: Points) -> NDArray[np.float64]:
        """Returns d sighting / d point (N, 3, 3)."""
        J = projection_jacobian(points, self.K, NEAR).take([0, 1, 0], axis=1)
        J[:, 2, 2] = -self.K[0, 0] * (points[:, 0] - self.baseline) / np.maximum(points[:, 2], NEAR) ** 2
        return J


@dataclass(frozen=True)
class Offset:
    """Holds what right columns are off by, in pixels, and the information on it, 1/px², of all windows so far."""

    pixels: float = 0.0
    information: float = FIRST

    def after(self, pixels: float, information: float) -> "Offset":
        """Returns what is believed after a window that moved the offset to these pixels with this information."""
        return Offset(pixels, min(self.information + information, MOST))


@dataclass(frozen=True, eq=False)
class Past:
    """Holds what points that are followed no more said of the poses (W, 4, 4) of a window and of the offset: matrix
    H (6W + 1, 6W + 1) and gradient (6W + 1,) of their sightings at these poses and this offset, the points eliminated.

    Without it a window hangs on the few points that its oldest frame still shares with the others: where these are far
    away, all later poses may go metres at next to no misfit. Sibley et al., "Sliding window filter with application to
    planetary landing", 2010.
    """

    poses: NDArray[np.float64]
    offset: float
    H: Matrix
    gradient: NDArray[np.float64]

    @staticmethod
    def none(poses: NDArray[np.float64], offset: float) -> "Past":
        """Returns that nothing is known of poses (W, 4, 4) and an offset."""
        size = 6 * len(poses) + 1
        return Past(poses, offset, np.zeros((size, size)), np.zeros(size))

    def at(self, poses: NDArray[np.float64], offset: float) -> "Past":
        """Returns the same about poses (W, 4, 4) and an offset nearby."""
        moves = [se3.log(invert(before) @ T) for before, T in zip(self.poses, poses, strict=True)]
        x = np.append(np.ravel(moves), offset - self.offset)
        return replace(self, poses=poses, offset=offset, gradient=self.gradient + self.H @ x)

    def also(self, rig: StereoRig, points: Points, seen: Sightings, sigma: float) -> "Past":
        """Adds the sightings of points (M, 3), which then may be forgotten."""
        shared = np.flatnonzero(np.bincount(seen.points, minlength=len(points)) > 1)
        if not len(shared):
            return self
        system = linearised(rig, self.poses, points[shared], seen.of_points(shared), self.offset, sigma, 0)[0]
        system.damp_points(0.0, 1e-6)
        H, gradient = system.reduced()
        return replace(self, H=self.H + H, gradient=self.gradient + gradient)

    def with_pose(self, T_world_camera: Matrix) -> "Past":
        """Adds a pose that nothing is known of."""
        size = 6 * len(self.poses)
        H, gradient = np.insert(self.H, [size] * 6, 0.0, axis=0), np.insert(self.gradient, [size] * 6, 0.0)
        poses = np.concatenate([self.poses, T_world_camera[None]])
        return replace(self, poses=poses, H=np.insert(H, [size] * 6, 0.0, axis=1), gradient=gradient)

    def without_first(self) -> "Past":
        """Returns what is known of the others, wherever the first pose is."""
        H, b, inverse = self.H, self.gradient, np.linalg.inv(self.H[:6, :6] + 1e-6 * np.eye(6))
        gain = H[6:, :6] @ inverse
        return replace(self, poses=self.poses[1:], H=H[6:, 6:] - gain @ H[:6, 6:], gradient=b[6:] - gain @ b[:6])


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Poses (W, 4, 4), points (M, 3) in the world, squared errors (S,) in sigmas, information (6, 6) of the last
    pose, the disparities' offset, and the past about these."""

    poses: NDArray[np.float64]
    points: Points
    squared: NDArray[np.float64]
    information: Matrix
    offset: Offset
    past: Past


def fitting(seen: Sightings, squared: NDArray[np.float64], count: int) -> NDArray[np.bool_]:
    """Returns which of `count` points are seen, and in the mean of their squared errors (S,) fit."""
    total = np.zeros(count)
    times = np.bincount(seen.points, minlength=count)
    np.add.at(total, seen.points, squared)
    return np.asarray((times > 0) & (total < 12.0 * np.maximum(times, 1)), np.bool_)


def linearised(
    rig: StereoRig, poses: NDArray[np.float64], points: Points, seen: Sightings, offset: float, sigma: float, fixed: int
) -> tuple[PosesAndPoints, NDArray[np.float64]]:
    """Returns the sightings of points (M, 3) from poses (W, 4, 4) linearised, and their squared errors (S,)."""
    p, R = seen.in_cameras(poses, points)
    r = (rig.project(p) - seen.pixels + np.array([0.0, 0.0, offset])) / sigma
    squared = np.einsum("si,si->s", r, r)
    weight = np.where(p[:, 2] > NEAR, cauchy(squared / (3.0 * CAUCHY**2)), 0.0)
    D = rig.jacobian(p) / sigma
    by_offset = np.broadcast_to(np.array([[0.0], [0.0], [1.0 / sigma]]), (len(D), 3, 1))
    system = PosesAndPoints(
        seen.frames - fixed, seen.points, (len(poses) - fixed, len(points)), pose_jacobian(D, p), D @ R, r,
        weight[:, None], by_offset,
    )  # fmt: skip
    return system, squared


def adjust(
    rig: StereoRig,
    poses: NDArray[np.float64],
    points: Points,
    seen: Sightings,
    believed: Offset,
    past: Past,
    sigma: float,
    fixed: int,
    iterations: int,
) -> Adjusted:
    """Improves poses T_world_camera (W, 4, 4) after the first `fixed` ones, and points (M, 3) in the world."""
    poses, points, offset, told = poses.copy(), points.copy(), believed.pixels, 0.0
    for iteration in range(iterations + 1):
        system, squared = linearised(rig, poses, points, seen, offset, sigma, fixed)
        if iteration == iterations:
            break
        system.damp_points(0.0, 1e-6)
        S, g = system.reduced()
        S += 1e-9 * np.eye(len(S))
        told = max(float(S[-1, -1] - S[-1, :-1] @ np.linalg.solve(S[:-1, :-1], S[:-1, -1])), 0.0)
        known = past.at(poses, offset)
        S += known.H[6 * fixed :, 6 * fixed :]
        g += known.gradient[6 * fixed :]
        S[-1, -1] += believed.information
        g[-1] += believed.information * (offset - believed.pixels)
        x = gauss_newton_step(S, g)
        moves = x[:-1].reshape(-1, 6)
        poses[fixed:] = np.array([T @ se3.exp(d) for T, d in zip(poses[fixed:], moves, strict=True)])
        points += system.points_step(x)
        offset += float(x[-1])
        if np.abs(moves).max() < 1e-5:
            break
    found = np.array([se3.orthonormalised(T) for T in poses])
    return Adjusted(found, points, squared, system.H[-1], believed.after(offset, told), past.at(found, offset))
