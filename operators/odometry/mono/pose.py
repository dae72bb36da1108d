"""The pose of one camera from points that it sees: RANSAC, then a robust refinement with its information."""

from dataclasses import dataclass

import numpy as np

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.perspective import agreed_pose
from operators.geometry.pinhole import Pixels, Points, project
from operators.geometry.se3 import Matrix
from operators.odometry.features import Mask
from operators.odometry.rgbd.alignment import PixelTerm, PriorTerm, align

ITERATIONS = 200  # of RANSAC, at most


@dataclass(frozen=True, eq=False)
class PosedView:
    """T_world_camera, which of the points agree with it, and their information (6, 6)."""

    T_world_camera: Matrix
    agree: Mask
    information: Matrix

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.agree))


def solved(points: Points, pixels: Pixels, K: Matrix, error: float, fewest: int) -> tuple[Matrix, Mask] | None:
    """Returns T_world_camera by RANSAC, and which points (N, 3) agree within an error in pixels; None if too few do."""
    if len(points) < fewest:
        return None
    found = agreed_pose(points, pixels, K, error, ITERATIONS)
    if found is None or len(found[1]) < fewest:
        return None
    agree = np.zeros(len(points), np.bool_)
    agree[found[1]] = True
    return invert(found[0]), agree


def refined(points: Points, pixels: Pixels, T: Matrix, K: Matrix, sigma: float, gate: float) -> PosedView:
    """Returns the pose that fits points (N, 3) best, and those within `gate` standard deviations of it."""
    term = PixelTerm(points, pixels, K, np.eye(4), sigma, 1.0)
    found = align(T, (term,), PriorTerm(T, 1e-6 * np.eye(6)), 10)
    T = found.T_world_camera
    local = transform_points(invert(T), points)
    off = project(local, K) - pixels
    agree = (local[:, 2] > 0) & ((off**2).sum(axis=1) < (gate * sigma) ** 2)
    return PosedView(T, np.asarray(agree, np.bool_), found.information)
