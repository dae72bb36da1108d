"""Views of a made room measured against each other, with known truth."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix, Vector
from operators.odometry.recognition import match
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import Surface
from operators.odometry.rgbd.tracker import RgbdOdometry
from operators.slam.visual.view import STRIDE, Judge, View, ViewMatch, relief, sight
from operators.sources.room import Room, camera_path, look_at

K = np.array([[158.0, 0.0, 95.5], [0.0, 158.0, 71.5], [0.0, 0.0, 1.0]])
CAMERA = RgbdCamera(K, K)
FITTER = Fitter(CAMERA, RgbdOdometryConfig(), Noise(0.3, 1.0))


@cache
def room(seed: int) -> Room:
    return Room(seed)


def view(T: Matrix, seed: int = 0, lit: bool = True) -> View:
    seen = room(seed).render(T, K, (192, 144))
    odometry = RgbdOdometry(CAMERA)
    rng = np.random.default_rng(int(1e6 * abs(T[0, 3])))
    depth = seen.depth + 0.0015 * seen.depth**2 * rng.standard_normal(seen.depth.shape)
    odometry.track(seen.image if lit else np.zeros_like(seen.image), depth.astype(np.float32), 0)
    return View.of(odometry.state.map.newest, CAMERA)


FIRST = camera_path(0.0, 36.0)
BESIDE = look_at(np.array([1.3, 0.5, 1.4]), np.array([0.0, 0.0, 0.6]))
OPPOSITE = camera_path(18.0, 36.0)


def test_a_view_from_elsewhere_is_placed_and_believed() -> None:
    seen = sight(view(FIRST), view(BESIDE), FITTER, 20)
    assert Judge().doubt(seen) == ""
    off = se3.log(invert(invert(FIRST) @ BESIDE) @ seen.T_known_seen)
    assert np.linalg.norm(off[:3]) < 0.015
    assert np.linalg.norm(off[3:]) < 0.006
    assert off @ np.linalg.solve(seen.covariance + 1e-6 * np.eye(6), off) / 6 < 5


def test_measured_from_either_end_the_motion_is_the_same() -> None:
    a, b = view(FIRST), view(BESIDE)
    there, back = sight(a, b, FITTER, 20), sight(b, a, FITTER, 20)
    assert np.abs(se3.log(there.T_known_seen @ back.T_known_seen)).max() < 0.01


def test_features_are_looked_for_again_where_a_first_pose_has_them() -> None:
    far = look_at(np.array([0.79, 1.34, 1.3]), np.array([0.0, 0.0, 0.6]))  # 1.6 m and 69 degrees away
    known, other, T = view(FIRST), view(far), invert(FIRST) @ far
    assert len(match(known.description, other.description)) < 30
    seen = sight(known, other, FITTER, 20)
    assert seen.inliers > 22
    assert np.linalg.norm(se3.log(invert(T) @ seen.T_known_seen)[:3]) < 0.03


def test_a_wrong_expectation_misleads_no_sight() -> None:
    known, other, T = view(FIRST), view(BESIDE), invert(FIRST) @ BESIDE
    astray = T @ se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.2, 0.0]))
    seen = sight(known, other, FITTER, 20, astray)
    assert np.linalg.norm(se3.log(invert(T) @ seen.T_known_seen)[:3]) < 0.015


def picture_and_robot(shift: Vector) -> View:
    """What a camera at the origin sees: 40 features of a picture on a wall 4 m away, 50 of a robot before it."""
    rng = np.random.default_rng(3)
    picture = rng.uniform((-2.2, -1.6, 4.0), (0.6, 1.4, 4.0), (40, 3))
    robot = rng.uniform((0.2, -0.4, 1.9), (0.8, 0.6, 1.9), (50, 3)) + shift
    points, descriptors = np.concatenate([picture, robot]), rng.integers(0, 120, (90, 128), np.uint8)
    depth = np.full((144, 192), 4.0, np.float32)
    (left, top), (right, bottom) = project(np.array([[0.2, -0.4, 1.9], [0.8, 0.6, 1.9]]) + shift, K).astype(np.int64)
    depth[top:bottom, left:right] = 1.9 + shift[2]
    surface = Surface.from_depth(depth, K, 0.3, 6.0, 2)
    return View(
        project(points, K).astype(np.float32), descriptors, points.astype(np.float32), surface, np.zeros(1, np.uint8)
    )


@pytest.mark.parametrize("shift", [(0.15, 0.0, 0.0), (-0.2, 0.0, 0.1)])
def test_a_body_that_has_moved_does_not_place_a_view(shift: tuple[float, float, float]) -> None:
    """More features lie on it, and yet what it hides is larger."""
    seen = sight(picture_and_robot(np.zeros(3)), picture_and_robot(np.array(shift)), FITTER, 20)
    assert np.linalg.norm(se3.log(seen.T_known_seen)[:3]) < 0.03
    assert Judge().doubt(seen) == ""


@pytest.mark.parametrize(
    ("other", "seed", "lit"),
    [(OPPOSITE, 0, True), (FIRST, 5, True), (FIRST, 0, False)],  # across the room, another room, in the dark
)
def test_a_view_of_something_else_is_not_believed(other: Matrix, seed: int, lit: bool) -> None:
    seen = sight(view(FIRST), view(other, seed, lit), FITTER, 8)
    assert seen is None or Judge().doubt(seen)


def on_floor(count: int, off: float = 0.0) -> NDArray[np.float64]:
    """Points on the floor with a centimetre of noise, or some way off it."""
    rng = np.random.default_rng(count)
    return np.column_stack([rng.uniform(-2, 2, (count, 2)), off + rng.normal(0, 0.01, count)])


def test_relief_counts_the_features_off_the_plane_of_most() -> None:
    assert relief(on_floor(60)) <= 1
    assert relief(np.concatenate([on_floor(60), on_floor(13, 0.4)])) == pytest.approx(13, abs=1)
    tilted = se3.exp(np.array([0.3, 0.1, 2.0, 0.7, -0.4, 0.2]))
    assert relief(on_floor(60) @ tilted[:3, :3].T + tilted[:3, 3]) <= 1


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((20, 3)), np.outer(np.arange(9.0), [1, 2, 3])])
def test_points_that_span_no_plane_have_no_relief(points: NDArray[np.float64]) -> None:
    assert relief(points) == 0


def test_a_view_of_a_room_has_relief() -> None:
    seen = sight(view(FIRST), view(BESIDE), FITTER, 20)
    assert seen.relief >= Judge().relief


def test_doubts_have_reasons() -> None:
    def doubt(inliers: int, overlap: float, agreement: float) -> str:
        return Judge().doubt(ViewMatch(np.eye(4), np.eye(6), 99, inliers, 50, overlap, agreement))

    assert doubt(19, 0.9, 0.9) == "too few features agree"
    assert doubt(99, 0.1, 0.9) == "too little of the depth overlaps"
    assert doubt(99, 0.9, 0.7) == "too little of the depth agrees"
    assert doubt(20, 0.2, 0.8) == ""


def test_a_view_holds_points_where_the_camera_saw_them_and_shades_of_its_cloud() -> None:
    seen = view(FIRST)
    known = np.isfinite(seen.points[:, 2])
    assert known.mean() > 0.8
    x, y, z = seen.points[known].T.astype(np.float64)
    np.testing.assert_allclose(x / z * K[0, 0] + K[0, 2], seen.pixels[known, 0], atol=0.01)
    np.testing.assert_allclose(y / z * K[1, 1] + K[1, 2], seen.pixels[known, 1], atol=0.01)
    assert len(seen.shades) == len(seen.surface.points(STRIDE))
    assert seen.shades.std() > 5
