"""A place that was found again, on trial: what follows may contradict it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.odometry.tracking import moved_covariance

SECONDS = 10.0  # that a trial lasts
CONTRADICTIONS = 5  # views, one after the other, of which most lies elsewhere than the map has it
MOST = 4  # places on trial at a time
SAME = 0.3  # metres and radians, by which a find does not move a camera whose place is on trial already


@dataclass(frozen=True, eq=False)
class Trial:
    """Holds how to take back a place: keyframes from the stamp `since` on rest on it, and `T_back` (4, 4) moves their
    poses in the world to where they were believed before.

    `covariance` (6, 6) is that of the first such pose as it was believed before, `T_before` (4, 4).
    """

    since: int
    found: int  # stamp
    T_back: Matrix
    T_before: Matrix
    covariance: Matrix
    against: int = 0  # views that contradict so far

    @staticmethod
    def of(since: int, found: int, T_before: Matrix, covariance: Matrix, T_found: Matrix) -> Trial:
        """Returns the trial of a pose found at a stamp, in place of one with a covariance (6, 6)."""
        return Trial(since, found, np.asarray(T_before @ invert(T_found), np.float64), T_before, covariance)

    def over(self, stamp: int) -> bool:
        """Returns whether the trial has lasted long enough."""
        return stamp - self.found > SECONDS * 1e9

    def heard(self, contradicts: bool) -> Trial:
        """Returns the trial after another view."""
        return replace(self, against=self.against + 1 if contradicts else 0)

    @property
    def failed(self) -> bool:
        """Returns whether the place is to be taken back."""
        return self.against >= CONTRADICTIONS

    def taken_back(self, T_world_camera: Matrix) -> tuple[Matrix, Matrix]:
        """Returns a pose that rests on the place, and its covariance (6, 6), as they would be without it."""
        T = np.asarray(self.T_back @ T_world_camera, np.float64)
        return T, moved_covariance(self.covariance, self.T_before, T)


def with_trial(trials: Sequence[Trial], fresh: Trial) -> tuple[Trial, ...]:
    """Adds a trial to those that run, in the order of finds, unless it moves nothing; the last of `MOST` makes room."""
    apart = se3.log(invert(fresh.T_before) @ fresh.T_back @ fresh.T_before)
    still = np.linalg.norm(apart[:3]) < SAME and np.linalg.norm(apart[3:]) < SAME
    return tuple(trials) if trials and still else (*trials[: MOST - 1], fresh)


def taken_back(
    trials: Sequence[Trial], stamp: int, T_world_camera: Matrix, covariance: Matrix
) -> tuple[Matrix, Matrix]:
    """Returns a pose of a stamp and its covariance (6, 6) without any place that it rests on, the last find first."""
    for trial in reversed(trials):
        if stamp >= trial.since:
            T_world_camera, covariance = trial.taken_back(T_world_camera)
    return T_world_camera, covariance
