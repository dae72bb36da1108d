"""Follows a keyframe's corners into a frame, from where a prediction puts them."""

from __future__ import annotations

from operators.geometry.pinhole import Pixels
from operators.odometry.features import LK_LEVELS, Gray, track_corners, with_exposure_of
from operators.odometry.rgbd.fitting import Fitter, Sighting
from operators.odometry.rgbd.keyframe import Keyframe

MAJORITY = 0.5  # of a keyframe's corners: where fewer agree on a pose, they are looked for once more


def followed(gray: Gray, keyframe: Keyframe, guess: Pixels, fitter: Fitter) -> Sighting | None:
    """Returns the pose in which most of a keyframe's corners lie where a frame shows them, near guessed pixels (N, 2).

    Smaller images find what has moved far, and lead astray where there is little to tell corners apart: when few agree
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
