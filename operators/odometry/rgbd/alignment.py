"""Maximum a posteriori pose of a camera from point-to-plane distances, reprojections and a motion prior.

Gauss-Newton on the right perturbation T_world_camera <- T_world_camera exp(x), reweighted at every step.
Point-to-plane with projective association: Chen and Medioni, 1992; Newcombe et al., "KinectFusion", 2011.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.estimation.least_squares import gauss_newton_step
from operators.geometry import se3
from operators.geometry.pinhole import Pixels, Points
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.rgbd.surface import Array32, DepthNoise, Surface

CAUCHY = 2.0  # residuals of this many sigmas count half
SLACK = 0.02  # metres along a ray that a tilted or rough surface makes up within one patch
UNTOLD = 1e-3  # 1/m² and 1/rad²: information along what measurements do not determine
ROUNDING = 1.2e-7  # of the most information, by which sums in single precision are wrong
NOTHING: Vector = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Normal:
    """One term's part of the normal equations, and how well it fits."""

    H: Matrix  # (6, 6) information
    b: Vector  # (6,) gradient
    seen: int  # measurements that could be compared
    squared: Vector  # (N,) squared residuals, in units of sigma, of those within the gate

    def __add__(self, other: "Normal") -> "Normal":
        """Returns both measurements as one."""
        squared = np.concatenate([self.squared, other.squared])
        return Normal(self.H + other.H, self.b + other.b, self.seen + other.seen, squared)

    @property
    def inliers(self) -> int:
        """Measurements within three sigmas."""
        return int(np.count_nonzero(self.squared < 9.0))

    @property
    def median(self) -> float | None:
        """Squared residual in the median, in units of sigma; None without any."""
        return float(np.median(self.squared)) if len(self.squared) else None

    @property
    def told(self) -> Matrix:
        """(6, 6) information that is some along every direction."""
        values, axes = np.linalg.eigh(self.H)
        return np.asarray((axes * np.maximum(values, max(UNTOLD, ROUNDING * values[-1]))) @ axes.T, np.float64)

    @property
    def step(self) -> Vector:
        """(6,) to the pose that it would give alone."""
        return gauss_newton_step(self.told, self.b)


def drawn_apart(one: Normal, other: Normal) -> Vector:
    """Returns how far apart (6,) the poses are that either would give alone, in units of what both believe to err by:
    a sixth of its squared length is 1 where they are right about that."""
    variances, axes = np.linalg.eigh(np.linalg.inv(one.told) + np.linalg.inv(other.told))
    return np.asarray(axes @ (axes.T @ (one.step - other.step) / np.sqrt(variances)), np.float64)


class Term(Protocol):
    """A set of measurements of the camera's pose."""

    def linearise(self, T_world_camera: Matrix) -> Normal: ...


@dataclass(frozen=True)
class Freedom:
    """Holds the uncertainty of a pose before it is refined: standard deviations, metres and radians."""

    translation: float = 1.0
    rotation: float = 1.0

    @staticmethod
    def of(covariance: Matrix) -> "Freedom":
        """Returns the largest standard deviations that a covariance (6, 6) has in any direction."""
        translation, rotation = (np.linalg.eigvalsh(part)[-1] for part in (covariance[:3, :3], covariance[3:, 3:]))
        return Freedom(float(np.sqrt(translation)), float(np.sqrt(rotation)))

    def variance(self, z: Vector) -> Vector:
        """Returns how far it moves a point at a depth, squared metres."""
        return self.translation**2 + (self.rotation * z) ** 2


