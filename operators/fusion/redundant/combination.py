"""Combines measurements of one state by several sensors, weighted by covariance, and names contradicting sensors.

Positions with full covariance and bearings, of which only the direction is known, are solved for together, so bearings
alone are triangulated. Rotations are averaged on the manifold: Hartley et al., "Rotation averaging", 2013.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.estimation.least_squares import gauss_newton_step
from operators.fusion.filter.error_state import exp_rotation, log_rotation
from operators.fusion.filter.gate import threshold

Array = NDArray[np.float64]
_ITERATIONS, _CONVERGED = 20, 1e-9


class Unknown(Exception):
    """Raised when the measurements do not determine a result; the message names the reason."""


@dataclass(frozen=True, eq=False)
class Place:
    """A position (3,) with covariance (3, 3), metres."""

    position: Array
    covariance: Array

    def pull(self, point: Array) -> tuple[Array, Array]:
        """Returns the way (3,) from a point to where the sensor puts it, and its information (3, 3)."""
        return self.position - point, inverted(self.covariance)


@dataclass(frozen=True, eq=False)
class Bearing:
    """A unit direction (3,) from an origin (3,), with the standard deviation of its angle, radians."""

    origin: Array
    direction: Array
    sigma: float

    def pull(self, point: Array) -> tuple[Array, Array]:
        way = point - self.origin
        across = np.eye(3) - np.outer(self.direction, self.direction)
        distance = max(float(self.direction @ way), 1e-2)
        return -across @ way, across / (self.sigma * distance) ** 2


@dataclass(frozen=True, eq=False)
class RigidPose:
    """A position (3,) and a rotation (3, 3), with information (6, 6) about both: 0 where nothing is known.

    Errors are (x, y, z, rotation about the fixed axes), as those of `Pose`.
    """

    position: Array
    rotation: Array
    information: Array


def inverted(matrix: Array) -> Array:
    """Returns the inverse (N, N): covariance of an information, and the other way round."""
    return np.asarray(np.linalg.inv(matrix), np.float64)


def placed(seen: Sequence[Place | Bearing], largest: float = 5.0) -> tuple[Array, Array]:
    """Returns the position (3,) that explains all best, and its covariance (3, 3).

    Raises Unknown where no more than bearings are given that do not cross in front of the sensors, or where the result
    is known to no better than `largest` metres.
    """
    point = _start(seen)
    for _ in range(_ITERATIONS):
        pulls = [one.pull(point) for one in seen]
        information = sum((J for _, J in pulls), np.zeros((3, 3)))
        if float(np.linalg.eigvalsh(information)[0]) < 1.0 / largest**2:
            raise Unknown("bearings that are all but parallel")
        step = gauss_newton_step(information, sum((-J @ r for r, J in pulls), np.zeros(3)))
        point = point + step
        if float(np.linalg.norm(step)) < _CONVERGED:
            break
    if any(float(one.direction @ (point - one.origin)) <= 0 for one in seen if isinstance(one, Bearing)):
        raise Unknown("bearings that cross behind a sensor")
    return point, inverted(information)


def _start(seen: Sequence[Place | Bearing]) -> Array:
    """A sensor's own position, else the point nearest to all rays."""
    for one in seen:
        if isinstance(one, Place):
            return one.position
    rays = [one for one in seen if isinstance(one, Bearing)]
    across = [np.eye(3) - np.outer(ray.direction, ray.direction) for ray in rays]
    together = sum(across, np.zeros((3, 3)))
    if len(rays) < 2 or float(np.linalg.eigvalsh(together)[0]) < 1e-6:
        raise Unknown("a single bearing" if len(rays) < 2 else "bearings that are all but parallel")
    towards = sum((A @ ray.origin for A, ray in zip(across, rays, strict=True)), np.zeros(3))
    return np.asarray(np.linalg.solve(together, towards))


