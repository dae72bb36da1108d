"""Which of two motions the corners of a view stand still in, and what moves there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.monitoring.image_flaws import Watch
from operators.odometry.motion import Motion
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fit, Fitter, Sighting
from operators.odometry.rgbd.frame import Frame
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.movers import Movers
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import Surface

K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
TURNED = se3.exp(np.array([0.02, 0.0, 0.01, 0.0, 0.01, 0.0]))  # the camera
PUSHED = se3.exp(np.array([0.06, 0.02, 0.0, 0.0, 0.0, 0.05]))  # and what moves before it
FITTER = Fitter(RgbdCamera(K, K, np.eye(4)), RgbdOdometryConfig(), Noise(0.3, 1.0))

Points = NDArray[np.float64]


def corners(count: int, left: float, right: float, depth: float, seed: int) -> Points:
    """Points (N, 3) that lie evenly between two columns of the image, at depths that differ by a tenth."""
    rng = np.random.default_rng(seed)
    pixels = np.column_stack([rng.uniform(left, right, count), rng.uniform(10, 230, count)])
    z = depth * rng.uniform(0.95, 1.05, count)
    return np.column_stack([(pixels - K[:2, 2]) / 260.0 * z[:, None], z])


def seen(still: Points, moving: Points, pushed: NDArray[np.float64] = PUSHED) -> tuple[Points, Points]:
    """The points as the map has them, and their pixels in a camera that has turned while some were pushed."""
    there = np.concatenate([still, transform_points(pushed, moving)])
    noise = np.random.default_rng(3).normal(0, 0.1, (len(there), 2))
    return np.concatenate([still, moving]), project(transform_points(invert(TURNED), there), K) + noise


def followed(points: Points, pixels: Points) -> Sighting:
    return FITTER.follow(points, pixels, np.zeros(len(points), np.int64), 1.0, 15)


def off(sighting: Sighting) -> float:
    """How far the pose is from that of the camera, metres."""
    return float(np.linalg.norm((invert(TURNED) @ sighting.T_world_camera)[:3, 3]))


def test_the_larger_surface_stands_still_though_most_corners_are_on_something_near() -> None:
    wall, person = corners(60, 10, 110, 3.0, 1), corners(110, 130, 310, 0.8, 2)
    points, pixels = seen(wall, person)
    most = FITTER.solve(points, pixels, np.zeros(len(points), np.int64), 1.0, 15)
    assert len(most.pixels) >= 100

    found = followed(points, pixels)

    assert off(found) < 0.01 < off(most)
    assert found.tracked == 170
    where = project(found.contrary, K)
    assert len(where) >= 100
    assert where[:, 0].min() > 115


def test_majority_of_corners_decides_the_static_scene() -> None:
    points, pixels = seen(corners(110, 130, 310, 1.5, 1), corners(60, 10, 110, 1.5, 2))
    found = followed(points, pixels)
    assert off(found) < 0.01
    assert len(found.contrary) >= 50
    assert project(found.contrary, K)[:, 0].max() < 150


def test_far_corners_that_agree_with_both_motions_count_for_both() -> None:
    """A person near sways by 2 cm, by which a wall 12 m away seems not to have moved: it is no evidence for either."""
    table, wall = corners(60, 10, 110, 1.5, 1), corners(30, 10, 310, 12.0, 4)
    swayed = se3.exp(np.array([0.02, 0.01, 0.0, 0.0, 0.0, 0.0]))
    found = followed(*seen(np.concatenate([table, wall]), corners(110, 130, 310, 0.8, 2), swayed))
    assert off(found) < 0.01
    assert len(found.contrary) >= 100
    assert found.contrary[:, 2].max() < 1.0


@pytest.mark.parametrize("count", [0, 20])
def test_few_corners_far_away_contest_nothing(count: int) -> None:
    points, pixels = seen(corners(120, 130, 310, 0.8, 1), corners(count, 10, 110, 5.0, 2))
    found = followed(points, pixels)
    assert off(found) < 0.01
    assert not len(found.contrary)


@pytest.mark.parametrize(
    ("column", "row", "tile"),
    [(100, 60, (7, 12)), (63.4, 79.4, (9, 7)), (63.6, 79.6, (10, 8)), (-30, 300, (29, 0))],
    ids=["within", "the last pixels of a tile", "the first of the next", "outside"],
)
def test_tiles_around_moving_points_are_marked_as_moving(column: float, row: float, tile: tuple[int, int]) -> None:
    still = Movers.none(K, (240, 320))
    assert still.around(np.zeros((0, 3))) is still
    point = np.array([[(column - K[0, 2]) / 260.0, (row - K[1, 2]) / 260.0, 1.0]]) * 1.5

    moving = still.around(point)

    expected = np.zeros((30, 40), bool)
    expected[max(tile[0] - 1, 0) : tile[0] + 2, max(tile[1] - 1, 0) : tile[1] + 2] = True
    np.testing.assert_array_equal(moving.tiles, expected)
    assert moving.hold(point).tolist() == [True]
    assert not still.hold(point).any()
    for both in (moving.also(still), still.also(moving)):
        np.testing.assert_array_equal(both.tiles, expected)


# -- tracks and depth that disagree --------------------------------------------------------------------------


def wall_and(noise: Noise, drawn: float) -> tuple[Fitter, Frame, Sighting, LocalMap]:
    """A camera at rest in a corner of a room, turned by `drawn` radians as its tracks have it, but not its depth."""
    v, u = np.mgrid[:240, :320]
    rays = np.dstack([(u - K[0, 2]) / 260.0, (v - K[1, 2]) / 260.0, np.ones_like(u)])
    planes = np.array([[0.5, 0.1, 1.0], [-0.6, 0.2, 1.0], [0.0, 1.2, 0.5]])
    depth = np.min([2.0 / np.maximum(rays @ n, 0.1) for n in planes], axis=0).astype(np.float32)
    surface = Surface.from_depth(depth, K, 0.3, 6.0, 2)
    gray = np.zeros((240, 320), np.uint8)
    frame = Frame(0, gray, K, depth, surface, None, None, Watch())
    none = np.zeros((0, 3))
    newest = Keyframe(
        0, np.eye(4), np.zeros((6, 6)), gray, surface, none[:, :2], none, np.zeros(0, np.int64), apart=np.zeros(6)
    )
    known = LocalMap(5)
    known.add(newest)
    points = corners(200, 10, 310, 2.0, 1)
    T = se3.exp(np.array([0, 0, 0, 0, drawn, 0]))
    pixels = project(transform_points(invert(T), points), K) + np.random.default_rng(2).normal(0, 0.2, (200, 2))
    sighting = Sighting(T, points, pixels, np.zeros(200, np.int64), 200)
    return Fitter(RgbdCamera(K, K, np.eye(4)), RgbdOdometryConfig(), noise), frame, sighting, known


def refined(noise: Noise, drawn: float) -> Fit:
    fitter, frame, sighting, known = wall_and(noise, drawn)
    return fitter.refine(frame, sighting, Motion(-33_000_000, np.eye(4), np.zeros(6)), np.eye(4), known, 0)


def test_tracks_that_depth_draws_the_pose_from_miss_by_their_own_noise_unless_that_lasts() -> None:
    lasting, passing = Noise(1.2, 1.0, 5.0, 5.0), Noise(1.2, 1.0, 5.0, 0.0)
    torn, fro, alike = refined(lasting, 0.02), refined(passing, 0.02), refined(passing, 0.0)
    assert torn.missed > 4 * alike.missed
    assert fro.missed < 1.2 * alike.missed
    assert np.trace(torn.covariance) > 100 * np.trace(fro.covariance)
    np.testing.assert_array_equal(torn.T_world_camera, fro.T_world_camera)


def test_a_fit_remembers_what_draws_it_apart_and_without_depth_what_drew_its_keyframe() -> None:
    fitter, frame, sighting, known = wall_and(Noise(0.3, 1.0), 0.01)
    motion = Motion(-33_000_000, np.eye(4), np.zeros(6))
    fit = fitter.refine(frame, sighting, motion, np.eye(4), known, 0)
    assert fit.apart is not None
    assert fit.noise.disagreement > fitter.noise.disagreement
    known.keyframes[0] = replace(known.newest, apart=np.arange(6.0))
    blind = replace(frame, surface=Surface(np.zeros_like(frame.surface.inverse_depth), frame.surface.K))
    alone = fitter.refine(blind, sighting, motion, np.eye(4), known, 0)
    np.testing.assert_array_equal(alone.apart, np.arange(6.0))
    assert (alone.noise.disagreement, alone.noise.recurring) == (fitter.noise.disagreement, fitter.noise.recurring)
