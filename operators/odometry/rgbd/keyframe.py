"""Keyframes: views with a known pose that later frames are measured against."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.pinhole import Pixels, Points
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.features import Gray
from operators.odometry.recognition import Description, describe
from operators.odometry.rgbd.surface import Surface


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame kept: its image, its surface, its corners with depth, and the pose it was given."""

    stamp: int
    T_world_camera: Matrix
    covariance: Matrix  # (6, 6) of that pose, right perturbation
    gray: Gray
    surface: Surface
    pixels: Pixels  # (N, 2) corners in the working colour image
    points: Points  # (N, 3) the same corners in this view's depth camera
    ages: NDArray[np.int64]  # (N,) keyframes that have confirmed each corner's point
    segment: int = 0  # maps begun before this one after a loss; two segments share no known motion
    sunk: Vector = field(default_factory=lambda: np.zeros(6))  # part of the covariance: a standard deviation that grows

    @cached_property
    def points_world(self) -> Points:
        return transform_points(self.T_world_camera, self.points)

    @cached_property
    def T_camera_world(self) -> Matrix:
        return invert(self.T_world_camera)

    @cached_property
    def place_variance(self) -> float:
        """Square metres by which its place is unsure, all directions together."""
        return float(np.trace(self.covariance[:3, :3]))

    @cached_property
    def description(self) -> Description:
        """Its descriptors, made when a lost camera first asks for them."""
        return describe(self.gray)

    @property
    def empty(self) -> bool:
        """Tells whether nothing can be measured against it."""
        return len(self.points) < 6 and self.surface.coverage < 0.05


def view_distance(T_a: Matrix, T_b: Matrix, depth: float) -> float:
    """Returns how differently two cameras see a scene at a depth: baseline / depth + angle between them, radians."""
    T = invert(T_a) @ T_b
    way, trace = T[:3, 3].copy(), float(T[0, 0]) + float(T[1, 1]) + float(T[2, 2])
    cosine = min(max((trace - 1.0) / 2.0, -1.0), 1.0)
    return float(math.sqrt(way.dot(way)) / depth + np.arccos(cosine))


def redundant(poses: Sequence[Matrix], recent: int, depth: float = 2.0) -> int:
    """Returns the index of the old pose, before the `recent` newest, whose neighbours in time see most nearly what it
    sees of a scene at a depth; the first is the last to be one."""
    old = poses[: max(len(poses) - recent, 1)]
    gaps = [view_distance(poses[i - 1], poses[i + 1], depth) for i in range(1, len(old))]
    return 1 + int(np.argmin(gaps)) if gaps else 0
