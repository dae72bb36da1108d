"""Association of landmarks without identity: what is sure at once, and what is decided later by a constellation.

A sighting is matched at once only to a landmark whose place relative to the robot is known so well that no other can be
meant, and only with sightings that fit together jointly. Every other one begins a landmark. Whether two landmarks are
one is decided later, by all pairs that fit together: their joint likelihood as equals against that of as many separate
landmarks, and against every other pairing. Methods: Neira and Tardos, "Data association in stochastic mapping using the
joint compatibility test", 2001; Leonard and Rikoski, "Incorporation of delayed decision making into stochastic
mapping", 2001.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from operators.estimation.chi_square import quantile

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
_SURE, _FOLLOWED = 0.15, 0.3
"""Standard deviations of a landmark's place, over the mean distance of landmarks, below which no other can be meant: of
any, and of one that is followed from one message to the next."""
_MARGIN = 7.0
"""Logarithm of the ratio of likelihoods that decides (1,100 to 1)."""
_SEEDS = 40
"""Pairs from which pairings are grown, and whose evidence is compared, at most."""
_PRIOR_AREA = 10.0
"""Area of one landmark before any were seen side by side, m^2."""


@dataclass(frozen=True)
class Association:
    """Rules by which sightings without identity are associated.

    A sighting belongs to a landmark within `gate` (probability that a true pair passes); it is a new landmark beyond
    `new` of all; between the two it is ambiguous and ignored.
    """

    gate: float = 0.99
    new: float = 0.999999

    @property
    def new_distance(self) -> float:
        return float(quantile(self.new, 2))


@dataclass
class Density:
    """Density of landmarks, from how near to each other those lie that are seen at once."""

    count: int = 0
    area: float = 0.0

    @property
    def per_square_metre(self) -> float:
        return (1 + self.count) / (_PRIOR_AREA + self.area)

    def update(self, points: Array) -> None:
        """Takes the positions (N, 2) of one moment, m."""
        if len(points) > 1:
            apart = np.linalg.norm(points[:, None] - points[None], axis=2)
            np.fill_diagonal(apart, np.inf)
            self.count += len(points)
            self.area += float(math.pi * (apart.min(axis=1) ** 2).sum())


def tight(spread: Array, noise: Array, density: float, followed: Bools) -> Bools:
    """Returns which landmarks (N, M), of spread (M, 2, 2) relative to the robot, sightings of a noise (N, 2, 2) can be
    matched to at once: those known as well as they are seen, or that no other of such a density can be taken for.
    `followed` (M,): those that were seen just now.
    """
    known, seen = (np.sqrt(np.linalg.eigvalsh(one)[..., -1].clip(0.0)) for one in (spread, noise))
    return np.asarray(
        known[None] <= np.maximum(seen[:, None], np.where(followed, _FOLLOWED, _SURE) / math.sqrt(density))
    )


def nearest(distances: Array, spreads: Array, allowed: Bools, gate: float) -> dict[int, int]:
    """Returns the likeliest landmark of each sighting, each landmark once.

    `distances`: squared Mahalanobis distances (N, M), of covariances `spreads` (N, M, 2, 2), of allowed pairs (N, M).
    """
    inside = allowed & (distances <= gate)
    sizes = np.log(np.maximum(np.linalg.det(spreads), 1e-300))
    unmatched = gate + float(sizes.max(initial=0.0)) + 1.0
    cost = np.where(inside, distances + sizes, unmatched)
    rows, columns = linear_sum_assignment(cost)
    return {int(r): int(c) for r, c in zip(rows, columns, strict=True) if inside[r, c]}


def jointly_compatible(residuals: Array, covariance: Array, gate: float) -> list[int]:
    """Returns the rows of residuals (N, 2), of joint covariance (2N, 2N), that fit together within a probability."""
    kept = list(range(len(residuals)))
    while kept:
        columns = np.array([[2 * k, 2 * k + 1] for k in kept]).ravel()
        weight = np.linalg.inv(covariance[np.ix_(columns, columns)])
        r = residuals[kept].ravel()
        pulled = (weight @ r).reshape(-1, 2)
        if float(r @ pulled.ravel()) <= float(quantile(gate, 2 * len(kept))):
            break
        shares = [
            float(pulled[k] @ np.linalg.solve(weight[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], pulled[k]))
            for k in range(len(kept))
        ]
        kept.pop(int(np.argmax(shares)))
    return kept


def agreed_pairs(residuals: Array, covariance: Array, conflicts: Bools, density: float) -> list[int]:
    """Returns the pairs of landmarks that are one, beyond doubt: those in which all likely pairings agree.

    `residuals` (N, 2) and their joint covariance (2N, 2N) are of the differences of the landmarks of each pair;
    `conflicts` (N, N) are pairs that cannot hold together; `density` is of landmarks on a square metre.
    """
    found: dict[frozenset[int], float] = {}
    blocks = [covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(residuals))]
    gains = [_gain(residuals[k], blocks[k], density) for k in range(len(residuals))]
    for seed in np.argsort(gains)[::-1][:_SEEDS]:
        chosen, evidence = _grown(int(seed), residuals, covariance, conflicts, density)
        found[chosen] = max(evidence, found.get(chosen, -math.inf))
    best = max(found, key=lambda pairs: found[pairs])
    agreed = set(best)
    for pairs, evidence in found.items():
        rival = any(conflicts[a, b] for a in pairs for b in best)
        if rival and evidence > found[best] - _MARGIN:
            agreed -= {b for b in best if b not in pairs}
    rows = sorted(agreed)
    columns = np.array([[2 * k, 2 * k + 1] for k in rows], int).ravel()
    alone = _evidence(residuals[rows].ravel(), covariance[np.ix_(columns, columns)], density)
    return rows if rows and alone > _MARGIN else []


def _grown(
    seed: int, residuals: Array, covariance: Array, conflicts: Bools, density: float
) -> tuple[frozenset[int], float]:
    """Returns the pairing that grows from one pair by the likeliest next, and its evidence."""
    r, S = residuals.ravel().copy(), covariance.copy()
    chosen, evidence = (
        [seed],
        _gain(residuals[seed], covariance[2 * seed : 2 * seed + 2, 2 * seed : 2 * seed + 2], density),
    )
    free = ~conflicts[seed]
    free[seed] = False
    k = seed
    while free.any():
        at = slice(2 * k, 2 * k + 2)
        gain = np.linalg.solve(S[at, at], S[at]).T
        r, S = r - gain @ r[at], S - gain @ S[at]
        open_pairs = np.flatnonzero(free)
        gains = _gains(r.reshape(-1, 2)[open_pairs], S, open_pairs, density)
        if gains.max() <= 0:
            break
        k = int(open_pairs[int(gains.argmax())])
        chosen.append(k)
        evidence += float(gains.max())
        free &= ~conflicts[k]
        free[k] = False
    return frozenset(chosen), evidence


def _gains(residuals: Array, covariance: Array, pairs: NDArray[np.intp], density: float) -> Array:
    """Evidence (N,) of each pair given those that hold: as one landmark against two."""
    a, b, c = (
        covariance[2 * pairs, 2 * pairs],
        covariance[2 * pairs, 2 * pairs + 1],
        covariance[2 * pairs + 1, 2 * pairs + 1],
    )
    determinant = np.maximum(a * c - b * b, 1e-12)
    x, y = residuals.T
    distance = (c * x * x - 2 * b * x * y + a * y * y) / determinant
    return np.asarray(-0.5 * (distance + np.log(determinant)) - math.log(2 * math.pi * density))


def _gain(residual: Array, covariance: Array, density: float) -> float:
    return float(_gains(residual[None], covariance, np.zeros(1, np.intp), density)[0])


def _evidence(residual: Array, covariance: Array, density: float) -> float:
    """Logarithm of the likelihood of pairs as equals over that of as many separate landmarks."""
    sign, size = np.linalg.slogdet(covariance)
    if sign <= 0 or not len(residual):
        return -math.inf
    distance = float(residual @ np.linalg.solve(covariance, residual))
    return -0.5 * (distance + float(size)) - len(residual) / 2 * math.log(2 * math.pi * density)
