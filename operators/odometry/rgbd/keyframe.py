"""Keyframes: views with a known pose that later frames are measured against."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import Pixels, Points
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.features import Gray
from operators.odometry.keyframes import view_distance
from operators.odometry.recognition import Description, describe
from operators.odometry.rgbd.surface import Surface
from operators.odometry.tracking import moved_covariance

# Errors that every fit makes alike and no residual shows add up between keyframes:
TURNING = 3e-6  # rad² a radian: turns are measured 0.1 to 0.3 % short
# 1/m, of the squared depth and of the change of view: floors and ceilings, met at a grazing angle, pull a pose up or
# down the image, by more the farther they are.
SINKING = 1e-4


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
    apart: Vector | None = None  # (6,) how tracks and depth were drawn apart by its fit; None if not known

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
        """Returns whether nothing can be measured against it."""
        return len(self.points) < 6 and self.surface.coverage < 0.05


def carried(known: Keyframe, T_world_camera: Matrix) -> tuple[Matrix, Vector]:
    """Returns the covariance (6, 6) of a pose whose motion from a keyframe is measured, but for what that fit errs by,
    and the part of it that is one standard deviation (6,) of an error that only grows."""
    covariance = moved_covariance(known.covariance, known.T_world_camera, T_world_camera)
    turn = se3.log(known.T_camera_world @ T_world_camera)[3:]
    covariance[3:, 3:] += TURNING * np.outer(turn, turn) / max(float(np.linalg.norm(turn)), 1e-9)
    so_far = se3.adjoint(invert(T_world_camera) @ known.T_world_camera) @ known.sunk
    depth, sunk = known.surface.typical_depth, so_far.copy()
    sunk[1] += SINKING * depth**2 * view_distance(known.T_world_camera, T_world_camera, depth)
    return covariance + np.outer(sunk, sunk) - np.outer(so_far, so_far), sunk
