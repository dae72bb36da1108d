"""The pose of a scan in a map of planes, with its information matrix and the unobservable directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.cloud.deskewing import deskewed
from operators.estimation.kernels import geman_mcclure
from operators.estimation.least_squares import gauss_newton_step
from operators.geometry import se3
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.lidar.map import Array, Pairs, PlaneMap
from operators.odometry.lidar.scan import Scan

ITERATIONS = 20
_KERNEL = 3.0  # standard deviations at which a residual loses three quarters of its weight
_WIDER = 3.0  # times that, in the first iteration
_NARROWS = 0.6  # per iteration
_LEANS = 3.0  # standard deviations of a normal: a plane constrains a direction that leans so far out of it
_ENOUGH = 5.0  # as many planes across a direction constrain it enough
_LITTLE = 0.01  # share kept of the information on a direction with fewer
_STILL = (1e-3, 1e-4)  # metres, radians: a step less than this ends the iterations

Motion = Callable[[Matrix], Vector]


@dataclass(frozen=True, eq=False)
class Prior:
    """A predicted pose (4, 4), with the information matrix (6, 6) of its right perturbation."""

    T: Matrix
    information: Matrix


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose `T` (4, 4) of the sensor in the map.

    `information` (6, 6) is the scan's own, of a right perturbation, reduced along the directions that it constrains
    too little: those are `blind` (K, 6), unit twists. `inliers` is the share of the `paired` points that agree with
    their planes; `known` that of all points in mapped places; `rmse` is over the inliers, metres. `births` (K,) are
    those of the planes, with `weights` (K,).
    """

    T: Matrix
    information: Matrix
    blind: Array
    paired: int
    inliers: float
    known: float
    rmse: float
    births: NDArray[np.int64]
    weights: Array


@dataclass(frozen=True, eq=False)
class _Equations:
    H: Matrix
    b: Vector
    pairs: Pairs
    residuals: Array  # over their standard deviation
    weights: Array  # of the kernel, 0 to 1
    J: Matrix


def fit(scan: Scan, planes: PlaneMap, prior: Prior, motion: Motion, noise: float) -> Fit:
    """Returns the pose near the predicted one, by Gauss-Newton on distances from planes.

    `motion` gives the velocity (6,) during the scan that a pose means; `noise` is the standard deviation of a range,
    metres. The kernel is Geman and McClure's, narrowing, as in Vizzo et al., "KISS-ICP", 2023. Directions without
    support are constrained by planes that lean out of them: Tuna et al., "X-ICP", 2023; there the prediction stands.
    """
    points, offsets = scan.points[scan.sample], None if scan.offsets is None else scan.offsets[scan.sample]
    T, settled = _descended(points, offsets, planes, prior, motion, noise, _LITTLE)
    if not settled:  # the little that is kept of blind directions may carry a pose away
        T, _ = _descended(points, offsets, planes, prior, motion, noise, 0.0)
    sensor = deskewed(points, offsets, motion(T))
    system = _equations(sensor, planes, T, _KERNEL, noise)
    blind = _blind(system, sensor)
    agree = np.abs(system.residuals) < _KERNEL
    metres = system.residuals * np.sqrt(noise**2 + system.pairs.thickness)
    return Fit(
        T=se3.orthonormalised(T),
        information=_without(system.H, blind),
        blind=blind,
        paired=len(agree),
        inliers=float(agree.mean()) if len(agree) else 0.0,
        known=system.pairs.known,
        rmse=float(np.sqrt(np.square(metres[agree]).mean())) if agree.any() else float("nan"),
        births=system.pairs.births,
        weights=system.weights,
    )


