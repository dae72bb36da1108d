"""Poses and the points that they see: sightings, and normal equations without the points by the Schur complement.

Triggs et al., "Bundle adjustment, a modern synthesis", 2000.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Sightings:
    """Holds observations: frames (S,) and points (S,) by index, and where they are seen (S, R), in pixels."""

    frames: Indices
    points: Indices
    pixels: Array

    @staticmethod
    def none(size: int) -> Sightings:
        """Returns none, at pixels (0, size)."""
        return Sightings(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, size)))

    def also(self, frame: int, points: Indices, pixels: Array) -> Sightings:
        """Adds what one frame sees: points (N,) at pixels (N, R)."""
        return Sightings(
            np.concatenate([self.frames, np.full(len(points), frame)]),
            np.concatenate([self.points, points]),
            np.concatenate([self.pixels, pixels]),
        )

    def of_points(self, kept: Indices) -> Sightings:
        """Returns the sightings of the points kept, numbered anew."""
        number = np.full(max(int(self.points.max(initial=-1)), int(kept.max(initial=-1))) + 1, -1, np.int64)
        number[kept] = np.arange(len(kept))
        there = number[self.points] >= 0
        return Sightings(self.frames[there], number[self.points[there]], self.pixels[there])

    def without_first(self) -> Sightings:
        """Returns the sightings of all frames but the first."""
        later = self.frames > 0
        return Sightings(self.frames[later] - 1, self.points[later], self.pixels[later])

    def in_cameras(self, poses: Array, points: Array) -> tuple[Array, Array]:
        """Returns what is seen of points (M, 3), each in its camera (S, 3), and R_camera_world (S, 3, 3)."""
        inverse = invert(poses)
        R = inverse[self.frames, :3, :3]
        return np.einsum("sij,sj->si", R, points[self.points]) + inverse[self.frames, :3, 3], R


def pose_jacobian(J: Array, points: Array) -> Array:
    """Returns derivatives (S, R, 6) of residuals by the right perturbation of a camera's pose T_world_camera.

    `J` (S, R, 3) are those by the points (S, 3) in the camera's frame, whose own derivative is [-I, [p]x].
    """
    by_pose = np.empty((*J.shape[:2], 6))
    by_pose[:, :, :3] = -J
    by_pose[:, :, 3:] = np.cross(J, points[:, None, :])
    return by_pose


class PosesAndPoints:
    """Least squares over P poses, M points and C unknowns that all residuals share, linearised at an estimate.

    Each of S sightings has residuals (S, R) with weights (S, R) or (S, 1), and derivatives by its pose (S, R, 6), by
    its point (S, R, 3) and by what all share (S, R, C), such as a calibration. `poses` (S,) and `points` (S,) are
    indices, no pair of them twice; a pose below 0 is held fixed. `H` (P, 6, 6) is the information on each pose, all
    else given.
    """

    def __init__(
        self, poses: Indices, points: Indices, sizes: tuple[int, int], by_pose: Array, by_point: Array,
        residuals: Array, weights: Array, shared: Array | None = None,
    ) -> None:  # fmt: skip
        count, size = sizes
        free = np.flatnonzero(poses >= 0)
        of_pose, of_point = _Sums(poses[free], count), _Sums(points, size)
        by_pose, own, weighted = by_pose[free], weights[free, :, None] * by_pose[free], weights[:, :, None] * by_point
        self.H = of_pose(own.transpose(0, 2, 1) @ by_pose)
        self._b = of_pose(np.einsum("sij,si->sj", own, residuals[free]))
        self._V = of_point(weighted.transpose(0, 2, 1) @ by_point)
        self._c = of_point(np.einsum("sij,si->sj", weighted, residuals))
        self._between = poses[free], points[free], own, by_point[free]
        extra = 0 if shared is None else shared.shape[2]
        self._by_pose, self._by_point = np.zeros((count, 6, extra)), np.zeros((size, 3, extra))
        self._own, self._pull = np.zeros((extra, extra)), np.zeros(extra)
        if shared is not None:
            self._by_pose = of_pose(own.transpose(0, 2, 1) @ shared[free])
            self._by_point = of_point(weighted.transpose(0, 2, 1) @ shared)
            weighted = weights[:, :, None] * shared
            self._own = np.einsum("sij,sik->jk", weighted, shared)
            self._pull = np.einsum("sij,si->j", weighted, residuals)

    def damp_poses(self, share: float, least: float) -> None:
        """Adds a share of the diagonal and a constant to the diagonal of each pose's information."""
        self.H += _diagonal(self.H, share, least)

    def damp_points(self, share: float, least: float) -> None:
        """Adds a share of the diagonal and a constant to the diagonal of each point's information."""
        self._V += _diagonal(self._V, share, least)

    def reduced(self) -> tuple[Array, Array]:
        """Returns matrix (6P + C, 6P + C) and gradient (6P + C,) of the poses and what all share, points eliminated."""
        count, size, extra = len(self.H), len(self._V), len(self._own)
        poses, rows = 6 * count, 6 * count + extra
        of_pose, of_point, own, by_point = self._between
        E = np.zeros((rows, size, 3))
        E[:poses].reshape(count, 6, size, 3)[of_pose, :, of_point] = own.transpose(0, 2, 1) @ by_point
        E[poses:] = self._by_point.transpose(2, 0, 1)
        self._inverse, self._E = np.linalg.inv(self._V), E.reshape(rows, 3 * size)
        B = np.einsum("amj,mjk->amk", E, self._inverse).reshape(rows, 3 * size)
        S = np.zeros((rows, rows))
        for i, H in enumerate(self.H):
            S[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = H
        S[:poses, poses:] = self._by_pose.reshape(poses, extra)
        S[poses:, :poses], S[poses:, poses:] = S[:poses, poses:].T, self._own
        return S - B @ self._E.T, np.concatenate([self._b.ravel(), self._pull]) - B @ self._c.ravel()

    def points_step(self, step: Array) -> Array:
        """Returns the points' step (M, 3) that goes with a step (6P + C,) of the rest; after `reduced`."""
        pull = self._c + (step @ self._E).reshape(self._c.shape)
        return np.asarray(-np.einsum("mij,mj->mi", self._inverse, pull))


class _Sums:
    """Sums of rows by an index of each."""

    def __init__(self, index: Indices, count: int) -> None:
        self._order = np.argsort(index, kind="stable")
        ordered = index[self._order]
        self._begins = np.flatnonzero(np.diff(ordered, prepend=-1))
        self._present, self._count = ordered[self._begins], count

    def __call__(self, rows: Array) -> Array:
        """Returns the sums (count, ...) of rows (S, ...); 0 for an index that none has."""
        sums = np.zeros((self._count, *rows.shape[1:]))
        if len(self._begins):
            sums[self._present] = np.add.reduceat(rows[self._order], self._begins, axis=0)
        return sums


def _diagonal(blocks: Array, share: float, least: float) -> Array:
    added = np.zeros_like(blocks)
    at = np.arange(blocks.shape[1])
    added[:, at, at] = share * blocks[:, at, at] + least
    return added
