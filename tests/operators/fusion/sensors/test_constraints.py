"""What holds of a body without a sensor of it: rest where nothing trembles, no slip where it rolls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_sensors import fused
from operator_runs import assert_resumes_alike, firings_of

from dataflow.messages import Imu, Message, Pose
from operators.fusion import EkfFusion
from operators.fusion.filter.error_state import Noise
from operators.fusion.filter.history import Sample
from operators.fusion.filter.measurements import Velocity
from operators.fusion.sensors.constraints import Constraints

RATE, GRAVITY = 100, 9.80665
BIAS = np.array([0.06, -0.04, 0.03])
TURN_BIAS = np.array([0.004, -0.003, 0.005])
Array = np.ndarray


def readings(
    velocity: Array, tremble: Array, seed: int = 0, yaw: Array | None = None
) -> tuple[list[Message], list[Message], Array]:
    """Inertial samples of a level body with a velocity (N, 3) in the world, ten poses a second, and its places (N, 3).

    `tremble` (N,) is the noise of the motion, m/s²; `yaw` (N,) where it looks.
    """
    rng = np.random.default_rng(seed)
    heading = np.zeros(len(velocity)) if yaw is None else yaw
    c, s = np.cos(heading), np.sin(heading)
    push = np.gradient(velocity, 1 / RATE, axis=0)
    own = np.column_stack([c * push[:, 0] + s * push[:, 1], c * push[:, 1] - s * push[:, 0], push[:, 2]])
    turning = np.gradient(heading, 1 / RATE)
    places = np.concatenate([np.zeros((1, 3)), np.cumsum((velocity[1:] + velocity[:-1]) / 2 / RATE, axis=0)])
    imu: list[Message] = []
    poses: list[Message] = []
    for k in range(len(velocity)):
        stamp = 10**9 + k * 10**9 // RATE
        force = own[k] + [0, 0, GRAVITY] + BIAS + rng.normal(0, 0.02, 3) + tremble[k] * rng.normal(0, 1, 3)
        strays = rng.normal(0, 0.002, 3) + 0.2 * tremble[k] * rng.normal(0, 1, 3)
        imu.append(
            Imu(
                stamp=stamp,
                frame="base_link",
                angular_velocity=np.array([0, 0, turning[k]]) + TURN_BIAS + strays,
                linear_acceleration=force,
                angular_velocity_covariance=np.eye(3) * 4e-6,
                linear_acceleration_covariance=np.eye(3) * 4e-4,
            )
        )
        if not k % (RATE // 10):
            T = np.eye(4)
            T[:2, :2], T[:3, 3] = [[c[k], -s[k]], [s[k], c[k]]], places[k]
            poses.append(
                Pose.from_matrix(T, stamp=stamp, frame="world", child_frame="base_link", covariance=np.eye(6) * 4e-4)
            )
    return imu, poses, places


def outage(
    velocity: Array, tremble: Array, until: float, yaw: Array | None = None, **params: Any
) -> tuple[EkfFusion, float]:
    """The operator after motion with poses only `until` so many seconds, and how far off it is at the end (m)."""
    imu, poses, places = readings(velocity, tremble, yaw=yaw)
    known = [m for m in poses if m.stamp < 10**9 + until * 1e9]
    operator, played = fused({"robot/imu": imu, "robot/pose": known}, heading=0.0, **params)
    last = played["odometry"][-1]
    return operator, float(np.linalg.norm(last.position - places[-1]))


def count(operator: EkfFusion, what: str) -> int:
    return int(operator.summary().get(what, 0))


def walked(seconds: float, stop: float) -> tuple[Array, Array]:
    """Velocity and tremble of something carried about until it is put down."""
    t = np.arange(int(seconds * RATE)) / RATE
    moving = np.clip((stop - t) / 0.5, 0, 1) * np.clip((t - 0.8) / 0.5, 0, 1)
    velocity = np.column_stack([0.6 * np.sin(1.1 * t), 0.5 * np.cos(0.7 * t), 0.1 * np.sin(2 * t)]) * moving[:, None]
    return velocity, 0.4 * (moving > 0)


@pytest.mark.long
def test_device_put_down_stays_in_place() -> None:
    velocity, tremble = walked(18.0, 7.0)
    _, without = outage(velocity, tremble, 8.0)
    operator, held = outage(velocity, tremble, 8.0, standstill=0.1)
    assert held < 0.03 < 0.3 < without
    assert count(operator, "standstill velocity, used") > 80


def test_slow_trembling_motion_is_not_taken_for_standstill() -> None:
    t = np.arange(10 * RATE) / RATE
    velocity = np.column_stack([0.05 * np.clip(t - 0.8, 0, 1), 0 * t, 0 * t])
    operator, _ = outage(velocity, 0.3 * (t > 0.8), 10.0, standstill=0.1)
    assert count(operator, "standstill velocity, used") <= 3  # of the rest that it begins with
    assert count(operator, "robot/pose, used") > 80


@pytest.mark.long
def test_known_even_motion_is_not_taken_for_standstill() -> None:
    t = np.arange(12 * RATE) / RATE
    velocity = np.column_stack([0.5 * np.clip(t - 1.5, 0, 1), 0 * t, 0 * t])  # without a tremble: as a rail
    without, off = outage(velocity, 0 * t, 8.0)
    operator, stopped = outage(velocity, 0 * t, 8.0, standstill=0.1)
    assert count(operator, "standstill velocity, refused") > 50
    assert abs(stopped - off) < 0.1
    assert "standstill velocity, used" not in without.summary()


@pytest.mark.long
def test_no_slip_constraint_reduces_drift() -> None:
    t = np.arange(22 * RATE) / RATE
    speed = 0.8 * np.clip((t - 0.8) / 2, 0, 1)
    yaw = 0.8 * np.sin(0.5 * np.clip(t - 0.8, 0, None))
    velocity = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw), 0 * t])
    _, without = outage(velocity, 0 * t, 12.0, yaw)
    operator, held = outage(velocity, 0 * t, 12.0, yaw, slip=0.02)
    assert held < 0.5 * without
    assert count(operator, "slip, used") > 150


def test_slip_constraint_is_applied_at_10_hz() -> None:
    at = np.eye(4)
    at[:3, :3], at[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.1, 0.2, 0.3]  # the base looks along the body's y
    constraints = Constraints(None, 0.02)
    level, noise = np.array([0.0, 0.0, GRAVITY]), Noise(1e-3, 1e-3, 0.0, 0.0)
    made = [list(constraints.after(Sample(k * 10**7, np.zeros(3), level, noise), at)) for k in range(21)]
    assert [k for k, found in enumerate(made) if found] == [0, 10, 20]
    ((name, model, covariance),) = made[0]
    assert name == "slip"
    assert np.allclose(covariance, np.eye(2) * 4e-4)
    assert isinstance(model, Velocity)
    assert np.allclose(model.value, 0)
    assert np.allclose(model.lever, [0.1, 0.2, 0.3])
    assert np.allclose(model.axes, [[-1, 0, 0], [0, 0, 1]])


@pytest.mark.long
def test_restored_operator_resumes_alike() -> None:
    imu, poses, _ = readings(*walked(6.0, 4.0))
    params: dict[str, Any] = {"heading": 0.0, "standstill": 0.1, "slip": 0.05, "sensors": {"robot/pose": {}}}
    firings = firings_of({"robot/imu": imu, "robot/pose": poses})
    assert_resumes_alike(lambda: EkfFusion(**params), firings, 480)


@pytest.mark.parametrize("gap", [1, 2], ids=["too few readings", "readings that end"])
def test_a_standstill_needs_half_a_second_of_readings(gap: int) -> None:
    constraints = Constraints(0.1, None)
    quiet, up = Noise(1e-3, 1e-2, 0.0, 0.0), np.array([0.0, 0.0, GRAVITY])
    found = []
    for k in range(12):
        time = k * 10_000_000 if gap == 1 else k * 400_000_000
        found += list(constraints.after(Sample(time, np.zeros(3), up, quiet), np.eye(4)))
    assert found == []


def test_neither_is_used_unasked() -> None:
    constraints = Constraints(None, None)
    assert constraints.gates == {}
    quiet, up = Noise(1e-3, 1e-2, 0.0, 0.0), np.array([0.0, 0.0, GRAVITY])
    assert not [m for k in range(200) for m in constraints.after(Sample(k * 10**7, np.zeros(3), up, quiet), np.eye(4))]
