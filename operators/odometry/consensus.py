"""The rigid motion that most of many doubtful pairs of points agree on, where nine in ten may be wrong.

Two pairs agree where they lie as far apart in one view as in the other; a clique of pairs that all agree gives the
motion (Leordeanu and Hebert, 2005; Yang et al., "TEASER", 2020). Random samples of three would need thousands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from operators.geometry.pinhole import Points
from operators.geometry.rigid import distances, fitted_motions
from operators.geometry.se3 import Matrix

SLACK = 0.04  # metres by which two distances may differ, and so much more for each metre of depth
SLACK_PER_METRE = 0.01
APART = 0.15  # metres: points nearer to each other do not constrain a rotation
GATE = 0.12  # metres by which a point may be off the motion
SEEDS = 4  # cliques that are tried
FEWEST = 4  # points of a clique


@dataclass(frozen=True, eq=False)
class Consensus:
    """T_a_b, which of the pairs (N,) agree with it, and how many different points of b these are."""

    T_a_b: Matrix
    agree: NDArray[np.bool_]
    count: int


def consensus(a: Points, b: Points, names: NDArray[np.int64]) -> list[Consensus]:
    """Returns the motions on which pairs (N, 3), (N, 3) agree, that of the most first; b in a camera's axes, z forward.

    A point of b may come in several pairs, by the same name (N,), and counts once. No two motions share most of their
    pairs, so that a second one is of a place that looks alike.
    """
    if len(a) < FEWEST:
        return []
    slack = SLACK / 2 + SLACK_PER_METRE * b[:, 2]
    between_b = distances(b)
    fits = (np.abs(distances(a) - between_b) < slack[:, None] + slack) & (between_b > APART)
    links = fits.astype(np.float32)
    triangles = ((links @ links) * links).sum(axis=1)
    grown: list[Consensus] = []
    tried = np.zeros(len(a), np.bool_)
    for _ in range(SEEDS):
        seed = int(np.argmax(np.where(tried, -1.0, triangles)))
        if tried[seed] or triangles[seed] <= 0:
            break
        clique = _clique(links, seed)
        tried[clique] = True
        if len(np.unique(names[clique])) < FEWEST:
            continue
        grown.append(_grown(a, b, names, clique))
        tried |= grown[-1].agree
    distinct: list[Consensus] = []
    for found in sorted(grown, key=lambda one: -one.count):
        shared = (np.count_nonzero(found.agree & other.agree) for other in distinct)
        if all(2 * count < np.count_nonzero(found.agree) for count in shared):
            distinct.append(found)
    return distinct


def _clique(links: NDArray[np.float32], seed: int) -> NDArray[np.intp]:
    """Returns pairs that all agree: a seed and its friends, those with most friends among the rest first."""
    friends = np.flatnonzero(links[seed])
    among = links[np.ix_(friends, friends)]
    chosen, left = [seed], np.ones(len(friends), np.float32)
    while left.any():
        next_ = int(np.argmax(np.where(left > 0, among @ left, -1.0)))
        chosen.append(int(friends[next_]))
        left[next_] = 0.0
        left *= among[next_]
    return np.array(chosen, np.intp)


def _grown(a: Points, b: Points, names: NDArray[np.int64], clique: NDArray[np.intp]) -> Consensus:
    """Returns the motion of a clique, fitted again to all pairs that agree with it."""
    T = _rigid(a[clique], b[clique])
    for _ in range(5):
        agree = _near(a, b, T)
        if len(np.unique(names[agree])) < FEWEST:
            break
        T = _rigid(a[agree], b[agree])
    agree = _near(a, b, T)
    return Consensus(T, agree, len(np.unique(names[agree])))


def _rigid(a: Points, b: Points) -> Matrix:
    """Returns T_a_b of least squares."""
    return np.asarray(fitted_motions(b[None], a[None], np.full((1, len(a)), 1 / len(a)))[0], np.float64)


def _near(a: Points, b: Points, T_a_b: Matrix) -> NDArray[np.bool_]:
    off = transform_points(T_a_b, b) - a
    return np.asarray(np.einsum("ij,ij->i", off, off) < GATE**2, np.bool_)
