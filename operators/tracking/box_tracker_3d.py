"""Tracking of boxes in space: centre, velocity, extent and heading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import TrackState
from dataflow.operator import Remembered
from operators.tracking.assignment import assign, log_odds
from operators.tracking.box_filter import kalman

Array = NDArray[np.float64]
_GATE = 11.34  # 99 % of chi-square with 3 degrees of freedom
_MOST = 4.0


@dataclass(frozen=True)
class BoxTracker3DSettings:
    """Noise in metres, m/s² and radians; times in seconds; evidence in log odds as for image boxes."""

    position: float = 0.08
    acceleration: float = 1.5
    first_speed: float = 1.0
    reach: float = 1.0
    strong: float = 0.5
    birth: float = 0.5
    confirm: float = 0.8
    fade: float = 4.0
    memory: float = 2.0


@dataclass
class SolidTrack:
    """One object in space: (position, velocity) (6,) with covariance (6, 6), full extents (3,), heading."""

    id: int
    mean: Array
    covariance: Array
    size: Array
    size_weight: float
    yaw: float
    class_id: int
    evidence: float
    born: int
    seen: int
    state: TrackState

    @property
    def score(self) -> float:
        """Probability that the object is there, from its evidence."""
        return 1 / (1 + math.exp(-self.evidence))


@dataclass(frozen=True)
class Solids:
    """Boxes in one frame: centres (N, 3), full extents (N, 3), headings (N,), scores (N,), classes (N,).

    `covariances` (N, 3, 3) of the centres, None where they are not known.
    """

    centers: Array
    sizes: Array
    yaws: Array
    scores: Array
    class_ids: NDArray[np.int32]
    covariances: Array | None = None


class BoxTracker3D(Remembered):
    """Follows upright boxes at constant velocity: Kalman filter on the centre, weighted means of extent and heading.

    Strong boxes are matched first, weak ones continue what is left, both by Mahalanobis distance of centres within a
    gate and a reach, within their class. A heading is only known up to half a turn: an object that moves faces the way
    it moves. After Weng et al., "3D multi-object tracking: a baseline and new evaluation metrics", 2020.
    """

    tracks: list[SolidTrack]
    _next: int
    _stamp: int | None

    def __init__(self, settings: BoxTracker3DSettings) -> None:
        self._settings = settings
        self.tracks, self._next, self._stamp = [], 1, None

    def update(self, stamp: int, found: Solids) -> list[SolidTrack]:
        """Takes the boxes of one time; returns the tracks, with those that end now, by rising id."""
        s = self._settings
        seconds = 0.0 if self._stamp is None else (stamp - self._stamp) * 1e-9
        self._stamp = stamp
        for track in self.tracks:
            self._predict(track, seconds)
        strong = [k for k in range(len(found.centers)) if found.scores[k] >= s.strong]
        weak = [k for k in range(len(found.centers)) if found.scores[k] < s.strong]
        taken = self._matches(list(range(len(self.tracks))), strong, found)
        left = [i for i, t in enumerate(self.tracks) if i not in taken and t.state != TrackState.TENTATIVE]
        taken |= self._matches(left, weak, found)
        for i, k in taken.items():
            self._see(self.tracks[i], stamp, found, k)
        for i, track in enumerate(self.tracks):
            if i not in taken:
                self._miss(track, stamp, seconds)
        matched = set(taken.values())
        for k in strong:
            if k not in matched and found.scores[k] >= s.birth:
                self._begin(stamp, found, k)
        result = list(self.tracks)
        self.tracks = [t for t in result if t.state != TrackState.ENDED]
        return result

    def forget(self) -> None:
        """Drops all tracks; their ids are not used again."""
        self.tracks, self._stamp = [], None

    def _predict(self, track: SolidTrack, seconds: float) -> None:
        F = np.eye(6)
        F[:3, 3:] = seconds * np.eye(3)
        G = np.concatenate([np.eye(3) * seconds**2 / 2, np.eye(3) * seconds])
        Q = self._settings.acceleration**2 * (G @ G.T)
        track.mean, track.covariance = kalman().predict(track.mean, track.covariance, F, Q)

    def _noise(self, found: Solids, k: int) -> Array:
        floor = np.eye(3) * (self._settings.position * (2 - found.scores[k])) ** 2
        return np.asarray(floor if found.covariances is None else floor + found.covariances[k])

    def _matches(self, rows: list[int], columns: list[int], found: Solids) -> dict[int, int]:
        if not rows or not columns:
            return {}
        value, allowed = np.zeros((len(rows), len(columns))), np.zeros((len(rows), len(columns)), np.bool_)
        for a, i in enumerate(rows):
            track = self.tracks[i]
            for b, k in enumerate(columns):
                offset = found.centers[k] - track.mean[:3]
                if found.class_ids[k] != track.class_id or float(np.linalg.norm(offset)) > self._settings.reach:
                    continue
                S = track.covariance[:3, :3] + self._noise(found, k)
                distance = float(offset @ np.linalg.solve(S, offset))
                value[a, b], allowed[a, b] = 1 - distance / _GATE, distance <= _GATE
        return {rows[a]: columns[b] for a, b in assign(value, allowed)}

    def _see(self, track: SolidTrack, stamp: int, found: Solids, k: int) -> None:
        seen = kalman().update(track.mean, track.covariance, found.centers[k], self._noise(found, k), np.eye(3, 6))
        track.mean, track.covariance = seen
        score = float(found.scores[k])
        share = score / (track.size_weight + score)
        track.yaw = self._heading(track, float(found.yaws[k]), share)
        track.size = track.size + share * (found.sizes[k] - track.size)
        track.size_weight = min(track.size_weight + score, 10.0)
        track.evidence = min(max(track.evidence, 0.0) + log_odds(score), _MOST)
        track.seen = stamp
        if track.state != TrackState.TENTATIVE or track.evidence >= self._settings.confirm:
            track.state = TrackState.CONFIRMED

    def _heading(self, track: SolidTrack, yaw: float, share: float) -> float:
        """Moves the heading towards a measured axis, then to the half turn in which the object moves."""
        turn = (yaw - track.yaw + math.pi / 2) % math.pi - math.pi / 2
        yaw = track.yaw + max(share, 0.2) * turn
        vx, vy = track.mean[3:5]
        deviation = math.sqrt(max(float(np.trace(track.covariance[3:5, 3:5])), 0.0))
        if math.hypot(vx, vy) > max(0.3, 2 * deviation) and math.cos(yaw - math.atan2(vy, vx)) < -0.5:
            yaw += math.pi
        return math.remainder(yaw, 2 * math.pi)

    def _miss(self, track: SolidTrack, stamp: int, seconds: float) -> None:
        track.evidence -= self._settings.fade * seconds
        if track.state == TrackState.TENTATIVE:
            ended = track.evidence < -1
        else:
            track.state = TrackState.COASTING
            ended = (stamp - track.seen) * 1e-9 > self._settings.memory
        if ended:
            track.state = TrackState.ENDED

    def _begin(self, stamp: int, found: Solids, k: int) -> None:
        score = float(found.scores[k])
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = self._noise(found, k)
        covariance[3:, 3:] = np.eye(3) * self._settings.first_speed**2
        evidence = log_odds(score)
        self.tracks.append(
            SolidTrack(
                id=self._next,
                mean=np.concatenate([found.centers[k], np.zeros(3)]),
                covariance=covariance,
                size=found.sizes[k].copy(),
                size_weight=score,
                yaw=float(found.yaws[k]),
                class_id=int(found.class_ids[k]),
                evidence=evidence,
                born=stamp,
                seen=stamp,
                state=TrackState.CONFIRMED if evidence >= self._settings.confirm else TrackState.TENTATIVE,
            )
        )
        self._next += 1