@dataclass(frozen=True, eq=False)
class PlaneTerm:
    """Points (N, 3) seen by the camera lie on the surface of a reference view.

    It works in single precision, one coordinate of all points in one piece: depths are no more precise, and this is
    what most of a frame's time is spent on.
    """

    points: Points
    reference: Surface
    T_reference_world: Matrix
    noise: DepthNoise
    scale: float  # of that noise, as learnt
    freedom: Freedom  # a point farther off than it allows is taken to see something else
    gate: float  # metres; the same, whatever the freedom
    strength: float  # of the information: neighbouring depths err together

    def linearise(self, T_world_camera: Matrix) -> Normal:
        T_exact = self.T_reference_world @ T_world_camera
        T = T_exact.astype(np.float32)
        cells, rotated = self._meet(T)
        planes = self.reference.bordered_planes.take(cells, axis=0)
        known = np.flatnonzero(planes[:, 3])
        normals = np.ascontiguousarray(planes.take(known, axis=0).T)  # (4, M): n and d
        s = rotated.take(known, axis=1)
        z = s[2] + T[2, 3]
        # Of the distance r, by the pose: in the reference's axes, about the camera's centre; the last row is r.
        J = np.empty((7, len(known)), np.float32)
        n = J[:3] = normals[:3]
        np.subtract(s[1] * n[2], s[2] * n[1], out=J[3])
        np.subtract(s[2] * n[0], s[0] * n[2], out=J[4])
        np.subtract(s[0] * n[1], s[1] * n[0], out=J[5])
        distance = n[0] * s[0]
        distance += n[1] * s[1]
        distance += n[2] * s[2]
        distance += T[:3, 3] @ n
        r = np.subtract(distance, normals[3], out=J[6])
        # Both depths err along their rays; the distance sees that error's part along the normal.
        z2 = z * z
        sigma = self.noise.quadratic * z2
        sigma += self.noise.floor
        sigma *= distance
        sigma /= z
        variance = sigma * sigma
        variance *= 2.0 * self.scale**2
        variance += 1e-12
        r2 = r * r
        # Three sigmas, squared, of what depth noise and the freedom to move allow.
        z2 *= 9.0 * self.freedom.rotation**2
        z2 += 9.0 * self.freedom.translation**2
        z2 += 9.0 * variance
        near = r2 < np.minimum(z2, self.gate**2, out=z2)
        r2 /= variance
        weight = r2 * (1.0 / CAUCHY**2)
        weight += 1.0
        weight *= variance
        np.divide(near, weight, out=weight)
        J *= np.sqrt(weight, out=weight)
        A = self.strength * (J @ J.T).astype(np.float64)
        # The axes of the camera instead of the reference's.
        R = _both(T_exact[:3, :3])
        return Normal(R.T @ A[:6, :6] @ R, A[:6, 6] @ R, len(known), r2[near].astype(np.float64))

    def compare(self, T_world_camera: Matrix) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.bool_]]:
        """Returns the indices (M,) of points that meet the reference, which lie before it, and which on it."""
        T = (self.T_reference_world @ T_world_camera).astype(np.float32)
        cells, rotated = self._meet(T)
        inverse = self.reference.bordered.ravel().take(cells)
        known = np.flatnonzero(inverse)
        z = rotated[2].take(known) + T[2, 3]
        nearer = 1.0 / inverse.take(known) - z
        variance = 2.0 * (self.scale * self.noise.sigma(z)) ** 2 + self.freedom.variance(z)
        width = 3.0 * np.sqrt(variance) + SLACK
        return known, nearer > width, np.abs(nearer) <= width

    def _meet(self, T_reference_camera: Array32) -> tuple[NDArray[np.int32], Array32]:
        """Returns the cell (N,) of the reference's bordered grid that each point falls into, and R p (3, N)."""
        h, w = self.reference.inverse_depth.shape
        R, t = T_reference_camera[:3, :3], T_reference_camera[:3, 3]
        rotated = R @ self.columns
        # To pixels of the bordered grid, where truncation rounds.
        K = self.reference.K.astype(np.float32)
        z = rotated[2] + t[2]
        behind = z.min(initial=1.0) < 0.05
        ahead = np.maximum(z, np.float32(0.05)) if behind else z
        u, v = rotated[0] + t[0], rotated[1] + t[1]
        for x, f, c, size in ((u, K[0, 0], K[0, 2], w), (v, K[1, 1], K[1, 2], h)):
            x /= ahead
            x *= f
            x += c + np.float32(1.5)
            np.maximum(x, 0.0, out=x)
            np.minimum(x, size + 1, out=x)
        cells = v.astype(np.int32)
        cells *= w + 2
        cells += u.astype(np.int32)
        if behind:
            cells[z < 0.05] = 0
        return cells, rotated

    @cached_property
    def columns(self) -> Array32:
        """The points (3, N), each coordinate in one piece."""
        return np.ascontiguousarray(self.points.T, np.float32)


