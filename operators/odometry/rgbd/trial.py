"""A place that was found again, on trial: what follows may contradict it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry.se3 import Matrix
from operators.odometry.tracking import moved_covariance

SECONDS = 10.0  # that a trial lasts
CONTRADICTIONS = 5  # views, one after the other, of which most lies elsewhere than the map has it


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
