"""The beginning of a monocular map: two views with parallax, the points that they give, and a unit."""

from dataclasses import dataclass

import numpy as np

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.se3 import Matrix
from operators.odometry.mono.map import MonoMap, View, found_in
from operators.odometry.mono.scale import FEWEST_METRES, Scale, way
from operators.odometry.mono.settings import MonoOdometryConfig
from operators.odometry.mono.tracks import MonoFrame, Tracks
from operators.odometry.mono.two_view import TwoViewFailure, two_views

ROUNDS = 15  # of the first adjustment


@dataclass(frozen=True, eq=False)
class Beginning:
    """A map of two keyframes, how well its unit is known, and the corners of the second that fit it."""

    map: MonoMap
    scale: Scale
    tracks: Tracks


def first_map(
    frame: MonoFrame, first: View, tracks: Tracks, covariance: Matrix, config: MonoOdometryConfig
) -> Beginning | TwoViewFailure:
    """Returns the map that a frame and an earlier view of its corners give, or why they give none.

    The unit is a metre where both know how far the camera came, and else the depth of the median point.
    """
    rows, _ = found_in(first.numbers, tracks.numbers)
    found = two_views(first.pixels[rows], tracks.pixels, frame.K, config.two_view)
    if isinstance(found, TwoViewFailure):
        return found
    T_first = first.T_world_camera
    second = Tracks(frame.gray, T_first @ invert(found.T_second_first), tracks.numbers, tracks.pixels)
    points = transform_points(T_first, found.points)
    begun = MonoMap((first, second.view(frame, covariance))).with_points(tracks.numbers[found.chosen], points)
    begun, wrong = begun.adjusted(frame.K, config.sigma, config.window, 1, ROUNDS)
    begun = begun.without(wrong)
    if len(begun.numbers) < max(0.7 * config.two_view.min_points, config.min_inliers):
        return TwoViewFailure.DISAGREE
    begun, scale = _measured(begun, config)
    kept = second.only(~np.isin(second.numbers, wrong))
    return Beginning(begun, scale, Tracks(frame.gray, begun.newest.T_world_camera, kept.numbers, kept.pixels))


def _measured(begun: MonoMap, config: MonoOdometryConfig) -> tuple[MonoMap, Scale]:
    first, second = begun.views
    origin = first.T_world_camera[:3, 3]
    metres = way(first.T_reference, second.T_reference)
    if metres < FEWEST_METRES:
        return begun.resized(1.0 / begun.typical_depth(second.T_world_camera), origin), Scale()
    baseline = float(np.linalg.norm(second.T_world_camera[:3, 3] - origin))
    metric = begun.resized(metres / baseline, origin)
    return metric, Scale().corrected(metric.views, config.reference_sigma)[1]
