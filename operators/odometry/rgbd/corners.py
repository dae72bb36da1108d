"""The corners of keyframes: followed into a frame, kept for the next keyframe, and new ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels, Points
from operators.odometry.features import LK_LEVELS, Gray, detect_corners, track_corners, with_exposure_of
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter, Sighting
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.movers import Movers
from operators.odometry.rgbd.surface import DepthNoise

MAJORITY = 0.5  # of a keyframe's corners: where fewer agree on a pose, they are looked for once more
OLDEST = 10  # keyframes after which a corner's point is as sure as it gets

Layer = tuple[RgbdCamera, NDArray[np.float32]]  # a camera and the depth image, metres, that it sees through K_depth


@dataclass(frozen=True, eq=False)
class Corners:
    """Pixels (N, 2) of the working image, their points (N, 3) in the depth camera, and how often each was confirmed."""

    pixels: Pixels
    points: Points
    ages: NDArray[np.int64]


def depths_at(pixels: Pixels, layers: Sequence[Layer], near: float, far: float) -> tuple[Points, NDArray[np.bool_]]:
    """Returns the points (N, 3) of pixels (N, 2), each by the first layer with depth there, and a mask of the known."""
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


def followed(gray: Gray, keyframe: Keyframe, guess: Pixels, fitter: Fitter) -> Sighting | None:
    """Returns the pose in which most of a keyframe's corners lie where a frame shows them, near guessed pixels (N, 2).

    Smaller images find what has moved far, and lead astray where corners differ little: when few agree
    on a pose, they are looked for again in the whole image alone, within a window around the guess. Bouguet, 2000.
    """
    leveled = with_exposure_of(keyframe.gray, gray)

    def sighted(levels: int) -> Sighting | None:
        pixels, found = track_corners(keyframe.gray, leveled, keyframe.pixels, guess, levels)
        tracks = keyframe.points_world[found], pixels[found], keyframe.ages[found]
        return fitter.follow(*tracks, 3.0 * fitter.noise.pixel, fitter.config.min_inliers)

    first = sighted(LK_LEVELS)
    agree = 0 if first is None else len(first.pixels)
    if agree >= MAJORITY * len(keyframe.points):
        return first
    second = sighted(0)
    return second if second is not None and len(second.pixels) > agree else first
