"""Planar EKF-SLAM with point landmarks, on the error that makes it consistent.

The state is the robot's pose and every landmark in the map frame. The filter's error is right-invariant,
`X_estimate = exp(xi) X`: one small motion of the map frame moves the pose and all landmarks alike. So what cannot be
observed (where the map frame lies) stays unobserved in the linearised filter too, and the map does not become
overconfident as that of the textbook filter does. Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency
properties", 2015; Zhang et al., "Convergence and consistency analysis for a 3-D invariant-EKF SLAM", 2017.

xi = (rotation, robot x, robot y, landmark 0 x, landmark 0 y, ...). Motion leaves xi as it is and adds noise; the
innovation of a sighting is linear in it, with a constant Jacobian.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import linear_sum_assignment

from operators.estimation.chi_square import quantile

Array = NDArray[np.float64]
_FIRST = 3
_GROW = 64
_IGNORED, _NEW = -1, -2
_J = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True)
class Association:
    """Rules by which sightings without identity are told apart.

    A sighting belongs to a landmark within `gate` (probability that a true pair passes); it is a new landmark beyond
    `new` of all; between the two it is ambiguous and ignored.
    """

    gate: float = 0.99
    new: float = 0.999999

    @property
    def gate_distance(self) -> float:
        return float(quantile(self.gate, 2))

    @property
    def new_distance(self) -> float:
        return float(quantile(self.new, 2))


@dataclass
class Counts:
    """Counts of sightings by their fate: `ambiguous` ones lie between a known landmark's gate and a new landmark."""

    matched: int = 0
    added: int = 0
    ambiguous: int = 0


