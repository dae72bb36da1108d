"""The corners of a new keyframe: those that it keeps from the last one, and new ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels, Points
from operators.odometry.features import Gray, detect_corners
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.movers import Movers
from operators.odometry.rgbd.surface import DepthNoise

OLDEST = 10  # keyframes after which a corner's point is as sure as it gets

Layer = tuple[RgbdCamera, NDArray[np.float32]]  # a camera and the depth image, metres, that it sees through K_depth


@dataclass(frozen=True, eq=False)
class Corners:
    """Pixels (N, 2) of the working image, their points (N, 3) in the depth camera, and how often each was confirmed."""

    pixels: Pixels
    points: Points
    ages: NDArray[np.int64]


def depths_at(pixels: Pixels, layers: Sequence[Layer], near: float, far: float) -> tuple[Points, NDArray[np.bool_]]:
    """Returns the points (N, 3) of pixels (N, 2), each by the first layer that knows it, and which are known."""
    points, known = np.zeros((len(pixels), 3)), np.zeros(len(pixels), np.bool_)
    for camera, depth in layers:
        missing = np.flatnonzero(~known)
        if not len(missing):
            break
        found, there = camera.depth_at(pixels[missing], depth, near, far)
        points[missing[there]], known[missing[there]] = found[there], True
    return points, known


def renewed(
    kept: Corners, layers: Sequence[Layer], near: float, far: float, noise: DepthNoise, scale: float
) -> Corners:
    """Averages each kept corner's point with the depth that it has now; drops those that contradict it."""
    seen, known = depths_at(kept.pixels, layers, near, far)
    z = kept.points[:, 2]
    agree = np.abs(seen[:, 2] - z) < 3.0 * np.sqrt(2.0) * scale * noise.sigma(z) + 0.01
    share = 1.0 / (kept.ages + 2.0)
    points = np.where(known[:, None], kept.points + share[:, None] * (seen - kept.points), kept.points)
    stay = agree | ~known
    return Corners(kept.pixels[stay], points[stay], np.minimum(kept.ages + 1, OLDEST)[stay])


def with_new(
    gray: Gray, kept: Corners, count: int, layers: Sequence[Layer], near: float, far: float, movers: Movers
) -> Corners:
    """Adds corners of an image that have depth and do not move, at most count with those kept."""
    fresh = detect_corners(gray, count, kept.pixels)
    points, known = depths_at(fresh, layers, near, far)
    known[known] &= ~movers.hold(points[known])
    return Corners(
        np.concatenate([kept.pixels, fresh[known]]),
        np.concatenate([kept.points, points[known]]),
        np.concatenate([kept.ages, np.zeros(np.count_nonzero(known), np.int64)]),
    )
