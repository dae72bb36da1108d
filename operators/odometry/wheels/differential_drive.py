"""Dead reckoning of a differential drive: pose and covariance in the plane from what two wheels roll."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered

Array = NDArray[np.float64]

_POSE = slice(0, 3)


@dataclass(frozen=True)
class DriveNoise:
    """Errors of a differential drive, standard deviations."""

    slip: float = 0.006  # metres of one wheel after 1 m of its way; grows with the root of the way
    scale: float = 0.01  # share by which one wheel's radius is off, for ever
    track: float = 0.01  # share by which the distance of the wheels is off, for ever


class DifferentialDrive(Remembered):
    """Integrates arcs: both wheels roll at constant speeds between two readings, which is exact for such motion.

    Slip is fresh at every step. Radii and track are off by the same share for ever, so these errors are states beside
    the pose: what they do adds up along the way instead of averaging out (Borenstein and Feng, "Measurement and
    correction of systematic odometry errors in mobile robots", 1996). Poses are x, y (metres) and yaw (radians).
    """

    pose: Array
    step: float  # metres of way between two counts of an encoder
    _spread: Array  # of the pose and of the shares by which left radius, right radius and track are off

    def __init__(self, track: float, noise: DriveNoise) -> None:
        self._track, self._noise = track, noise
        self.pose, self.step = np.zeros(3), 0.0
        self._spread = np.diag([0.0, 0.0, 0.0, noise.scale**2, noise.scale**2, noise.track**2])

    def roll(self, left: float, right: float, doubt: float = 0.0) -> None:
        """Moves by what the wheels rolled, metres; `doubt` is a further standard deviation of each."""
        forward, turn = (left + right) / 2, (right - left) / self._track
        half = turn / 2
        chord, slope = _chord(half)
        middle = self.pose[2] + half
        c, s = math.cos(middle), math.sin(middle)
        # of (x, y, yaw) by (forward, turn), then of those by (left, right)
        by_arc = np.array(
            [
                [chord * c, forward * (slope * c - chord * s) / 2],
                [chord * s, forward * (slope * s + chord * c) / 2],
                [0.0, 1.0],
            ]
        )
        by_wheels = by_arc @ np.array([[0.5, 0.5], [-1 / self._track, 1 / self._track]])
        F = np.eye(6)
        F[:2, 2] = -forward * chord * s, forward * chord * c
        F[_POSE, 3:5] = by_wheels * [left, right]
        F[_POSE, 5] = -by_arc[:, 1] * turn
        fresh = self._noise.slip**2 * np.abs([left, right]) + doubt**2
        self._spread = F @ self._spread @ F.T
        self._spread[_POSE, _POSE] += (by_wheels * fresh) @ by_wheels.T
        self.pose = self.pose + np.array([forward * chord * c, forward * chord * s, turn])

    def wander(self, distance: float) -> None:
        """Widens the position by a standard deviation that a way of unknown shape leaves, metres."""
        self._spread[0, 0] += distance**2
        self._spread[1, 1] += distance**2

    def covariance(self) -> Array:
        """Returns that of the pose (3, 3), with the rest of a count that each wheel may have turned since."""
        rest = self.step**2 / 12
        out = self._spread[_POSE, _POSE].copy()
        out[np.diag_indices(3)] += [rest, rest, 2 * rest / self._track**2]
        return out

    def twist_covariance(self, left: float, right: float, seconds: float, doubt: float = 0.0) -> Array:
        """Returns that of forward speed and turn rate (2, 2) over a step in which the wheels rolled so far, metres."""
        n = self._noise
        rolled = np.abs([left, right])
        variance = n.slip**2 * rolled + (n.scale * rolled) ** 2 + self.step**2 / 6 + doubt**2
        by_wheels = np.array([[0.5, 0.5], [-1 / self._track, 1 / self._track]]) / seconds
        out = (by_wheels * variance) @ by_wheels.T
        out[1, 1] += (n.track * (right - left) / self._track / seconds) ** 2
        return np.asarray(out)


def _chord(half: float) -> tuple[float, float]:
    """Returns sin(h) / h, by which a chord is shorter than its arc of angle 2 h, and its derivative."""
    if abs(half) < 1e-4:
        return 1 - half**2 / 6, -half / 3
    chord = math.sin(half) / half
    return chord, (math.cos(half) - chord) / half