@dataclass
class LandmarkFilter:
    """The filter. Lengths in metres, angles in radians; the first pose is the origin of the map frame."""

    association: Association = field(default_factory=Association)
    heading: float = 0.0
    position: Array = field(default_factory=lambda: np.zeros(2))
    counts: Counts = field(default_factory=Counts)
    ids: list[int] = field(default_factory=list)
    """Identity of each landmark, as given or, where none was, numbered from 0."""

    def __post_init__(self) -> None:
        self._landmarks = np.zeros((_GROW, 2))
        self._P = np.zeros((_FIRST + 2 * _GROW, _FIRST + 2 * _GROW))
        self._index = {identity: k for k, identity in enumerate(self.ids)}
        self._moved = np.zeros((3, 3))

    def snapshot(self) -> dict[str, Any]:
        """Returns the filter's state, as plain values and arrays."""
        size = _FIRST + 2 * len(self.ids)
        return {
            "heading": self.heading,
            "position": self.position,
            "ids": np.array(self.ids, np.int64),
            "landmarks": self.landmarks,
            "covariance": self._P[:size, :size].copy(),
            "moved": self._moved,
            "counts": [self.counts.matched, self.counts.added, self.counts.ambiguous],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes over what `snapshot` gave."""
        self.heading, self.position = float(state["heading"]), np.array(state["position"])
        self.ids = [int(i) for i in state["ids"]]
        count, size = len(self.ids), len(state["covariance"])
        room = max(_GROW, count)
        self._landmarks, self._P = np.zeros((room, 2)), np.zeros((_FIRST + 2 * room, _FIRST + 2 * room))
        self._landmarks[:count], self._P[:size, :size] = state["landmarks"], state["covariance"]
        self._moved = np.array(state["moved"])
        self._index = {identity: k for k, identity in enumerate(self.ids)}
        self.counts = Counts(*(int(n) for n in state["counts"]))

    # What is known

    @property
    def landmarks(self) -> Array:
        """Positions (N, 2) of the landmarks in the map frame."""
        return self._landmarks[: len(self.ids)].copy()

    def pose_covariance(self) -> Array:
        """Covariance (3, 3) of (x, y, heading) in the map frame."""
        A = np.zeros((3, 3))  # additive errors from xi: p_estimate - p = xi_p + xi_theta J p
        A[:2, 0] = _J @ self.position
        A[:2, 1:] = np.eye(2)
        A[2, 0] = 1.0
        return A @ (self._P[:3, :3] + self._moved) @ A.T

    def landmark_covariances(self) -> Array:
        """Covariances (N, 2, 2) of the landmarks in the map frame."""
        self._settle()
        P, out = self._P, np.empty((len(self.ids), 2, 2))
        for k, landmark in enumerate(self.landmarks):
            rows = [0, _FIRST + 2 * k, _FIRST + 2 * k + 1]
            A = np.column_stack([_J @ landmark, np.eye(2)])
            out[k] = A @ P[np.ix_(rows, rows)] @ A.T
        return out

    # Motion

    def move(self, forward: Array, turn: float, covariance: Array) -> None:
        """Moves the robot by `forward` (x, y in its own frame) and `turn`, with covariance (3, 3) of (x, y, turn)."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        self.position = self.position + np.array([c * forward[0] - s * forward[1], s * forward[0] + c * forward[1]])
        self.heading = _wrapped(self.heading + turn)
        B = np.zeros((3, 3))
        B[0, 2] = 1.0
        B[1:, 2] = -_J @ self.position
        B[1, 0], B[1, 1], B[2, 0], B[2, 1] = c, -s, s, c
        self._moved += B @ covariance @ B.T

    def _settle(self) -> None:
        """Takes the motion since the last sighting into the covariance of everything.

        The rotation's noise turns the estimate about the robot, not about the origin, so it reaches the landmarks.
        """
        if not self._moved.any():
            return
        count = len(self.ids)
        size = _FIRST + 2 * count
        A = np.zeros((size, 3))
        A[:3] = np.eye(3)
        A[_FIRST:, 0] = -(self._landmarks[:count] @ _J.T).ravel()
        G = A @ _root(self._moved)
        self._P[:size, :size] += G @ G.T
        self._moved = np.zeros((3, 3))

    # Sightings

    def see(self, identities: Sequence[int], sighted: Array, covariances: Array) -> list[int]:
        """Takes the sightings of one moment: identities (-1 for unknown), positions (N, 2) and covariances (N, 2, 2) in
        the robot's frame. Returns, for each, the index of its landmark, or -1 where it was ignored.
        """
        self._settle()
        R = _rotation(self.heading)
        found = [self._index.get(identity, _NEW) if identity >= 0 else _IGNORED for identity in identities]
        unknown = [k for k, identity in enumerate(identities) if identity < 0]
        if unknown:
            offsets, noises = sighted[unknown] @ R.T, R @ covariances[unknown] @ R.T
            for k, landmark in zip(unknown, self._associate(offsets, noises), strict=True):
                found[k] = landmark
        known = [k for k, landmark in enumerate(found) if landmark >= 0]
        if known:
            self._update([found[k] for k in known], sighted[known] @ R.T, R @ covariances[known] @ R.T)
        R = _rotation(self.heading)
        for k, landmark in enumerate(found):
            if landmark == _NEW:
                found[k] = self._add(int(identities[k]), R @ sighted[k], R @ covariances[k] @ R.T)
        return found

    def _distances(self, offsets: Array, noise: Array) -> Array:
        """Squared Mahalanobis distances (N, landmarks) of sightings, offsets (N, 2) in the map frame."""
        count = len(self.ids)
        P = self._P
        pp = P[1:3, 1:3]
        slots = _FIRST + 2 * np.arange(count)
        ll = np.stack(
            [
                np.stack([P[slots, slots], P[slots, slots + 1]], -1),
                np.stack([P[slots + 1, slots], P[slots + 1, slots + 1]], -1),
            ],
            -2,
        )
        pl = np.stack([P[1:3][:, slots], P[1:3][:, slots + 1]], -1).transpose(1, 0, 2)
        spread = pp + ll - pl - pl.transpose(0, 2, 1)
        r = offsets[:, None] - (self._landmarks[:count] - self.position)[None]
        S = spread[None] + noise[:, None]
        distances: Array = np.einsum("nki,nki->nk", r, np.linalg.solve(S, r[..., None])[..., 0])
        return distances

    def _associate(self, offsets: Array, noise: Array) -> list[int]:
        """Landmark of each sighting, each landmark once; `_IGNORED` for an ambiguous one, `_NEW` for a new landmark."""
        if not self.ids:
            return [_NEW] * len(offsets)
        distances = self._distances(offsets, noise)
        gate = self.association.gate_distance
        rows, columns = linear_sum_assignment(np.minimum(distances, 10 * gate))
        chosen = {int(r): int(c) for r, c in zip(rows, columns, strict=True) if distances[r, c] <= gate}
        result = []
        for k in range(len(offsets)):
            if k in chosen:
                result.append(chosen[k])
            elif distances[k].min() > self.association.new_distance:
                result.append(_NEW)
            else:
                self.counts.ambiguous += 1
                result.append(_IGNORED)
        return result

    def _update(self, landmarks: Sequence[int], offsets: Array, noise: Array) -> None:
        """Corrects everything by sightings of landmarks, their offsets (N, 2) in the map frame."""
        size = _FIRST + 2 * len(self.ids)
        at = _FIRST + 2 * np.asarray(landmarks)
        columns = np.stack([at, at + 1], -1).ravel()
        P = self._P[:size, :size]
        PHt = np.tile(P[:, 1:3], len(landmarks)) - P[:, columns]
        S = np.tile(PHt[1:3], (len(landmarks), 1)) - PHt[columns]
        for k, block in enumerate(noise):
            S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += block
        r = (offsets - (self._landmarks[landmarks] - self.position)).ravel()
        root = np.linalg.cholesky((S + S.T) / 2)
        G = solve_triangular(root, PHt.T, lower=True)
        self._correct(-(G.T @ solve_triangular(root, r, lower=True)))
        P -= G.T @ G
        self.counts.matched += len(landmarks)

    def _correct(self, xi: Array) -> None:
        """Applies exp(xi) to pose and landmarks."""
        turn = float(xi[0])
        R = _rotation(turn)
        a, b = (1.0, turn / 2) if abs(turn) < 1e-8 else (math.sin(turn) / turn, (1 - math.cos(turn)) / turn)
        V = np.array([[a, -b], [b, a]])
        count = len(self.ids)
        self.heading = _wrapped(self.heading + turn)
        self.position = R @ self.position + V @ xi[1:3]
        self._landmarks[:count] = self._landmarks[:count] @ R.T + xi[_FIRST:].reshape(-1, 2) @ V.T

    def _add(self, identity: int, offset: Array, noise: Array) -> int:
        """Adds a landmark at an offset from the robot, in the map frame; returns its index."""
        index = len(self.ids)
        size = _FIRST + 2 * index
        if index == len(self._landmarks):
            self._landmarks = np.concatenate([self._landmarks, np.zeros_like(self._landmarks)])
            P = np.zeros((_FIRST + 4 * index, _FIRST + 4 * index))
            P[:size, :size] = self._P[:size, :size]
            self._P = P
        self._landmarks[index] = self.position + offset
        self._P[size : size + 2, :size] = self._P[1:3, :size]
        self._P[:size, size : size + 2] = self._P[:size, 1:3]
        self._P[size : size + 2, size : size + 2] = self._P[1:3, 1:3] + noise
        number = identity if identity >= 0 else max(self.ids, default=-1) + 1
        self._index[number] = index
        self.ids.append(number)
        self.counts.added += 1
        return index


def _rotation(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def _root(covariance: Array) -> Array:
    """Returns L with L L^T = covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi
