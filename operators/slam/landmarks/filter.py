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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from dataflow.messages.diagnostics import Level
from dataflow.operator import Remembered
from operators.estimation.chi_square import quantile
from operators.slam.landmarks.association import Association, Density, agreed_pairs, jointly_compatible, nearest, tight
from operators.slam.landmarks.consistency import Consistency

Array = NDArray[np.float64]
_FIRST = 3
_GROW = 64
_IGNORED, _NEW = -1, -2
_FOLLOWED = 3
"""Sightings within which a landmark was seen that is followed from one to the next."""
_LATELY = 10
"""Sightings within which a landmark was seen lately."""
_PAIRS = 80
"""Pairs of landmarks that may be one, looked at together, at most."""
_ALIKE = 0.999
"""Share of equal landmarks that are looked at."""
_PROVISIONAL, _TIMES = 20, 3
"""A landmark without identity that was not seen for so many sightings, and less than so many times, is dropped."""
_STRAYED = 0.3
"""Share of landmarks that are not at their places from which the odometry may have slipped."""
_SLIP = 100.0
"""Variance of the motion, over what it is taken for, that a slip has."""
_CONSTELLATION = 3
"""Landmarks at their places that prove a slip."""
_ASTRAY = (1.0, 1.0, 0.3)
"""Standard deviations of the pose of a robot that is lost: m, m, rad."""
_INCONSISTENT = 1.5
"""Innovations squared, over their expectation, above which covariances are too small."""
_EQUAL = 1e-3
"""Standard deviation of the difference of two landmarks that are one, m."""
_J = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass
class Counts:
    """Counts of sightings by their fate: `ambiguous` ones lie between a known landmark's gate and a new landmark,
    or fit alone, but not with the others; and of landmarks found to be one with an earlier one, and of those dropped.
    """

    matched: int = 0
    added: int = 0
    ambiguous: int = 0
    merged: int = 0
    dropped: int = 0


class LandmarkFilter(Remembered):
    """The filter. Lengths in metres, angles in radians; the first pose is the origin of the map frame."""

    heading: float
    position: Array
    counts: Counts
    ids: list[int]
    """Identity of each landmark, as given or, where none was, numbered from 0."""
    consistency: Consistency
    lost_among: int | None
    _landmarks: Array
    _P: Array
    _together: NDArray[np.bool_]
    _anonymous: NDArray[np.bool_]
    _seen: NDArray[np.int64]
    _times: NDArray[np.int64]
    _moved: Array
    _moments: int
    _density: Density

    def __init__(self, association: Association | None = None) -> None:
        self.association = association or Association()
        self.heading, self.position, self.counts, self.ids = 0.0, np.zeros(2), Counts(), []
        self.consistency, self.lost_among = Consistency(), None
        self._hold(_GROW)
        self._moved, self._moments, self._density = np.zeros((3, 3)), 0, Density()
        self._step = np.zeros((_FIRST, 3))  # root of what motion added to the covariance before the last sightings
        self._slip = 1.0  # variance of that motion over what it was taken for
        self.restored()

    def prepare_snapshot(self) -> None:
        count, size = len(self.ids), _FIRST + 2 * len(self.ids)
        self._landmarks, self._P = self._landmarks[:count], self._P[:size, :size]
        self._together, self._anonymous = self._together[:count, :count], self._anonymous[:count]
        self._seen, self._times = self._seen[:count], self._times[:count]

    def restored(self) -> None:
        self._index = {identity: k for k, identity in enumerate(self.ids)}

    def _hold(self, room: int) -> None:
        """Makes room for so many landmarks, none of them known."""
        size = _FIRST + 2 * room
        self._landmarks, self._P = np.zeros((room, 2)), np.zeros((size, size))
        self._together, self._anonymous = np.zeros((room, room), bool), np.zeros(room, bool)
        self._seen, self._times = np.zeros(room, np.int64), np.zeros(room, np.int64)

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
        """Covariances (N, 2, 2) of the landmarks in the map frame, which motion leaves as they are."""
        at = _FIRST + 2 * np.arange(len(self.ids))
        rows = np.stack([np.zeros_like(at), at, at + 1], -1)
        A = np.zeros((len(at), 2, 3))
        A[:, :, 0], A[:, 0, 1], A[:, 1, 2] = self.landmarks @ _J.T, 1.0, 1.0
        return np.asarray(A @ self._P[rows[:, :, None], rows[:, None, :]] @ A.transpose(0, 2, 1))

    @property
    def state(self) -> tuple[str, Level, str]:
        """State of the filter, its level, and a text about it."""
        noise, ratio = math.sqrt(self.consistency.odometry_variance), self.consistency.ratio
        if self.lost_among is not None:
            return "lost", Level.ERROR, "lost: landmarks are not at their places, none from before is found again"
        if ratio > _INCONSISTENT:
            text = f"inconsistent: innovations squared are {ratio:.1f} times what the covariance of sightings explains"
            return "inconsistent", Level.WARN, text
        if noise > 1:
            return "inconsistent", Level.WARN, f"inconsistent: the odometry is {noise:.1f} times as noisy as told"
        return "mapped", Level.OK, "mapped"

    # Motion

    def move(self, forward: Array, turn: float, covariance: Array) -> None:
        """Moves the robot by `forward` (x, y in its own frame) and `turn`, with covariance (3, 3) of (x, y, turn).

        Where innovations show that the odometry is noisier, the covariance counts for as much more.
        """
        before = self.heading
        self.position = self.position + _rotation(before) @ forward
        self.heading = _wrapped(before + turn)
        self._scatter(before, self.consistency.odometry_variance * covariance)

    def jump(self, covariance: Array) -> None:
        """Takes a motion that nothing measured, with covariance (3, 3) of (x, y, turn) in the robot's frame."""
        self._scatter(self.heading, covariance)

    def _scatter(self, heading: float, covariance: Array) -> None:
        c, s = math.cos(heading), math.sin(heading)
        B = np.zeros((3, 3))
        B[0, 2] = 1.0
        B[1:, 2] = -_J @ self.position
        B[1, 0], B[1, 1], B[2, 0], B[2, 1] = c, -s, s, c
        self._moved = self._moved + B @ covariance @ B.T

    def _settle(self) -> None:
        """Takes the motion since the last sighting into the covariance of everything.

        The rotation's noise turns the estimate about the robot, not about the origin, so it reaches the landmarks.
        """
        count = len(self.ids)
        size = _FIRST + 2 * count
        if not self._moved.any():
            return
        A = np.zeros((size, 3))
        A[:3] = np.eye(3)
        A[_FIRST:, 0] = -(self._landmarks[:count] @ _J.T).ravel()
        G = A @ _root(self._moved)
        self._step = G
        self._P[:size, :size] += G @ G.T
        self._moved = np.zeros((3, 3))

    # Sightings

    def see(self, identities: Sequence[int], sighted: Array, covariances: Array) -> list[int]:
        """Takes the sightings of one moment: identities (-1 for unknown), positions (N, 2) and covariances (N, 2, 2) in
        the robot's frame. Returns, for each, the index of its landmark, or -1 where it was ignored.
        """
        self._step, self._slip = np.zeros((_FIRST + 2 * len(self.ids), 3)), 1.0
        self._settle()
        self._moments += 1
        self._density.update(sighted)
        R = _rotation(self.heading)
        offsets, noises = sighted @ R.T, R @ covariances @ R.T
        found = [self._index.get(identity, _NEW) if identity >= 0 else _IGNORED for identity in identities]
        unknown = [k for k, identity in enumerate(identities) if identity < 0]
        if unknown:
            for k, landmark in zip(unknown, self._associate(offsets[unknown], noises[unknown]), strict=True):
                found[k] = landmark
        known = [k for k, landmark in enumerate(found) if landmark >= 0]
        if known:
            self._measure([found[k] for k in known], offsets[known], noises[known])
            self._update([found[k] for k in known], offsets[known], noises[known])
        R = _rotation(self.heading)
        for k, landmark in enumerate(found):
            if landmark == _NEW:
                found[k] = self._add(int(identities[k]), R @ sighted[k], R @ covariances[k] @ R.T)
        seen = np.array([landmark for landmark in found if landmark >= 0], int)
        self._together[np.ix_(seen, seen)] = True
        self._seen[seen] = self._moments
        self._times[seen] += 1
        if unknown:
            found = self._confirmed(self._united(found))
            self._seek(found)
        return found

    def _seek(self, found: Sequence[int]) -> None:
        """Takes the robot for lost where landmarks are not at their places, and for found among those known before."""
        if self.lost_among is not None:
            if sum(0 <= landmark < self.lost_among for landmark in found) >= _CONSTELLATION:
                self.lost_among = None
        elif self.consistency.lost:
            self.lost_among = len(self.ids)
            self.consistency.strayed = 0
            self.jump(np.diag(np.square(_ASTRAY)))

    def _relative(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
        """Covariances (N, 2, 2) of xi of one point less that of another, given by their first rows in the state."""
        P, a, b = self._P, np.stack([rows, rows + 1], -1), np.stack([columns, columns + 1], -1)
        across = P[a[:, :, None], b[:, None, :]]
        own = P[a[:, :, None], a[:, None, :]] + P[b[:, :, None], b[:, None, :]]
        return np.asarray(own - across - across.transpose(0, 2, 1))

    def _associate(self, offsets: Array, noise: Array) -> list[int]:
        """Landmark of each sighting, each landmark once; `_IGNORED` for an ambiguous one, `_NEW` for a new landmark.

        Where most fit no landmark alone, a wider gate holds for several that fit together: the odometry errs in all of
        them alike. Where landmarks are still not at their places, it may have slipped by much more.
        """
        if not self.ids:
            return [_NEW] * len(offsets)
        size = _FIRST + 2 * len(self.ids)
        result, strayed = self._matches(offsets, noise, self.association.gate)
        matched = sum(landmark >= 0 for landmark in result)
        if sum(landmark == _IGNORED for landmark in result) > max(1, matched):
            again, left = self._matches(offsets, noise, self.association.new)
            if (fitting := sum(landmark >= 0 for landmark in again)) > max(1, matched):
                result, strayed, matched = again, left, fitting
        if strayed > _STRAYED * (strayed + matched):
            told = self._P[:size, :size].copy()
            self._P[:size, :size] += (_SLIP - 1) * (self._step @ self._step.T)
            found = self._constellation(offsets, noise)
            if len(found) > max(_CONSTELLATION - 1, matched):
                result, strayed = [found.get(k, _IGNORED) for k in range(len(offsets))], 0
                self._slip = _SLIP
            else:
                self._P[:size, :size] = told
        self.consistency.look(sum(landmark >= 0 for landmark in result), strayed)
        if self.consistency.strayed:  # what is seen is not of here
            result = [_IGNORED] * len(offsets)
        self.counts.ambiguous += sum(landmark == _IGNORED for landmark in result)
        return result

    def _constellation(self, offsets: Array, noise: Array) -> dict[int, int]:
        """Landmark of each sighting of a constellation that leaves no doubt."""
        count = len(self.ids)
        spread = self._relative(_FIRST + 2 * np.arange(count), np.ones(count, int))
        r = offsets[:, None] - (self._landmarks[:count] - self.position)[None]
        distances = np.einsum("nki,nki->nk", r, np.linalg.solve(spread[None] + noise[:, None], r[..., None])[..., 0])
        rows, columns = np.nonzero(distances <= quantile(_ALIKE, 2))
        chosen = np.sort(np.argsort(distances[rows, columns], kind="stable")[:_PAIRS])
        rows, columns = rows[chosen], columns[chosen]
        if not len(rows):
            return {}
        same = (rows[:, None] == rows) | (columns[:, None] == columns)
        residuals, _, S = self._innovation(columns.tolist(), offsets[rows], noise[rows])
        pairs = agreed_pairs(residuals.reshape(-1, 2), S, same, self._density.per_square_metre)
        return {int(rows[k]): int(columns[k]) for k in pairs}

    def _matches(self, offsets: Array, noise: Array, share: float) -> tuple[list[int], int]:
        """Landmark of each sighting as `_associate`, and how many landmarks are not seen where others are.

        Only landmarks that are followed, or known well relative to the robot, are matched: others wait (see
        `_united`). Those that do not fit together with the others are ignored.
        `share`: of true pairs, and of true joint ones, that fit.
        """
        count = len(self.ids)
        spread = self._relative(_FIRST + 2 * np.arange(count), np.ones(count, int))
        S = spread[None] + noise[:, None]
        there = self._landmarks[:count] - self.position
        r = offsets[:, None] - there[None]
        distances = np.einsum("nki,nki->nk", r, np.linalg.solve(S, r[..., None])[..., 0])
        followed = self._seen[:count] > self._moments - _FOLLOWED
        sure = tight(spread, noise, self._density.per_square_metre, followed)
        chosen = nearest(distances, S, sure, float(quantile(share, 2)))
        pairs = list(chosen.items())
        if pairs:
            seen, landmarks = [k for k, _ in pairs], [landmark for _, landmark in pairs]
            joint, _, covariance = self._innovation(landmarks, offsets[seen], noise[seen])
            kept = jointly_compatible(joint.reshape(-1, 2), covariance, share)
            chosen = {pairs[k][0]: pairs[k][1] for k in kept}
        lone = np.where(sure, distances, np.inf).min(axis=1) > self.association.new_distance
        result = [chosen.get(k, _NEW if lone[k] else _IGNORED) for k in range(len(offsets))]
        missing = np.flatnonzero(sure.all(axis=0) & ~np.isin(np.arange(count), list(chosen.values())))
        missed = int(_within(offsets, there[missing]).sum()) if len(missing) else 0
        return result, min(len(offsets) - len(chosen), missed)

    def _measure(self, landmarks: Sequence[int], offsets: Array, noises: Array) -> None:
        """Takes the joint innovation of sightings, as it was expected before any slip, into the consistency."""
        r, _, S = self._innovation(landmarks, offsets, noises)
        HG = np.tile(self._step[1:3], (len(landmarks), 1)) - self._step[self._columns(landmarks)]
        S = S - (self._slip - 1) * (HG @ HG.T)
        weighted = np.linalg.solve(S, np.column_stack([r, HG]))
        motion = float(np.einsum("ij,ij->", HG, weighted[:, 1:]))
        self.consistency.update(float(r @ weighted[:, 0]), len(r), motion)

    @staticmethod
    def _columns(landmarks: Sequence[int] | NDArray[np.intp]) -> NDArray[np.intp]:
        at = _FIRST + 2 * np.asarray(landmarks, int)
        return np.stack([at, at + 1], -1).ravel()

    def _innovation(self, landmarks: Sequence[int], offsets: Array, noise: Array) -> tuple[Array, Array, Array]:
        """Residuals (2N,) of sightings of landmarks, offsets (N, 2) in the map frame, the state's covariance with them,
        and theirs (2N, 2N).
        """
        size = _FIRST + 2 * len(self.ids)
        columns = self._columns(landmarks)
        P = self._P[:size, :size]
        PHt = np.tile(P[:, 1:3], len(landmarks)) - P[:, columns]
        S = np.tile(PHt[1:3], (len(landmarks), 1)) - PHt[columns]
        for k, block in enumerate(noise):
            S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += block
        return (offsets - (self._landmarks[landmarks] - self.position)).ravel(), PHt, (S + S.T) / 2

    def _update(self, landmarks: Sequence[int], offsets: Array, noise: Array) -> None:
        """Corrects everything by sightings of landmarks, their offsets (N, 2) in the map frame."""
        self._take(*self._innovation(landmarks, offsets, noise))
        self.counts.matched += len(landmarks)

    def _take(self, r: Array, PHt: Array, S: Array) -> None:
        """Corrects everything by an innovation, its covariance with the state, and its own."""
        size = _FIRST + 2 * len(self.ids)
        root = np.linalg.cholesky(S)
        G = solve_triangular(root, PHt.T, lower=True)
        self._correct(-(G.T @ solve_triangular(root, r, lower=True)))
        self._P[:size, :size] -= G.T @ G

    # Landmarks that are one

    def _united(self, found: list[int]) -> list[int]:
        """Unites landmarks seen lately with earlier ones, where a constellation of them leaves no doubt; returns the
        indices of sightings as they are then.
        """
        newer, older, P, residuals = self._alike()
        if not len(newer):
            return found
        same = (
            (newer[:, None] == newer)
            | (older[:, None] == older)
            | (newer[:, None] == older)
            | (older[:, None] == newer)
        )
        pairs = agreed_pairs(residuals, P, same, self._density.per_square_metre)
        if not pairs:
            return found
        a, b = self._columns(newer[pairs]), self._columns(older[pairs])
        size = _FIRST + 2 * len(self.ids)
        PHt = self._P[:size, a] - self._P[:size, b]
        S = PHt[a] - PHt[b]
        self._take(residuals[pairs].ravel(), PHt, (S + S.T) / 2 + _EQUAL**2 * np.eye(len(a)))
        now = np.arange(len(self.ids))
        for i, j in zip(newer[pairs], older[pairs], strict=True):
            now[i] = j
            self._together[j] |= self._together[i]
            self._together[:, j] |= self._together[:, i]
            self._seen[j] = self._moments
            self._times[j] += self._times[i]
        self.counts.merged += len(pairs)
        place = self._keep(np.setdiff1d(np.arange(len(now)), newer[pairs]))
        return [int(place[now[k]]) if k >= 0 else k for k in found]

    def _confirmed(self, found: list[int]) -> list[int]:
        """Drops landmarks without identity that were seen once or twice and not again; returns the indices then."""
        count = len(self.ids)
        gone = self._anonymous[:count] & (self._times[:count] < _TIMES)
        gone &= self._seen[:count] <= self._moments - _PROVISIONAL
        if not gone.any():
            return found
        self.counts.dropped += int(gone.sum())
        place = self._keep(np.flatnonzero(~gone))
        return [int(place[k]) if k >= 0 else k for k in found]

    def _alike(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """Pairs of a landmark seen lately and an earlier one that may be one: both indices (N,), the covariance
        (2N, 2N) of their differences, and these (N, 2).
        """
        count = len(self.ids)
        lately = np.flatnonzero(self._anonymous[:count] & (self._seen[:count] > self._moments - _LATELY))
        i, j = np.meshgrid(lately, np.arange(count), indexing="ij")
        may = (j < i) & ~self._together[i, j]
        i, j = i[may], j[may]
        apart = self._landmarks[i] - self._landmarks[j]
        spread = self._relative(_FIRST + 2 * i, _FIRST + 2 * j) + _EQUAL**2 * np.eye(2)
        distances = np.einsum("ni,ni->n", apart, np.linalg.solve(spread, apart[..., None])[..., 0])
        chosen = np.flatnonzero(distances <= quantile(_ALIKE, 2))
        chosen = np.sort(chosen[np.argsort(distances[chosen], kind="stable")[:_PAIRS]])
        i, j = i[chosen], j[chosen]
        a, b = self._columns(i), self._columns(j)
        P = self._P
        joint = P[np.ix_(a, a)] + P[np.ix_(b, b)] - P[np.ix_(a, b)] - P[np.ix_(b, a)]
        return i, j, joint + _EQUAL**2 * np.eye(len(a)), apart[chosen]

    def _keep(self, kept: NDArray[np.intp]) -> NDArray[np.intp]:
        """Keeps some landmarks, and leaves out the others; returns the new index of each, -1 where it is left out."""
        place = np.full(len(self.ids), -1)
        place[kept] = np.arange(len(kept))
        rows = np.concatenate([np.arange(_FIRST), self._columns(kept)])
        count, before = len(kept), len(self.ids)
        self._P[: len(rows), : len(rows)] = self._P[np.ix_(rows, rows)]
        self._together[:count, :count] = self._together[np.ix_(kept, kept)]
        self._together[count:before, :before] = self._together[:before, count:before] = False
        for values in (self._landmarks, self._anonymous, self._seen, self._times):
            values[:count], values[count:before] = values[kept], 0
        if self.lost_among is not None:
            self.lost_among = int((kept < self.lost_among).sum())
        self.ids = [self.ids[k] for k in kept]
        self._index = {identity: k for k, identity in enumerate(self.ids)}
        return place

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
            held = (self._landmarks, self._P, self._together, self._anonymous, self._seen, self._times)
            self._hold(max(_GROW, 2 * index))
            self._landmarks[:index], self._P[:size, :size], self._together[:index, :index] = held[:3]
            self._anonymous[:index], self._seen[:index], self._times[:index] = held[3:]
        self._landmarks[index] = self.position + offset
        self._P[size : size + 2, :size] = self._P[1:3, :size]
        self._P[:size, size : size + 2] = self._P[:size, 1:3]
        self._P[size : size + 2, size : size + 2] = self._P[1:3, 1:3] + noise
        number = identity if identity >= 0 else max(self.ids, default=-1) + 1
        self._index[number] = index
        self._anonymous[index] = identity < 0
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
    return float((angle + math.pi) % (2 * math.pi) - math.pi)


def _within(seen: Array, points: Array) -> NDArray[np.bool_]:
    """Returns which points (N, 2) lie among what a robot sees (M, 2): no farther away, and between its bearings."""
    middle = seen.mean(axis=0)
    forward = middle / max(float(np.linalg.norm(middle)), 1e-9)
    turned = np.array([[forward[0], forward[1]], [-forward[1], forward[0]]])
    bearings = np.arctan2(*(seen @ turned.T).T[::-1])
    there = np.arctan2(*(points @ turned.T).T[::-1])
    near = np.linalg.norm(points, axis=1) < np.linalg.norm(seen, axis=1).max()
    return np.asarray(near & (there > bearings.min()) & (there < bearings.max()))
