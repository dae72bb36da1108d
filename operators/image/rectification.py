"""Rectification of a stereo pair: both images turned so that their rows correspond.

Bouguet's way, as in Bradski and Kaehler, "Learning OpenCV", 2008: each camera is turned by half of their relative
rotation, then both until the baseline is the x axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dataflow.messages import CameraInfo
from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.image.view import fitting_view


@dataclass(frozen=True, eq=False)
class Rectification:
    """R (3, 3) of each camera maps its axes to the rectified ones; K (3, 3) is that of both images."""

    R_left: Matrix
    R_right: Matrix
    K: Matrix
    baseline: float


def rectify(left: CameraInfo, right: CameraInfo, T_left_right: Matrix, keep: float) -> Rectification:
    """Returns the rectification of a pair; `keep` as in `fitting_view`.

    Raises ValueError where the right camera is not to the right of the left one: at its place, above or behind it, or
    looking elsewhere.
    """
    T_right_left = invert(T_left_right)
    half = se3.exp(0.5 * np.concatenate([np.zeros(3), se3.log(T_right_left)[3:]]))[:3, :3]
    towards = -(half.T @ T_right_left[:3, 3])  # of the right camera, in the axes half way
    baseline = float(np.linalg.norm(towards))
    if baseline < 1e-6:
        raise ValueError(f"{left.frame!r} and {right.frame!r} are at one place: no baseline")
    x = towards / baseline
    if x[0] < 0.7:
        raise ValueError(
            f"{right.frame!r} must lie to the right of {left.frame!r}, but lies towards {np.round(x, 2).tolist()}"
        )
    axis = np.cross([1.0, 0, 0], x)
    sine = float(np.linalg.norm(axis))
    turn = np.concatenate([np.zeros(3), axis / sine * np.arctan2(sine, x[0]) if sine > 1e-12 else np.zeros(3)])
    R_common = se3.exp(turn)[:3, :3].T
    R_left, R_right = R_common @ half, R_common @ half.T
    return Rectification(R_left, R_right, fitting_view([(left, R_left), (right, R_right)], keep), baseline)


def projection(K: Matrix, baseline: float) -> Matrix:
    """Returns P (3, 4) of a rectified camera so far to the right of the left one, metres."""
    P = np.hstack([K, np.zeros((3, 1))])
    P[0, 3] = -K[0, 0] * baseline
    return P
