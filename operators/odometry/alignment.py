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
from operators.geometry import se3
from operators.geometry.pinhole import Pixels, Points, project
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.surface import DepthNoise, Surface

CAUCHY = 2.0  # residuals of this many sigmas count half
SLACK = 0.02  # metres along a ray that a tilted or rough surface makes up within one patch
NOTHING: Vector = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Normal:
    """One term's part of the normal equations, and how well it fits."""

    H: Matrix  # (6, 6) information
    b: Vector  # (6,) gradient
    seen: int  # measurements that could be compared
    squared: Vector  # (N,) squared residuals, in units of sigma, of those within the gate

    @property
    def inliers(self) -> int:
        """Measurements within three sigmas."""
        return int(np.count_nonzero(self.squared < 9.0))

    @property
    def median(self) -> float | None:
        """Squared residual in the median, in units of sigma; None without any."""
        return float(np.median(self.squared)) if len(self.squared) else None


class Term(Protocol):
    """A set of measurements of the camera's pose."""

    def linearise(self, T_world_camera: Matrix) -> Normal: ...


@dataclass(frozen=True)
class Freedom:
    """How far a pose may still be off before it is refined: standard deviations, metres and radians."""

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
    """Points (N, 3) seen by the camera lie on the surface of a reference view."""

    points: Points
    reference: Surface
    T_reference_world: Matrix
    noise: DepthNoise
    scale: float  # of that noise, as learnt
    freedom: Freedom  # a point farther off than it allows is taken to see something else
    gate: float  # metres; the same, whatever the freedom
    strength: float  # of the information: neighbouring depths err together

    def linearise(self, T_world_camera: Matrix) -> Normal:
        T = self.T_reference_world @ T_world_camera
        R = T[:3, :3]
        inside, cells, q = self._meet(T)
        planes = self.reference.planes[cells]
        known = planes[:, 3] != 0
        inside, planes, q = inside[known], planes[known].astype(np.float64), q[known]
        normals = planes[:, :3]
        r = np.einsum("ij,ij->i", normals, q) - planes[:, 3]
        # Both depths err along their rays; the distance sees that error's part along the normal.
        along = np.abs(np.einsum("ij,ij->i", normals, q)) / q[:, 2]
        variance = 2.0 * (self.scale * self.noise.sigma(q[:, 2]) * along) ** 2
        near = r * r < np.minimum(9.0 * (variance + self.freedom.variance(q[:, 2])), self.gate**2)
        seen = len(r)
        if not near.any():
            return Normal(np.zeros((6, 6)), np.zeros(6), seen, NOTHING)
        inside, normals, r, variance = inside[near], normals[near], r[near], variance[near]
        e2 = r * r / variance
        weight = self.strength / (variance * (1.0 + e2 / CAUCHY**2))
        m = normals @ R
        p = self.points[inside]
        J = np.empty((len(r), 6))
        J[:, :3] = m
        J[:, 3] = p[:, 1] * m[:, 2] - p[:, 2] * m[:, 1]
        J[:, 4] = p[:, 2] * m[:, 0] - p[:, 0] * m[:, 2]
        J[:, 5] = p[:, 0] * m[:, 1] - p[:, 1] * m[:, 0]
        JW = J.T * weight
        return Normal(JW @ J, JW @ r, seen, e2)

    def compare(self, T_world_camera: Matrix) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Returns the indices (M,) of points that meet the reference, which lie before it, and which on it."""
        inside, cells, q = self._meet(self.T_reference_world @ T_world_camera)
        inverse = self.reference.inverse_depth.ravel()[cells]
        known = inverse > 0
        inside, z = inside[known], q[known, 2]
        nearer = 1.0 / inverse[known] - z
        variance = 2.0 * (self.scale * self.noise.sigma(z)) ** 2 + self.freedom.variance(z)
        width = 3.0 * np.sqrt(variance) + SLACK
        return inside, nearer > width, np.abs(nearer) <= width

    def _meet(self, T_reference_camera: Matrix) -> tuple[NDArray[np.int64], NDArray[np.int64], Points]:
        """Returns which points (M,) fall into the reference's grid, in which cells (M,), and where (M, 3) they are."""
        K, (h, w) = self.reference.K, self.reference.inverse_depth.shape
        q = self.points @ T_reference_camera[:3, :3].T + T_reference_camera[:3, 3]
        z = q[:, 2]
        ahead = np.maximum(z, 0.05)
        u = np.rint(q[:, 0] / ahead * K[0, 0] + K[0, 2])
        v = np.rint(q[:, 1] / ahead * K[1, 1] + K[1, 2])
        inside = np.flatnonzero((z > 0.05) & (u >= 0) & (v >= 0) & (u < w) & (v < h))
        return inside, (v[inside] * w + u[inside]).astype(np.int64), q[inside]


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
        T = self.T_color_depth @ invert(T_world_camera)
        p = self.points_world @ T[:3, :3].T + T[:3, 3]
        r = project(p, self.K_color) - self.pixels
        e2 = np.einsum("ij,ij->i", r, r) / self.sigma**2
        weight = self.strength / (self.sigma**2 * (1.0 + e2 / CAUCHY**2))
        weight[p[:, 2] <= 0.05] = 0.0
        J = reprojection_jacobian(p, self.K_color, self.T_color_depth)
        JW = J.transpose(2, 0, 1) * weight[:, None]
        H = np.tensordot(JW, J, axes=((1, 2), (0, 1)))
        b = np.tensordot(JW, r, axes=((1, 2), (0, 1)))
        return Normal(H, b, len(r), e2)


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


