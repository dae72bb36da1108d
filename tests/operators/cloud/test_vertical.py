"""The vertical of a camera's view, and the camera on a base that is level and on the ground."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dataflow.messages import Imu, Odometry, PointCloud, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.testing import play
from operators.cloud import CameraMount
from operators.cloud.held import accelerated, held
from operators.cloud.vertical import find_vertical

Array = NDArray[np.float64]
HEIGHT = 1.3


def turned(down: float, roll: float) -> Array:
    """Returns the rotation (3, 3) to a camera's optical frame from one with x right, y down and z ahead, all level."""
    return Rotation.from_euler("xz", [down, roll], degrees=True).as_matrix()


def room(down: float, roll: float, *, walls: bool = True, floor: bool = True) -> Array:
    """Returns what a camera sees of a floor, a table top and two walls, with noise (N, 3), in its optical frame."""
    rng = np.random.default_rng(3)
    flat = rng.uniform(-1, 1, (6000, 2))
    parts = []
    if floor:
        parts.append(np.stack([1.5 * flat[:, 0], np.full(6000, HEIGHT), 2.5 + flat[:, 1]], axis=1))
        parts.append(np.stack([0.5 * flat[:, 0], np.full(6000, HEIGHT - 0.7), 1.6 + 0.4 * flat[:, 1]], axis=1))
    if walls:
        parts.append(np.stack([1.5 * flat[:, 0], flat[:, 1], np.full(6000, 3.5)], axis=1))
        parts.append(np.stack([np.full(6000, 1.5), flat[:, 0], 2.5 + flat[:, 1]], axis=1))
    points = np.concatenate(parts) + rng.normal(0, 0.005, (len(parts) * 6000, 3))
    return points @ turned(down, roll).T


def cloud(points: Array, stamp: int = 0) -> PointCloud:
    return PointCloud(stamp=stamp, frame="depth", points=points.astype(np.float32))


@pytest.mark.parametrize(("down", "roll"), [(0, 0), (28, 0), (28, 12), (50, -8), (-15, 3)])
def test_vertical_and_height_of_a_camera_that_is_held_askew(down: float, roll: float) -> None:
    found = find_vertical(room(down, roll).astype(np.float32), *held())
    assert found is not None
    up = turned(down, roll) @ [0, -1, 0]
    angle = float(np.arccos(min(1.0, found.up @ up)))
    assert np.degrees(angle) < 1
    assert angle < 3 * found.sigma < np.radians(6)
    assert found.rival < 0.1  # so that it decides
    assert found.height == pytest.approx(HEIGHT, abs=0.03)


def test_walls_alone_leave_doubt_that_an_accelerometer_ends() -> None:
    points = room(20, 0, floor=False).astype(np.float32)
    up = turned(20, 0) @ [0, -1, 0]
    alone, helped = find_vertical(points, *held()), find_vertical(points, *accelerated(9.7 * up))
    assert alone is not None
    assert helped is not None
    assert helped.rival < 1e-6 < alone.rival
    assert float(helped.up @ up) > np.cos(np.radians(1.5))
    assert helped.height is None


def test_too_few_points_have_no_vertical() -> None:
    assert find_vertical(room(0, 0)[:30].astype(np.float32), *held()) is None


def test_base_is_level_on_the_ground_below_the_camera() -> None:
    known = Transforms.from_matrix(np.eye(4), stamp=0, frame="depth", child_frame="color")
    played = play(CameraMount(), {"cloud": [cloud(room(28, 5)), cloud(room(28, 5), 1)], "extrinsics": [known]})
    (made,) = played["base_extrinsics"]
    assert isinstance(made, Transforms)
    assert made.frames == ("depth", "base_link")
    T = made.matrix("depth")
    assert T[:3, 3] == pytest.approx([0, 0, HEIGHT], abs=0.03)
    assert T[:3, :3] @ turned(28, 5) @ [0, -1, 0] == pytest.approx([0, 0, 1], abs=0.02)
    ahead = T[:3, 2]
    assert ahead[1] == pytest.approx(0, abs=1e-9)
    assert ahead[0] > 0.8
    assert "looks 28° down" in played["status"][0].messages[0]  # type: ignore[attr-defined]


def test_a_view_that_decides_later_counts_from_where_the_odometry_began() -> None:
    first, later = turned(28, 0), turned(10, 0)
    T = np.eye(4)
    T[:3, :3] = first @ later.T
    T[:3, 3] = first @ [0, -0.2, 0]  # 0.2 m higher by now
    moved = Odometry.from_matrix(T, stamp=1, frame="odom", child_frame="depth")
    nothing = cloud(np.zeros((0, 3)))
    streams = {"cloud": [nothing, cloud(room(10, 0), 1)], "motion": [moved]}
    (made,) = play(CameraMount(), streams)["base_extrinsics"]
    assert isinstance(made, Transforms)
    assert made.stamp == 1
    T_base_camera = made.matrix("depth")
    assert T_base_camera[2, 3] == pytest.approx(HEIGHT - 0.2, abs=0.03)
    assert T_base_camera[:3, :3] @ first @ [0, -1, 0] == pytest.approx([0, 0, 1], abs=0.02)


def test_after_a_while_without_surfaces_a_guess_is_taken_with_a_warning() -> None:
    nothing = [cloud(np.zeros((0, 3)), stamp) for stamp in (0, 1_000_000_000, 2_000_000_000)]
    played = play(CameraMount(patience="2s"), {"cloud": nothing})
    assert [m.stamp for m in played["base_extrinsics"]] == [2_000_000_000]
    assert played["status"][0].levels.tolist() == [Level.WARN]  # type: ignore[attr-defined]


def test_a_base_that_is_given_is_kept() -> None:
    given = Transforms.from_matrix(np.eye(4), stamp=0, frame="base_link", child_frame="depth")
    (made,) = play(CameraMount(), {"cloud": [cloud(room(28, 5))], "extrinsics": [given]})["base_extrinsics"]
    assert made.digest() == given.digest()


def test_imu_of_a_frame_that_is_not_related_is_an_error() -> None:
    sample = Imu(stamp=0, frame="imu", angular_velocity=np.zeros(3), linear_acceleration=np.array([0, 0, 9.81]))
    known = Transforms.from_matrix(np.eye(4), stamp=0, frame="depth", child_frame="color")
    with pytest.raises(Exception, match="no transform between 'imu' and 'depth'"):
        play(CameraMount(), {"cloud": [cloud(room(0, 0))], "imu": [sample], "extrinsics": [known]})
