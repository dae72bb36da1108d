"""The way along which a map was seen, and how corrections of it move what was seen from there."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Path
from dataflow.messages.geometry import invert, quaternion_to_matrix
from dataflow.operator import Remembered
from operators.geometry import se3

Matrix = NDArray[np.float64]
_SPAN = 250_000_000  # nanoseconds in which what is seen moves together
_STEP, _TURN = 0.02, 0.01  # metres and radians of the way from one pose that is kept to the next
_POSES = 4096  # poses that are kept at most


@dataclass(frozen=True, eq=False)
class Correction:
    """By what `motions` (K, 4, 4) places at rising `stamps` (K) were moved, in the frame of the map."""

    stamps: list[int]
    motions: Matrix

    def at(self, stamp: int) -> Matrix:
        """Returns the motion (4, 4) at a time: between two places on the way from the one to the other."""
        k = bisect_right(self.stamps, stamp)
        if k in (0, len(self.stamps)):
            return np.asarray(self.motions[min(k, len(self.stamps) - 1)])
        before, after = self.stamps[k - 1], self.stamps[k]
        share = (stamp - before) / (after - before)
        return se3.interpolated(self.motions[k - 1], self.motions[k], share)

    def moved(self, points: Matrix, times: NDArray[np.float64]) -> Matrix:
        """Returns points (N, 3) that were seen at times (N,), each moved as the place from which it was seen."""
        part = np.floor(times / _SPAN)
        out = points.copy()
        for each in np.unique(part).tolist():
            own = part == each
            T = self.at(int(times[own].mean()))
            out[own] = points[own] @ T[:3, :3].T + T[:3, 3]
        return out


class Trajectory(Remembered):
    """The poses (4, 4) from which a map was seen, by time.

    Poses are kept along the way, and of the part of it that was corrected the keyframes. Where there are too many,
    every other one goes.
    """

    stamps: list[int]
    poses: list[Matrix]

    def __init__(self) -> None:
        self.stamps, self.poses = [], []

    def add(self, stamp: int, T: Matrix) -> None:
        """Takes the pose of a view."""
        if self.poses and _near(self.poses[-1], T):
            return
        self.stamps.append(stamp)
        self.poses.append(T)
        if len(self.poses) > _POSES:
            self.stamps, self.poses = self.stamps[::2], self.poses[::2]

    def corrected(self, keyframes: Path) -> Correction | None:
        """Moves the poses to where keyframes have them now, and returns by what; None where no keyframe is among them.

        Raises ValueError for keyframes without stamps or orientations.
        """
        if keyframes.stamps is None or keyframes.orientations is None:
            lacks = "stamps" if keyframes.stamps is None else "orientations"
            raise ValueError(f"the keyframes have no {lacks}: a map moves with keyframes of which both are known")
        stamps, moved, motions = [], [], []
        for k, stamp in enumerate(keyframes.stamps.tolist()):
            if not self.stamps or not self.stamps[0] <= stamp <= self.stamps[-1]:
                continue
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = quaternion_to_matrix(keyframes.orientations[k]), keyframes.positions[k]
            stamps.append(stamp)
            moved.append(T)
            motions.append(se3.orthonormalised(T @ invert(self._at(stamp))))
        if not stamps:
            return None
        correction = Correction(stamps, np.stack(motions))
        later = [(s, correction.at(s) @ T) for s, T in zip(self.stamps, self.poses, strict=True) if s > stamps[-1]]
        self.stamps = [*stamps, *(s for s, _ in later)]
        self.poses = [*moved, *(T for _, T in later)]
        return correction

    def _at(self, stamp: int) -> Matrix:
        k = bisect_right(self.stamps, stamp)
        if k == len(self.stamps):
            return self.poses[-1]
        before, after = self.stamps[k - 1], self.stamps[k]
        return se3.interpolated(self.poses[k - 1], self.poses[k], (stamp - before) / (after - before))


def _near(first: Matrix, second: Matrix) -> bool:
    """Returns whether a pose is hardly different from another."""
    moved = float(np.linalg.norm(first[:3, 3] - second[:3, 3]))
    cosine = (float(np.trace(first[:3, :3].T @ second[:3, :3])) - 1) / 2
    return moved < _STEP and cosine > np.cos(_TURN)
