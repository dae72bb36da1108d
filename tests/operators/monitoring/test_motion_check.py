"""Sensors that tell of another motion than the rest are named, and wheels that do are held back."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from repeated import assert_repeats
from scipy.spatial.transform import Rotation

from dataflow import Played, play
from dataflow.messages import Imu, Odometry, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert
from operators.geometry.se3 import exp
from operators.monitoring import MotionCheck
from tests.operators.monitoring.rooms import warnings

SECONDS = 12
SPEED, TURN = 0.5, 0.4
T_BASE = {
    "camera": np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 1.1], [0, 0, 0, 1.0]]),
    "lidar": np.array([[1, 0, 0, -0.05], [0, 1, 0, 0], [0, 0, 1, 0.6], [0, 0, 0, 1.0]]),
    "imu": np.eye(4),
}


POSES = [np.eye(4)]
"""Where the robot is every 10 ms: it swings from left to right as it drives."""
for step in range(SECONDS * 100):
    POSES.append(POSES[-1] @ exp(np.array([SPEED, 0, 0, 0, 0, TURN * np.sin(0.008 * step)]) * 0.01))


def odometry(sensor: str, every: int, seed: int, scale: float = 1.0) -> list[Odometry]:
    rng = np.random.default_rng(seed)
    out = []
    for k in range(0, SECONDS * 100, every):
        noise = exp(np.concatenate([rng.normal(0, 0.002, 3), rng.normal(0, 0.0004, 3)]))
        T = invert(T_BASE[sensor]) @ POSES[k] @ T_BASE[sensor] @ noise
        T[:3, 3] *= scale
        out.append(Odometry.from_matrix(T, stamp=k * 10_000_000, frame="odom", child_frame=sensor))
    return out


def wheels(scale: float = 1.0, still: Sequence[float] = (99, 99)) -> list[Odometry]:
    out = []
    for k in range(0, SECONDS * 100, 5):
        moves = not still[0] <= k / 100 < still[1]
        linear, angular = np.array([SPEED, 0, 0]), np.array([0, 0, TURN * np.sin(0.008 * (k - 2.5))])
        twist = {"linear": linear * scale * moves, "angular": angular * scale * moves}
        out.append(
            Odometry.from_matrix(np.eye(4), stamp=k * 10_000_000, frame="wheel_odom", child_frame="base_link", **twist)
        )
    return out


def gyroscope(scale: float = 1.0) -> list[Imu]:
    rng = np.random.default_rng(5)
    return [
        Imu(
            stamp=k * 10_000_000,
            frame="imu",
            angular_velocity=np.array([0, 0, scale * TURN * np.sin(0.008 * k)]) + rng.normal(0, 0.002, 3),
            linear_acceleration=np.array([0, 0, 9.8]),
        )
        for k in range(SECONDS * 100)
    ]


def extrinsics(sensor: str = "", axis: str = "z", angle: float = 0.0) -> Transforms:
    matrices = []
    for name, T in T_BASE.items():
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler(axis, angle * (name == sensor), degrees=True).as_matrix()
        matrices.append(T @ turn)
    return Transforms(
        stamp=0,
        frames=("base_link",) * 3,
        child_frames=tuple(T_BASE),
        translations=np.array([T[:3, 3] for T in matrices]),
        rotations=Rotation.from_matrix([T[:3, :3] for T in matrices]).as_quat(),
    )


def checked(known: Transforms | None = None, operator: MotionCheck | None = None, **changed: Any) -> Played:
    lidar, camera = changed.get("lidar", odometry("lidar", 20, 2)), changed.get("camera", odometry("camera", 10, 1))
    given: dict[str, Any] = {
        "wheels": changed.get("wheels", wheels()),
        "motions": {name: stream for name, stream in (("camera", camera), ("lidar", lidar)) if stream is not None},
        "imu": {"imu": changed.get("imu", gyroscope())},
        "extrinsics": [known or extrinsics()],
    }
    return play(operator or MotionCheck(), given, static=["extrinsics"])


def test_sensors_that_agree_raise_no_alarm_and_wheels_pass_as_they_are() -> None:
    played = checked()
    assert warnings(played) == []
    assert len(played["status"]) >= 18
    assert [m.digest() for m in played["checked"]] == [m.digest() for m in wheels()]


@pytest.mark.parametrize(
    ("name", "changed", "said"),
    [
        ("wheels", wheels(1.05), "wheels: 4.9% more way than motions/camera and motions/lidar"),
        ("camera", odometry("camera", 10, 1, 1.05), "motions/camera: 4.9% more way than motions/lidar and wheels"),
        ("imu", gyroscope(1.06), "gyroscope of imu: 5.8% more turning than"),
    ],
)
def test_sensor_of_another_scale_is_reported_and_wheels_are_held_back(name: str, changed: Any, said: str) -> None:
    played = checked(**{name: changed})
    assert warnings(played)[-1].startswith(said)
    assert (len(played["checked"]) < 0.5 * len(wheels())) == (name == "wheels")


def test_wheels_at_rest_on_a_moving_robot_are_held_back_at_once_and_only_then() -> None:
    given = wheels(still=(4.0, 6.0))
    played = checked(wheels=given)
    late = [m.stamp * 1e-9 for m in given if 4.3 <= m.stamp * 1e-9 < 6.0]
    passed = {m.stamp * 1e-9 for m in played["checked"]}
    assert not passed & set(late)
    assert {m.stamp * 1e-9 for m in given if not 4.0 <= m.stamp * 1e-9 < 6.3} <= passed
    assert any("otherwise than the robot moves" in text for text in warnings(played))
    assert int(played["status"][-1].levels[0]) == Level.OK


@pytest.mark.parametrize("sensor", [pytest.param("wheels", marks=pytest.mark.long), "imu"])
def test_sensor_repeating_a_reading_is_reported_only_in_motion(sensor: str) -> None:
    given: list[Any] = wheels() if sensor == "wheels" else gyroscope()
    held = next(m for m in given if m.stamp >= 6_000_000_000)
    hung = [held.replace(stamp=m.stamp) if 6 <= m.stamp * 1e-9 < 7.5 else m for m in given]
    said = warnings(checked(**{sensor: hung}))
    assert [text for text in said if "repeats its last reading" in text]
    assert "repeats" not in said[-1] or len(said) < 4
    resting = [m.replace(linear=np.zeros(3), angular=np.zeros(3)) for m in wheels()]
    standing = [
        m.replace(position=np.zeros(3), orientation=np.array([0, 0, 0, 1.0])) for m in odometry("camera", 10, 1)
    ]
    assert not warnings(checked(wheels=resting, camera=standing, lidar=[], imu=[]))


@pytest.mark.parametrize(
    ("sensor", "axis", "name"),
    [
        ("lidar", "z", "motions/lidar"),
        pytest.param("camera", "y", "motions/camera", marks=pytest.mark.long),
        ("camera", "x", "motions/camera"),
        ("imu", "y", "gyroscope of imu"),
    ],
)
def test_a_sensor_that_is_turned_against_its_extrinsic_is_named(sensor: str, axis: str, name: str) -> None:
    said = warnings(checked(extrinsics(sensor, axis, 3.0)))
    assert any(text.startswith(f"{name}: direction off by") for text in said[-1].split("; "))


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_readings_that_are_not_finite_are_counted_and_left_out(wrong: float) -> None:
    driven, turned, carried = wheels(), gyroscope(), odometry("camera", 10, 1)
    driven[40] = driven[40].replace(linear=[wrong, 0, 0])
    turned[500] = turned[500].replace(angular_velocity=[wrong, 0, 0])
    carried[50] = carried[50].replace(position=[wrong, 0, 0])
    operator = MotionCheck()
    played = checked(operator=operator, wheels=driven, camera=carried, imu=turned)
    assert warnings(played) == []
    assert [m.stamp for m in played["checked"]] == [m.stamp for m in driven if m is not driven[40]]
    counted = {name: n for name, n in operator.summary().items() if "not finite" in name}
    assert counted == {"gyroscope of imu: not finite": 1, "motions/camera: not finite": 1, "wheels: not finite": 1}


def test_of_two_it_is_open_which_is_wrong_and_wheels_still_pass() -> None:
    played = checked(wheels=wheels(1.05), camera=None, imu=[])
    assert warnings(played)[-1].startswith("motions/lidar: ")
    assert len(played["checked"]) == len(wheels())


def test_restored_check_continues_identically() -> None:
    by_stamp: dict[int, dict[str, Odometry]] = {}
    for name, messages in (
        ("wheels", wheels(1.05)), ("camera", odometry("camera", 10, 1)), ("lidar", odometry("lidar", 20, 2)),
    ):  # fmt: skip
        for message in messages:
            by_stamp.setdefault(message.stamp, {})[name] = message
    calls = []
    for stamp, now in sorted(by_stamp.items())[:160]:
        motions = {f"robot/motions/{name}": m for name, m in now.items() if name != "wheels"}
        calls.append((SimpleNamespace(stamp=stamp), now.get("wheels"), motions, (), extrinsics()))
    assert_repeats(MotionCheck, calls, 100)
