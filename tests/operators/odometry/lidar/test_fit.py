"""A scan laid on planes that are known, the motion that it is expected by, and the places that it is looked for at."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.odometry.lidar.fit import Fit, Prior, agreements, fit
from operators.odometry.lidar.map import PlaneMap
from operators.odometry.lidar.motion import LidarMotion, as_left, as_right, corrected
from operators.odometry.lidar.scan import Scan
from operators.odometry.lidar.search import apart, around, places

Array = NDArray[np.float64]

SECOND = 1_000_000_000  # ns
TRUTH = se3.exp(np.array([0.3, -0.2, 0.1, 0.02, -0.03, 0.08]))


def walls(count: int, axes: tuple[int, ...], seed: int) -> Array:
    """Points (N, 3) of two walls across each of some axes, 4.3 m to either side of the origin."""
    rng = np.random.default_rng(seed)
    found = []
    for axis in axes:
        for side in (-4.3, 4.3):
            points = rng.uniform(-3.9, 3.9, (count, 3))
            points[:, axis] = side + rng.normal(0, 0.005, count)
            found.append(points)
    return np.concatenate(found)


def laid(axes: tuple[int, ...], T: Array, start: Array) -> Fit:
    """The fit of a scan from a pose, begun at another, in a map of walls."""
    planes = PlaneMap(2.0, 2)
    planes.add(walls(6000, axes, 1), birth=0)
    points = transform_points(invert(T), walls(150, axes, 2))
    scan = Scan(points, None, np.arange(len(points)), 0)
    prior = Prior(start, np.diag([1.0] * 3 + [4.0] * 3))
    return fit(scan, planes, prior, lambda T: np.zeros(6), 0.02)


def test_scan_between_walls_is_registered_at_its_pose() -> None:
    found = laid((0, 1, 2), TRUTH, np.eye(4))
    assert np.abs(se3.log(invert(TRUTH) @ found.T)).max() < 2e-3
    assert found.blind.shape == (0, 6)
    assert found.inliers > 0.98
    assert found.known > 0.98
    assert 700 < found.paired <= 900
    assert found.rmse == pytest.approx(0.005, rel=0.2)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert 5e-4 < sigma[:3].min() <= sigma[:3].max() < 2e-3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_along_a_direction_that_no_wall_crosses_the_prediction_stands_and_is_named(axis: int) -> None:
    start = np.eye(4)
    start[axis, 3] = 0.4
    other = tuple(k for k in range(3) if k != axis)
    found = laid(other, np.eye(4), start)
    (twist,) = found.blind
    assert np.abs(twist[axis]) == pytest.approx(1.0, abs=1e-3)
    assert found.T[axis, 3] == pytest.approx(0.4, abs=0.02)
    assert np.abs(np.delete(found.T[:3, 3], axis)).max() < 3e-3
    sigma = np.sqrt(np.diag(np.linalg.inv(found.information + 1e-6 * np.eye(6))))
    assert sigma[axis] > 20 * np.delete(sigma[:3], axis).max()


def test_floor_and_ceiling_constrain_height_roll_and_pitch_only() -> None:
    """However little is known of the motion: the pose does not run away along what nothing holds."""
    found = laid((2,), TRUTH, np.eye(4))
    assert len(found.blind) == 3
    assert np.linalg.matrix_rank(found.blind) == 3
    off, moved = se3.log(invert(TRUTH) @ found.T), se3.log(found.T)
    assert abs(off[2]) < 0.02
    assert np.abs(off[3:5]).max() < 5e-3
    assert np.abs(moved[:2]).max() < 0.05
    assert abs(moved[5]) < 0.02


def test_a_body_before_the_walls_draws_the_pose_nowhere() -> None:
    planes, rng = PlaneMap(2.0, 2), np.random.default_rng(3)
    planes.add(walls(6000, (0, 1, 2), 1), birth=0)
    moved = walls(150, (0,), 4)[:100] + np.array([0.25, 0.0, 0.0])
    points = transform_points(invert(TRUTH), np.concatenate([walls(150, (0, 1, 2), 2), moved]))
    scan = Scan(points[rng.permutation(len(points))], None, np.arange(len(points)), 0)
    found = fit(scan, planes, Prior(TRUTH, 1e-3 * np.eye(6)), lambda T: np.zeros(6), 0.02)
    assert np.abs(se3.log(invert(TRUTH) @ found.T)[:3]).max() < 0.01
    assert found.inliers < 0.95


def test_a_scan_swept_in_motion_is_laid_by_the_velocity_that_its_pose_means() -> None:
    """It took 0.1 s, to its stamp, at 2 m/s; a tenth of a second ago the sensor was at the origin."""
    velocity, rng = np.array([2.0, 0.5, 0.0, 0.0, 0.0, 0.6]), np.random.default_rng(5)
    here, offsets = se3.exp(0.1 * velocity), rng.uniform(-0.1, 0.0, 900)
    planes = PlaneMap(2.0, 2)
    planes.add(walls(6000, (0, 1, 2), 1), birth=0)
    seen = walls(150, (0, 1, 2), 2)
    poses = [here @ se3.exp(velocity * t) for t in offsets]
    points = np.array([T[:3, :3].T @ (p - T[:3, 3]) for p, T in zip(seen, poses, strict=True)])
    scan = Scan(points, offsets, np.arange(len(points)), 0)
    found = fit(scan, planes, Prior(np.eye(4), 1e-3 * np.eye(6)), lambda T: se3.log(T) / 0.1, 0.02)
    assert np.abs(se3.log(invert(here) @ found.T)).max() < 5e-3


def test_poses_agree_by_how_many_points_lie_on_planes() -> None:
    planes = PlaneMap(2.0, 2)
    planes.add(walls(6000, (0, 1, 2), 1), birth=0)
    points, aside = walls(50, (0, 1, 2), 2), np.eye(4)
    aside[2, 3] = 0.3
    far = se3.exp(np.array([40.0, 0, 0, 0, 0, 0]))
    right, off, nowhere = agreements(points, planes, np.array([np.eye(4), aside, far]), 0.02, 3.0)
    assert right > 0.95 * len(points)
    assert off == pytest.approx(2 / 3 * len(points), rel=0.1)  # floor and ceiling are off
    assert nowhere == 0.0


# -- the motion --------------------------------------------------------------------------------------------------


def test_predicted_motion_stops_after_the_patience() -> None:
    velocity = np.array([1.0, 0.2, 0.0, 0.0, 0.0, 0.5])
    motion = LidarMotion(2 * SECOND, TRUTH, velocity, np.zeros((6, 6)), fresh=False)
    np.testing.assert_allclose(motion.predicted(2 * SECOND + SECOND // 2, 0.8), TRUTH @ se3.exp(0.5 * velocity))
    np.testing.assert_allclose(motion.predicted(9 * SECOND, 0.8), TRUTH @ se3.exp(0.8 * velocity))
    there = TRUTH @ se3.exp(0.5 * velocity)
    np.testing.assert_allclose(motion.velocity_to(there, 5 * SECOND // 2), velocity, atol=1e-12)


def test_a_sweep_is_deskewed_by_the_mean_velocity_since_the_last_pose_but_one() -> None:
    before, here = se3.exp(np.array([-0.3, 0, 0, 0, 0, 0.0])), se3.exp(np.array([0.2, 0, 0, 0, 0, 0.0]))
    motion = LidarMotion(SECOND, np.eye(4), np.zeros(6), np.zeros((6, 6)), False, SECOND // 2, before)
    np.testing.assert_allclose(motion.sweep_velocity(here, 3 * SECOND // 2)[:3], [0.5, 0.0, 0.0], atol=1e-12)
    first = LidarMotion(SECOND, np.eye(4), np.zeros(6), np.zeros((6, 6)))
    np.testing.assert_allclose(first.sweep_velocity(here, 3 * SECOND // 2)[:3], [0.4, 0.0, 0.0], atol=1e-12)


def test_prediction_spread_grows_with_time_and_starts_at_any_speed() -> None:
    known = LidarMotion(0, np.eye(4), np.zeros(6), np.zeros((6, 6)), fresh=False)
    np.testing.assert_allclose(np.sqrt(np.diag(known.spread(SECOND // 5, 10.0, 5.0, 30.0))), [0.4] * 3 + [0.2] * 3)
    fresh = LidarMotion(0, np.eye(4), np.zeros(6), np.zeros((6, 6)))
    sigma = np.sqrt(np.diag(fresh.spread(SECOND // 5, 10.0, 5.0, 30.0)))
    np.testing.assert_allclose(sigma, [6.0] * 3 + [0.1 * np.pi] * 3)
    assert np.sqrt(known.spread(9 * SECOND, 10.0, 5.0, 30.0)[5, 5]) == pytest.approx(np.pi)  # any heading


def test_an_error_before_a_pose_and_one_behind_it_are_the_same_error() -> None:
    rng = np.random.default_rng(6)
    root = rng.normal(0, 0.01, (6, 6))
    C = root @ root.T
    np.testing.assert_allclose(as_right(as_left(C, TRUTH), TRUTH), C, atol=1e-12)
    drawn = rng.multivariate_normal(np.zeros(6), 1e-4 * C, 1000)
    left = [se3.log(TRUTH @ se3.exp(x) @ invert(TRUTH)) for x in drawn]
    expected = 1e-4 * as_left(C, TRUTH)
    np.testing.assert_allclose(np.cov(np.array(left).T), expected, atol=0.3 * expected.max())


def test_constrained_directions_take_the_map_covariance_and_others_the_predicted_one() -> None:
    of_map, of_last, spread = 1e-4 * np.eye(6), 4e-2 * np.eye(6), 1e-2 * np.eye(6)
    held = np.diag([0.0, 1e6, 1e6, 1e6, 1e6, 1e6])  # nothing along x
    covariance, own = corrected(np.eye(4), held, spread, of_map, of_last)
    np.testing.assert_allclose(np.diag(covariance), [4e-2 + 1e-2] + [1e-4] * 5, rtol=0.05)
    np.testing.assert_allclose(np.diag(own), [1e-2] + [1e-6] * 5, rtol=0.02)


# -- the search --------------------------------------------------------------------------------------------------


def test_a_scan_is_looked_for_around_a_guess_and_found_best_where_it_was_taken() -> None:
    planes = PlaneMap(2.0, 2)
    cupboard = np.random.default_rng(7).uniform([1.2, 1, -4], [1.25, 3, 0], (3000, 3))
    world = np.concatenate([walls(6000, (0, 1, 2), 1), cupboard])
    planes.add(world, birth=0)
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 6]))
    T[:2, 3] = 1.0, -0.5
    points = transform_points(invert(T), world[::60])
    poses, scores = around(points, planes, np.eye(4), 1.5, np.arange(-3, 4) * np.pi / 12, 0.02)
    assert len(poses) == 7 * 7 * 7
    assert (np.diff(scores) <= 0).all()
    assert np.abs(se3.log(invert(T) @ poses[0])).max() < 1e-6
    wide, _ = around(points, planes, np.eye(4), 4.0, np.zeros(1), 0.02)
    assert len(wide) == 9 * 9  # a metre apart


def test_no_two_of_the_places_to_look_at_are_one() -> None:
    steps = [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (1.0, 0.5), (1.1, 0.6), (4.0, 0.0), (9.0, 0.0)]
    poses = np.array([se3.exp(np.array([x, 0, 0, 0, 0, yaw])) for x, yaw in steps])
    scores = np.array([10.0, 9.5, 9.0, 8.5, 8.4, 7.5, 6.9])  # the last is worth less than 0.7 of the best
    found = places(poses, scores, 9)
    assert [round(float(T[0, 3]), 3) for T in found] == [round(float(poses[k, 0, 3]), 3) for k in (0, 2, 3, 5)]
    assert len(places(poses, scores, 2)) == 2
    assert not apart(poses[0], poses[1])
    assert apart(poses[0], poses[2])
    assert apart(poses[2], poses[3])
