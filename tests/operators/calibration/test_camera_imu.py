"""Rotation and clock offset between a camera and an IMU that turn as one, against those that made them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from made_boards import Array, Lens, pose, turned
from made_views import view
from scipy.spatial.transform import Rotation

from dataflow.messages import CameraInfo
from operators.calibration.boards import Chessboard
from operators.calibration.camera_imu import CameraImuCalibration, Turning, fit_mount, turning_of, warnings_of

BOARD = Chessboard(9, 6, 0.03)
LENS = Lens()
INFO = CameraInfo(
    stamp=0, frame="camera", width=480, height=360, distortion_model="plumb_bob", K=LENS.K,
    distortion=np.array(LENS.bend),
)  # fmt: skip
R_IMU_CAMERA = turned(0.3, -1.2, 2.0)
BIAS = np.array([0.01, -0.02, 0.005])


def facing(t: float, axes: int = 3) -> Array:
    """R_camera_board at a time."""
    slow, fast = np.sin([2.1 * t, 1.7 * t + 1, 2.6 * t + 2]), np.sin([5.3 * t + 3, 4.1 * t, 6.7 * t + 1])
    angles = np.array([0.2, 0.25, 0.3]) * slow + np.array([0.06, 0.08, 0.05]) * fast * np.sin(0.9 * t)
    return turned(*np.where(np.arange(3) < axes, angles, 0.0))


def camera(late: float = 0.0, axes: int = 3, seconds: float = 12.0) -> Turning:
    rng = np.random.default_rng(2)
    times = np.arange(0, seconds, 0.05)
    seen = [
        view(BOARD, LENS, pose(BOARD, facing(t, axes), (0.02, 0, 0.6)), rng, round((t + late) * 1e9)) for t in times
    ]
    return turning_of(BOARD, seen, INFO, 0)


@cache
def gyroscope(rate: float = 200.0, axes: int = 3) -> tuple[Array, Array]:
    rng = np.random.default_rng(4)
    times = np.arange(-1, 13, 1 / rate)
    before, after = (np.array([facing(t + dt, axes) for t in times]) for dt in (-5e-4, 5e-4))
    turns = Rotation.from_matrix(before @ after.transpose(0, 2, 1)).as_rotvec() * 1e3
    return times, turns @ R_IMU_CAMERA.T + BIAS + rng.normal(0, 0.003, (len(times), 3))


@pytest.mark.parametrize("late", [-0.31, 0.0])
def test_rotation_offset_and_bias_are_those_that_made_the_turning(late: float) -> None:
    found = fit_mount(camera(late), *gyroscope())

    assert found.offset == pytest.approx(late, abs=1e-3)
    assert abs(found.offset - late) < 4 * found.offset_deviation
    off = Rotation.from_matrix(found.R_imu_camera.T @ R_IMU_CAMERA).magnitude()
    assert off < np.radians(0.15)
    assert off < 4 * found.rotation_deviation
    assert found.bias == pytest.approx(BIAS, abs=2e-3)
    assert found.rate == pytest.approx(200)
    assert warnings_of(found) == []


def test_views_that_lie_far_apart_in_time_are_no_turn() -> None:
    whole = camera(seconds=3.0)
    assert ((whole.ends - whole.begins) <= 0.4 + 1e-9).all()
    rng = np.random.default_rng(2)
    times = [*np.arange(0, 1, 0.05), *np.arange(1.3, 2, 0.05)]
    seen = [view(BOARD, LENS, pose(BOARD, facing(t), (0, 0, 0.6)), rng, round(t * 1e9)) for t in times]
    gapped = turning_of(BOARD, seen, INFO, 0)
    assert not ((gapped.begins < 1.1) & (gapped.ends > 1.1)).any()


def test_turning_about_one_axis_is_poor() -> None:
    found = fit_mount(camera(axes=1), *gyroscope(axes=1))
    assert any("turn it about all three" in text for text in warnings_of(found))


def test_another_imu_and_too_little_are_errors() -> None:
    times, rates = gyroscope()
    with pytest.raises(ValueError, match="do not turn alike"):
        fit_mount(camera(), times, rates[::-1].copy())
    with pytest.raises(ValueError, match="pairs of images with the board"):
        fit_mount(camera(seconds=1.0), times, rates)
    with pytest.raises(ValueError, match="0 pairs of images"):
        fit_mount(turning_of(BOARD, [], INFO, 0), times, rates)


def test_poor_figures_are_named() -> None:
    poor = CameraImuCalibration(np.eye(3), 0.01, np.zeros(3), 0.02, 0.004, 0.1, np.ones(3), 50, 20.0)
    assert [text.split(":")[0] for text in warnings_of(poor)] == [
        "the rotation is known to ±1.15° only",
        "the offset is known to ±4.0 ms only",
        "the IMU has 20 samples a second",
    ]


def test_a_camera_without_distortion_turns_as_one_with_it() -> None:
    lens, rng = Lens(bend=(0.0,) * 5), np.random.default_rng(2)
    plain = CameraInfo(stamp=0, frame="camera", width=480, height=360, K=lens.K)
    times = np.arange(0, 1, 0.05)
    seen = [view(BOARD, lens, pose(BOARD, facing(t), (0.02, 0, 0.6)), rng, round(t * 1e9)) for t in times]
    found = turning_of(BOARD, seen, plain, 0)

    turned = [facing(a) @ facing(b).T for a, b in zip(found.begins, found.ends, strict=True)]
    assert found.turns == pytest.approx(Rotation.from_matrix(turned).as_rotvec(), abs=0.01)
