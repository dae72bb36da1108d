"""Motions that are stated twice and contradict each other, with the one mistake that explains it; on real data too."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lint_inputs import MadeInput, every
from scipy.spatial.transform import Rotation

from dataflow.lint.motion import check_motion
from dataflow.messages import Imu, Message, Odometry, Pose, Transforms

STAMPS = every(0.05)
TIMES = np.arange(len(STAMPS)) * 0.05
TURNS = Rotation.from_euler("zyx", np.column_stack([0.6 * TIMES, 0.3 * np.sin(TIMES), 0.2 * np.sin(2 * TIMES)]))
"""A body that turns left and sways."""
FORWARD = np.array([1.0, 0.0, 0.0])


@cache
def rates() -> np.ndarray:
    """(N, 3) angular velocity in the body's axes, from the differences of its orientations."""
    turned = (TURNS[:-1].inv() * TURNS[1:]).as_rotvec() / 0.05
    return np.vstack([turned, turned[-1:]])


def w_first(quaternion: np.ndarray) -> np.ndarray:
    return quaternion[[3, 0, 1, 2]]


def sensed(stamp: int, turning: Any, pull: Any = (0, 0, 9.81), orientation: Any = None) -> Imu:
    return Imu(stamp=stamp, frame="imu", orientation=orientation, angular_velocity=turning, linear_acceleration=pull)


def imu(
    orientation: Callable[[np.ndarray], np.ndarray] = lambda q: q, rate: float = 1.0, pull: float = 9.81
) -> list[Message]:
    up, quaternions = TURNS.inv().apply([0.0, 0.0, pull]), map(orientation, TURNS.as_quat())
    return list(map(sensed, STAMPS, rate * rates(), up, quaternions))


def odometry(velocity: Callable[[int], Any] = lambda _: FORWARD, unit: float = 1.0) -> list[Message]:
    """A body that goes ahead at 1 m/s; `velocity` as its messages give it, positions in `unit` (m)."""
    steps = TURNS.apply(FORWARD) * 0.05
    positions = np.vstack([np.zeros(3), np.cumsum(steps[:-1], axis=0)]) / unit
    return [
        Odometry(
            stamp=s,
            frame="odom",
            child_frame="base",
            position=positions[i],
            orientation=TURNS[i].as_quat(),
            linear=velocity(i),
            angular=rates()[i],
        )
        for i, s in enumerate(STAMPS)
    ]


def found(**streams: list[Message]) -> list[str]:
    return [finding.text for finding in check_motion(MadeInput(streams))]


@pytest.mark.parametrize(
    ("messages", "mistake"),
    [
        (imu(w_first), "(w, x, y, z)"),
        (imu(lambda q: q * [-1, -1, -1, 1]), "are inverted"),
        (imu(rate=np.degrees(1.0)), "in degrees"),
        (imu(pull=-9.81), "points down"),
        (odometry(lambda i: TURNS[i].apply(FORWARD)), "is given in 'odom', and in 'base' is wanted"),
        (odometry(unit=0.001), "positions are in millimetres"),
        (odometry(lambda _: 1000 * FORWARD), "in mm/s"),
        (odometry(lambda _: 3.6 * FORWARD), "in km/h"),
        (odometry(lambda _: -FORWARD), "the opposite sign"),
    ],
)
def test_a_motion_that_contradicts_itself_is_named_with_its_mistake(messages: list[Message], mistake: str) -> None:
    (text,) = found(stream=messages)

    assert mistake in text


def test_a_motion_that_agrees_stands_still_or_is_not_stated_is_sound() -> None:
    unturned = [m.replace(angular_velocity=np.zeros(3)) for m in imu()]

    assert found(imu=imu(), odometry=odometry()) == []
    assert found(imu=unturned, odometry=odometry(lambda _: np.zeros(3))) == []
    assert found(imu=[m.replace(orientation=None) for m in imu()]) == []


def test_errors_without_a_single_explanation_are_not_reported() -> None:
    random = np.random.default_rng(1)

    assert found(imu=[m.replace(angular_velocity=random.normal(size=3)) for m in imu()]) == []


def test_a_level_robot_at_rest_shows_its_quaternions_by_its_acceleration() -> None:
    (text,) = found(imu=[sensed(s, np.zeros(3), orientation=[1.0, 0, 0, 0]) for s in STAMPS])

    assert "(w, x, y, z)" in text


MOUNT = Rotation.from_euler("xyz", [90, 20, 0], degrees=True)
"""Maps the sensor's coordinates to the body's."""


def mounted(turn: Rotation) -> list[Message]:
    rows = np.array([turn.as_quat()])
    return [Transforms(stamp=0, frames=("body",), child_frames=("imu",), translations=np.zeros((1, 3)), rotations=rows)]


def test_an_inverted_mount_is_named_by_the_turning_of_both_its_frames() -> None:
    gyro = list(map(sensed, STAMPS, MOUNT.inv().apply(rates())))
    poses: list[Message] = [
        Pose(stamp=s, frame="map", child_frame="body", position=np.zeros(3), orientation=TURNS[i].as_quat())
        for i, s in enumerate(STAMPS)
    ]

    assert found(imu=gyro, pose=poses, extrinsics=mounted(MOUNT)) == []
    (text,) = found(imu=gyro, pose=poses, extrinsics=mounted(MOUNT.inv()))
    assert "the static transform of 'imu' in 'body' is inverted" in text
    (text,) = found(imu=gyro, pose=[p.replace(orientation=w_first(p.orientation)) for p in poses],
                    extrinsics=mounted(MOUNT))  # fmt: skip
    assert "(w, x, y, z)" in text
    (text,) = found(imu=[m.replace(angular_velocity=np.degrees(m.angular_velocity)) for m in gyro], pose=poses)
    assert "in degrees" in text


def test_a_real_sensor_is_sound_and_its_quaternions_as_its_file_has_them_are_named(data_dir: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(data_dir / "broad_imu" / "11_undisturbed_slow_translation_B.hdf5") as file:
        truth, gyro, pull = (file[name][::8] for name in ("opt_quat", "imu_gyr", "imu_acc"))
        period = 8 / float(np.ravel(file.attrs["sampling_rate"])[0])
    truth /= np.linalg.norm(truth, axis=1)[:, None]

    def messages(order: list[int]) -> list[Message]:
        whole = np.flatnonzero(np.isfinite(truth).all(axis=1))
        return [sensed(round(i * period * 1e9), gyro[i], pull[i], truth[i, order]) for i in whole]

    assert found(imu=messages([1, 2, 3, 0])) == []
    (text,) = found(imu=messages([0, 1, 2, 3]))
    assert "(w, x, y, z)" in text
