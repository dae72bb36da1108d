"""Errors that RGB-D odometry makes alike in every fit, which no residual shows: they add up between keyframes."""

from __future__ import annotations

import numpy as np

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.rgbd.keyframe import Keyframe, view_distance
from operators.odometry.tracking import moved_covariance

TURNING = 3e-6  # rad² a radian: turns are measured 0.1 to 0.3 % short
# 1/m, of the squared depth and of the change of view: floors and ceilings, met at a grazing angle, pull a pose up or
# down the image, by more the farther they are.
SINKING = 1e-4


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