def reprojection_jacobian(points_color: Points, K: Matrix, T_color_depth: Matrix) -> NDArray[np.float64]:
    """d pixel / d x (N, 2, 6), x perturbing the depth camera's pose; points (N, 3) in the colour camera."""
    x, y = points_color[:, 0], points_color[:, 1]
    z = np.where(points_color[:, 2] > 0.05, points_color[:, 2], 1.0)
    D = np.zeros((len(z), 2, 3))
    D[:, 0, 0], D[:, 0, 2] = K[0, 0] / z, -K[0, 0] * x / z**2
    D[:, 1, 1], D[:, 1, 2] = K[1, 1] / z, -K[1, 1] * y / z**2
    D = D @ T_color_depth[:3, :3]
    p = (points_color - T_color_depth[:3, 3]) @ T_color_depth[:3, :3]  # in the depth camera
    J = np.empty((len(z), 2, 6))
    J[:, :, :3] = -D
    # d p / d w = [p]x, so each row d of D gives d [p]x = (d × p).
    J[:, :, 3] = D[:, :, 1] * p[:, None, 2] - D[:, :, 2] * p[:, None, 1]
    J[:, :, 4] = D[:, :, 2] * p[:, None, 0] - D[:, :, 0] * p[:, None, 2]
    J[:, :, 5] = D[:, :, 0] * p[:, None, 1] - D[:, :, 1] * p[:, None, 0]
    return J


@dataclass(frozen=True, eq=False)
class Alignment:
    """The pose found, and what supports it."""

    T_world_camera: Matrix
    terms: tuple[Term, ...]
    last: tuple[Normal, ...]  # of a last step that hardly moved the pose; empty if none was so small

    @cached_property
    def normals(self) -> tuple[Normal, ...]:
        """The state of every term; worked out when somebody asks, for a rough pose needs none."""
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
        step = -np.asarray(np.linalg.solve(H, b), np.float64)
        T = T @ se3.exp(step)
        if np.abs(step).max() < 1e-4:
            return Alignment(se3.orthonormalised(T), tuple(terms), normals)
    return Alignment(se3.orthonormalised(T), tuple(terms), ())