@dataclass(frozen=True, eq=False)
class PixelTerm:
    """World points (N, 3) seen at pixels (N, 2) of the colour camera."""

    points_world: Points
    pixels: Pixels
    K_color: Matrix
    T_color_depth: Matrix
    sigma: float  # pixels
    strength: float

    def linearise(self, T_world_camera: Matrix) -> Normal:
        (fx, _, cx), (_, fy, cy), _ = self.K_color
        T = self.T_color_depth @ invert(T_world_camera)
        p = T[:3, :3] @ self.points_world.T + T[:3, 3:]
        behind = p[2] <= 0.05
        x, y, z = p[0], p[1], np.where(behind, 1.0, p[2])
        # Of the residuals, by the pose: in the colour camera's axes, about the centre of the depth camera, from which s
        # points to each point; the last row holds the residuals.
        s = p - self.T_color_depth[:3, 3:]
        J = np.zeros((7, 2, len(z)))
        # d is a pixel's derivative by its point: (du, 0, duz) and (0, dv, dvz). The rows are -d and d × s.
        du, duz = fx / z, -fx * x / z**2
        dv, dvz = fy / z, -fy * y / z**2
        J[0, 0], J[2, 0] = -du, -duz
        J[1, 1], J[2, 1] = -dv, -dvz
        J[3, 0], J[4, 0], J[5, 0] = -duz * s[1], duz * s[0] - du * s[2], du * s[1]
        J[3, 1], J[4, 1], J[5, 1] = dv * s[2] - dvz * s[1], dvz * s[0], -dv * s[0]
        J[6, 0], J[6, 1] = x * du + cx - self.pixels[:, 0], y * dv + cy - self.pixels[:, 1]
        e2 = (J[6, 0] ** 2 + J[6, 1] ** 2) / self.sigma**2
        e2[behind] = np.inf
        J *= np.sqrt(self.strength / (self.sigma**2 * (1.0 + e2 / CAUCHY**2)))
        flat = J.reshape(7, -1)
        A = flat @ flat.T
        R = _both(self.T_color_depth[:3, :3])
        return Normal(R.T @ A[:6, :6] @ R, A[:6, 6] @ R, len(z), e2)


@dataclass(frozen=True, eq=False)
class PriorTerm:
    """The pose is near a prediction."""

    T_world_camera: Matrix
    information: Matrix

    def linearise(self, T_world_camera: Matrix) -> Normal:
        x = se3.log(self.T_camera_world @ T_world_camera)
        return Normal(self.information, self.information @ x, 0, NOTHING)

    @cached_property
    def T_camera_world(self) -> Matrix:
        return invert(self.T_world_camera)


def _both(R: Matrix) -> Matrix:
    """Returns the (6, 6) that turns the axes of a translation and of a rotation alike."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = R
    return both


@dataclass(frozen=True, eq=False)
class Alignment:
    """The pose found, and what supports it."""

    T_world_camera: Matrix
    terms: tuple[Term, ...]
    last: tuple[Normal, ...]  # of a last step that hardly moved the pose; empty if none was so small

    @cached_property
    def normals(self) -> tuple[Normal, ...]:
        """The state of every term; computed on first access, since a rough pose needs none."""
        return self.last or tuple(term.linearise(self.T_world_camera) for term in self.terms)

    @property
    def information(self) -> Matrix:
        """(6, 6), prior excluded."""
        return np.asarray(sum((normal.H for normal in self.normals), np.zeros((6, 6))))


def align(T_world_camera: Matrix, terms: Sequence[Term], prior: Term, iterations: int) -> Alignment:
    """Gauss-Newton from an initial pose until a step is below 0.1 mm and 0.1 mrad."""
    T = T_world_camera
    for _ in range(iterations):
        anchor, normals = prior.linearise(T), tuple(term.linearise(T) for term in terms)
        H, b = anchor.H.copy(), anchor.b.copy()
        for normal in normals:
            H += normal.H
            b += normal.b
        step = gauss_newton_step(H, b)
        T = T @ se3.exp(step)
        if np.abs(step).max() < 1e-4:
            return Alignment(se3.orthonormalised(T), tuple(terms), normals)
    return Alignment(se3.orthonormalised(T), tuple(terms), ())