def posed(seen: Sequence[RigidPose]) -> RigidPose:
    """Returns the pose that explains all best; its information is the sum of theirs.

    Directions that no sensor measures keep the first's value. Iterates on the manifold, so rotations far apart have a
    mean, too.
    """
    position, R = seen[0].position, seen[0].rotation
    for one in seen:  # begin where something is known
        if float(np.trace(one.information[3:, 3:])) > 0:
            R = one.rotation
            break
    for one in seen:
        if float(np.trace(one.information[:3, :3])) > 0:
            position = one.position
            break
    information = np.asarray(sum((one.information for one in seen), np.zeros((6, 6))))
    for _ in range(_ITERATIONS):
        pull = np.zeros(6)
        for one in seen:
            pull += one.information @ np.concatenate([one.position - position, log_rotation(one.rotation @ R.T)])
        step = np.linalg.pinv(information, hermitian=True) @ pull
        position, R = position + step[:3], exp_rotation(step[3:]) @ R
        if float(np.linalg.norm(step)) < _CONVERGED:
            break
    return RigidPose(position, R, information)


def place_misfits(seen: Sequence[Place | Bearing]) -> Array:
    """Returns for each (K,) its squared distance from the others' combination, over the one explained.

    NaN where the others determine nothing.
    """
    found = np.full(len(seen), np.nan)
    for k, one in enumerate(seen):
        try:
            point, covariance = placed([other for other in seen if other is not one])
        except Unknown:
            continue
        found[k] = _normalised(*one.pull(point), covariance)
    return found


def pose_misfits(seen: Sequence[RigidPose]) -> Array:
    """Returns for each (K,) its squared distance from the others' combination, over the one explained; NaN if none."""
    found = np.full(len(seen), np.nan)
    for k, one in enumerate(seen):
        others = [other for other in seen if other is not one]
        if not others:
            continue
        mean = posed(others)
        off = np.concatenate([one.position - mean.position, log_rotation(one.rotation @ mean.rotation.T)])
        known = (np.diag(one.information) > 0) & (np.diag(mean.information) > 0)
        if known.any():
            chosen = np.ix_(known, known)
            spread = inverted(mean.information[chosen])
            found[k] = _normalised(off[known], one.information[chosen], spread)
    return found


def _normalised(off: Array, information: Array, spread: Array) -> float:
    """Squared distance over its degrees of freedom, along the directions with information."""
    values, vectors = np.linalg.eigh(information)
    known = values > 1e-9 * max(float(values[-1]), 1e-12)
    axes = vectors[:, known]
    S = np.diag(1.0 / values[known]) + axes.T @ spread @ axes
    residual = axes.T @ off
    return float(residual @ np.linalg.solve(S, residual)) / int(known.sum())


def place_consistency(seen: Sequence[Place | Bearing]) -> tuple[float, int]:
    """Returns the sum of squared normalised residuals about what all say together, and its degrees of freedom."""
    try:
        point, _ = placed(seen, largest=1e3)
    except Unknown:
        return 0.0, 0
    freedom = sum(2 if isinstance(one, Bearing) else 3 for one in seen) - 3
    pulls = [one.pull(point) for one in seen]
    return sum(float(r @ J @ r) for r, J in pulls), freedom


def pose_consistency(seen: Sequence[RigidPose]) -> tuple[float, int]:
    """Returns the sum of squared normalised residuals about what all say together, and its degrees of freedom."""
    mean = posed(seen)
    total = 0.0
    for one in seen:
        off = np.concatenate([one.position - mean.position, log_rotation(one.rotation @ mean.rotation.T)])
        total += float(off @ one.information @ off)
    ranks = [int(np.linalg.matrix_rank(one.information, hermitian=True)) for one in (*seen, mean)]
    return total, sum(ranks[:-1]) - ranks[-1]


def contradicts(consistency: tuple[float, int], share: float) -> bool:
    """Returns whether residuals are larger than chance makes them in the given share of cases."""
    total, freedom = consistency
    return freedom > 0 and total > threshold(share, freedom)