def _descended(
    points: Array, offsets: Array | None, planes: PlaneMap, prior: Prior, motion: Motion, noise: float, little: float
) -> tuple[Matrix, bool]:
    """Returns the pose after the iterations, with a share kept of blind directions, and whether it settled."""
    T, seeing = prior.T, np.eye(6)
    for iteration in range(ITERATIONS):
        width = _KERNEL * max(1.0, _WIDER * _NARROWS**iteration)
        sensor = deskewed(points, offsets, motion(T))
        system = _equations(sensor, planes, T, width, noise)
        if iteration == 0:
            seeing = _seeing(_blind(system, sensor), little)
        off = se3.log(invert(prior.T) @ T)
        gradient = seeing @ seeing @ system.b + prior.information @ off
        step = gauss_newton_step(seeing @ system.H @ seeing + prior.information, gradient)
        T = np.asarray(T @ se3.exp(step), np.float64)
        if np.linalg.norm(step[:3]) < _STILL[0] and np.linalg.norm(step[3:]) < _STILL[1]:
            return T, True
    return T, False


def agreements(points: Array, planes: PlaneMap, T: Array, noise: float, width: float) -> Array:
    """Returns how many of the points (N, 3), seen from each pose (K, 4, 4), lie on planes: a point counts at most 1."""
    world = (points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]).reshape(-1, 3)
    pairs = planes.pairs(world)
    distance = np.einsum("ij,ij->i", world[pairs.points] - pairs.centers, pairs.normals)
    weights = geman_mcclure(np.square(distance) / (noise**2 + pairs.thickness) / width**2)
    return np.bincount(pairs.points // len(points), weights, len(T)).astype(np.float64)


def _equations(points: Array, planes: PlaneMap, T: Matrix, width: float, noise: float) -> _Equations:
    """Returns the normal equations of the residuals (p - centre) . normal for a right perturbation of T."""
    R = T[:3, :3]
    world = points @ R.T + T[:3, 3]
    pairs = planes.pairs(world)
    off = world.take(pairs.points, axis=0) - pairs.centers
    deviation = np.sqrt(noise**2 + pairs.thickness + pairs.slopes * np.einsum("ij,ij->i", off, off))
    residuals = np.einsum("ij,ij->i", off, pairs.normals) / deviation
    weights = geman_mcclure(np.square(residuals / width))
    normals = pairs.normals @ R
    own = points.take(pairs.points, axis=0)
    J = np.empty((len(own), 6))
    J[:, :3] = normals
    J[:, 3] = own[:, 1] * normals[:, 2] - own[:, 2] * normals[:, 1]
    J[:, 4] = own[:, 2] * normals[:, 0] - own[:, 0] * normals[:, 2]
    J[:, 5] = own[:, 0] * normals[:, 1] - own[:, 1] * normals[:, 0]
    J /= deviation[:, None]
    weighted = J * weights[:, None]
    return _Equations(weighted.T @ J, weighted.T @ residuals, pairs, residuals, weights, J)


def _blind(system: _Equations, points: Array) -> Array:
    """Returns unit twists (K, 6) that too few planes constrain: translations first, then rotations about the sensor."""
    own, slopes = points[system.pairs.points], system.pairs.slopes
    deviation = np.sqrt(np.einsum("ij,ij->i", system.J[:, :3], system.J[:, :3]))
    lean = system.J / np.maximum(deviation, 1e-12)[:, None]
    lean[:, 3:] /= np.maximum(np.sqrt(np.einsum("ij,ij->i", own, own)), 1e-6)[:, None]
    found = []
    for part in (slice(0, 3), slice(3, 6)):
        weighted = lean[:, part] * system.weights[:, None]
        _, axes = np.linalg.eigh(weighted.T @ lean[:, part])
        square = np.square(lean[:, part] @ axes)
        told = (np.where(square > _LEANS**2 * slopes[:, None], square, 0.0) * system.weights[:, None]).sum(axis=0)
        for k in np.flatnonzero(told < _ENOUGH):
            twist = np.zeros(6)
            twist[part] = axes[:, k]
            found.append(twist)
    return np.array(found).reshape(-1, 6)


def _seeing(blind: Array, little: float = _LITTLE) -> Matrix:
    """Returns the matrix (6, 6) that leaves a share of the information on the blind directions."""
    seeing: Matrix = np.eye(6) - (1 - np.sqrt(little)) * (blind.T @ blind)
    return seeing


def _without(H: Matrix, blind: Array) -> Matrix:
    seeing = _seeing(blind)
    return seeing @ H @ seeing
