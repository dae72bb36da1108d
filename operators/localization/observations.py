"""Observations of a planar pose: how well each explains a pose, how far off it is, and where it would put the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from operators.estimation.particles import normalised, systematic, wrapped
from operators.localization.likelihood_field import LikelihoodField

Array = NDArray[np.float64]
_MEDIAN = {1: 0.455, 2: 1.386, 3: 2.366}
"""Median of chi-square by degrees of freedom."""


class Observation(Protocol):
    """One message of a sensor about the pose."""

    def score(self, poses: Array) -> tuple[Array, Array]:
        """Returns logarithms of the likelihood (N,) of poses (N, 3), and how well each fits (N,), [0, 1]."""
        ...

    def misfit(self, pose: Array, covariance: Array) -> float:
        """Returns the squared innovation at a predicted pose, over the one that its noise and the pose's explain."""
        ...

    def propose(self, count: int, rng: np.random.Generator) -> Array:
        """Draws poses (count, 3) that would explain the observation."""
        ...

    @property
    def whole(self) -> bool:
        """Returns whether it can place the robot with its heading, alone."""
        ...


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (M, 2) of a lidar in the robot's frame, metres, against a map.

    Neighbouring points err together, so all of them are worth no more than `worth` independent ones. `search`: how many
    poses are tried when the robot is looked for.
    """

    field: LikelihoodField
    points: Array
    worth: float = 15.0
    search: int = 3000
    whole = True

    def score(self, poses: Array) -> tuple[Array, Array]:
        mean = self.field.score(poses, self.points)
        return mean * min(self.worth, len(self.points)), np.exp(mean)

    def misfit(self, pose: Array, covariance: Array) -> float:
        reach = np.square(self.points).sum(axis=1)
        explained = self.field.sigma**2 + np.trace(covariance[:2, :2]) / 2 + covariance[2, 2] * reach / 2
        return float(np.median(np.square(self.field.distances(pose, self.points)) / explained)) / _MEDIAN[1]

    def propose(self, count: int, rng: np.random.Generator) -> Array:
        """Tries places all over the map against a broad field and few points, and goes on about the best of them."""
        few = self.points[:: max(1, len(self.points) // 24)]
        tried = self.field.places(self.search, rng)
        kept = tried[np.argsort(-self.field.score(tried, few, broad=True), kind="stable")[: max(8, self.search // 60)]]
        for spread, heading in ((0.25, 0.15), (0.1, 0.05)):
            near = np.repeat(kept, 8, axis=0)
            near[:, :2] += rng.normal(0, spread, (len(near), 2))
            near[:, 2] = wrapped(near[:, 2] + rng.normal(0, heading, len(near)))
            near = np.vstack([kept, near])
            quality = self.field.score(near, few, broad=spread > 0.2)
            kept = near[np.argsort(-quality, kind="stable")[: len(kept)]]
        logarithms, _ = self.score(kept)
        return np.asarray(kept[systematic(normalised(logarithms / 3), count, float(rng.random()))])


@dataclass(frozen=True, eq=False)
class Sightings:
    """Landmarks or objects seen at (M, 2) in the robot's frame with covariances (M, 2, 2), and where each may be.

    `places`: for each sighting the (K, 2) places of the map's landmarks that it may be of: one, where it is known.
    `stray`: share of sightings of something that is not in the map.
    """

    seen: Array
    covariances: Array
    places: tuple[Array, ...]
    stray: float = 0.05

    @property
    def whole(self) -> bool:
        return len(self.seen) > 1

    def score(self, poses: Array) -> tuple[Array, Array]:
        total, fits = np.zeros(len(poses)), np.zeros(len(poses))
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        for seen, C, places in zip(self.seen, self.covariances, self.places, strict=True):
            nearest = self._nearest(poses, c, s, places, seen, np.linalg.inv(C))
            fit = (1.0 - self.stray) * np.exp(-0.5 * nearest)
            total += np.log(fit + self.stray * 1e-2)
            fits += fit
        return total, fits / len(self.seen)

    @staticmethod
    def _nearest(poses: Array, c: Array, s: Array, places: Array, seen: Array, information: Array) -> Array:
        """Mahalanobis distance (N,), squared, of a sighting to the nearest of its places."""
        dx, dy = places[:, 0] - poses[:, :1], places[:, 1] - poses[:, 1:2]
        x = c[:, None] * dx + s[:, None] * dy - seen[0]
        y = c[:, None] * dy - s[:, None] * dx - seen[1]
        off = information[0, 0] * x * x + 2 * information[0, 1] * x * y + information[1, 1] * y * y
        return np.asarray(off.min(axis=1))

    def misfit(self, pose: Array, covariance: Array) -> float:
        c, s = np.cos(pose[2:]), np.sin(pose[2:])
        off = []
        for seen, C, places in zip(self.seen, self.covariances, self.places, strict=True):
            around = covariance[2, 2] * np.array(
                [[seen[1] ** 2, -seen[0] * seen[1]], [-seen[0] * seen[1], seen[0] ** 2]]
            )
            explained = C + np.eye(2) * np.trace(covariance[:2, :2]) / 2 + around
            off.append(float(self._nearest(pose[None], c, s, places, seen, np.linalg.inv(explained))[0]))
        return float(np.median(off)) / _MEDIAN[2]

    def propose(self, count: int, rng: np.random.Generator) -> Array:
        """Puts pairs of sightings onto places that are as far apart; one alone gives only its distance."""
        M = len(self.seen)
        noise = np.linalg.cholesky(self.covariances)
        first = rng.integers(0, M, count)
        second = (first + rng.integers(1, M, count)) % M if M > 1 else first
        poses = np.empty((count, 3))
        for k, (i, j) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
            a = self.seen[i] + noise[i] @ rng.standard_normal(2)
            p = self.places[i][rng.integers(0, len(self.places[i]))]
            if i == j:
                heading = rng.uniform(-math.pi, math.pi)
            else:
                b = self.seen[j] + noise[j] @ rng.standard_normal(2)
                apart = np.linalg.norm(self.places[j] - p, axis=1) - np.linalg.norm(b - a)
                q = self.places[j][int(np.abs(apart).argmin())]
                heading = math.atan2(*(q - p)[::-1]) - math.atan2(*(b - a)[::-1])
            c, s = math.cos(heading), math.sin(heading)
            poses[k] = p[0] - c * a[0] + s * a[1], p[1] - s * a[0] - c * a[1], heading
        poses[:, 2] = wrapped(poses[:, 2])
        return poses


@dataclass(frozen=True, eq=False)
class Placed:
    """A position (2,) of a point at `lever` (2,) on the robot, with covariance (2, 2), and perhaps a heading.

    `heading`: (yaw, variance). `stray`: share of positions that are wrong.
    """

    place: Array
    covariance: Array
    lever: Array
    heading: tuple[float, float] | None = None
    stray: float = 0.05

    @property
    def whole(self) -> bool:
        return self.heading is not None

    def _off(self, poses: Array, spread: Array, turning: float) -> Array:
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        x = poses[:, 0] + c * self.lever[0] - s * self.lever[1] - self.place[0]
        y = poses[:, 1] + s * self.lever[0] + c * self.lever[1] - self.place[1]
        off = np.einsum("in,ij,jn->n", np.vstack([x, y]), np.linalg.inv(self.covariance + spread), np.vstack([x, y]))
        if self.heading is not None:
            off = off + np.square(wrapped(poses[:, 2] - self.heading[0])) / (self.heading[1] + turning)
        return np.asarray(off)

    def score(self, poses: Array) -> tuple[Array, Array]:
        fit = (1.0 - self.stray) * np.exp(-0.5 * self._off(poses, np.zeros((2, 2)), 0.0))
        return np.log(fit + self.stray * 1e-2), fit

    def misfit(self, pose: Array, covariance: Array) -> float:
        freedom = 2 if self.heading is None else 3
        return float(self._off(pose[None], covariance[:2, :2], float(covariance[2, 2]))[0]) / freedom

    def propose(self, count: int, rng: np.random.Generator) -> Array:
        yaw = rng.uniform(-math.pi, math.pi, count)
        if self.heading is not None:
            yaw = self.heading[0] + rng.normal(0, math.sqrt(self.heading[1]), count)
        place = self.place + rng.standard_normal((count, 2)) @ np.linalg.cholesky(self.covariance).T
        c, s = np.cos(yaw), np.sin(yaw)
        x = place[:, 0] - c * self.lever[0] + s * self.lever[1]
        y = place[:, 1] - s * self.lever[0] - c * self.lever[1]
        return np.column_stack([x, y, wrapped(yaw)])
