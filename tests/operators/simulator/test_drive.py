"""A body that is shaken: its velocities are those of its poses, and an inertial unit feels it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dataflow.messages.geometry import invert
from operators.simulator.drive import Drive, bumps, sway
from operators.simulator.sensors.frames import mounted
from operators.simulator.sensors.inertial import true_reading
from operators.simulator.settings import Inertial
from operators.simulator.trajectory import Trajectory

OVAL = np.stack([2 * np.cos(np.arange(12) * math.pi / 6), np.sin(np.arange(12) * math.pi / 6)], axis=1)


@pytest.mark.long
@settings(max_examples=25, deadline=None)
@given(st.floats(0, 40), st.sampled_from([0.0, 1.0]), st.integers(0, 50))
def test_velocities_and_accelerations_are_derivatives_of_the_pose(t: float, hold: float, seed: int) -> None:
    drive, h = Drive(Trajectory(OVAL, hold=hold), [bumps(seed, 0.004), sway(seed, 0.02, 0.08)]), 1e-4
    before, now, after = (drive.state(t + 3 + dt) for dt in (-h, 0.0, h))
    T, R = now.T_world_base, now.T_world_base[:3, :3]
    ends = before.T_world_base, after.T_world_base
    velocity = (ends[1][:3, 3] - ends[0][:3, 3]) / (2 * h)
    acceleration = (ends[0][:3, 3] - 2 * T[:3, 3] + ends[1][:3, 3]) / h**2
    turn = Rotation.from_matrix(ends[0][:3, :3].T @ ends[1][:3, :3]).as_rotvec() / (2 * h)
    np.testing.assert_allclose(R @ now.linear, velocity, atol=1e-5)
    np.testing.assert_allclose(R @ now.acceleration, acceleration, atol=1e-4)
    np.testing.assert_allclose(now.angular, turn, atol=1e-5)
    np.testing.assert_allclose(now.angular_acceleration, (after.angular - before.angular) / (2 * h), atol=1e-3)


def test_a_robot_that_stands_feels_no_bumps() -> None:
    drive = Drive(Trajectory(OVAL, hold=3.0), [bumps(1, 0.01)])
    poses = drive.poses(np.arange(0, 3, 0.1))
    assert np.ptp(poses, axis=0).max() == 0
    assert np.ptp(drive.poses(np.arange(5, 9, 0.1))[:, 2, 3]) > 0.01


def test_shakes_are_as_large_as_stated() -> None:
    drive = Drive(Trajectory(OVAL, hold=1e4), [sway(2, 0.03, 0.1)])
    poses = drive.poses(np.arange(0, 400, 0.13))
    moved = invert(Drive(Trajectory(OVAL, hold=1e4)).poses([0.0])[0]) @ poses
    np.testing.assert_allclose(moved[:, :3, 3].std(axis=0), 0.03, rtol=0.1)
    angles = Rotation.from_matrix(moved[:, :3, :3]).as_euler("xyz")
    np.testing.assert_allclose(angles.std(axis=0), 0.1, rtol=0.1)


@pytest.mark.long
def test_integrated_inertial_readings_follow_a_shaken_body() -> None:
    """Strapdown integration in three dimensions, from the true state at the start."""
    drive = Drive(Trajectory(OVAL), [bumps(4, 0.003), sway(4, 0.03, 0.1)])
    imu, dt, steps = Inertial(mount=(0.2, -0.1, 0.4, 0.3, -0.2, 0.5)), 0.003, 1000
    T_base_imu = mounted(imu.mount)
    start = drive.state(0.0)
    R = (start.T_world_base @ T_base_imu)[:3, :3]
    p = (start.T_world_base @ T_base_imu)[:3, 3]
    v = start.velocity_of(T_base_imu[:3, 3])
    for k in range(steps):
        omega, force = true_reading(drive, imu, (k + 0.5) * dt)
        middle = R @ Rotation.from_rotvec(omega * dt / 2).as_matrix()
        a = middle @ force - [0, 0, imu.gravity]
        p = p + v * dt + a * dt * dt / 2
        v = v + a * dt
        R = R @ Rotation.from_rotvec(omega * dt).as_matrix()
    end = drive.poses([steps * dt])[0] @ T_base_imu
    np.testing.assert_allclose(p, end[:3, 3], atol=5e-3)
    assert Rotation.from_matrix(R.T @ end[:3, :3]).magnitude() < 1e-3


def test_a_shaken_inertial_unit_is_excited_in_all_axes() -> None:
    imu = Inertial()
    still, shaken = (
        np.array([true_reading(drive, imu, t)[1] for t in np.arange(0, 10, 0.05)])
        for shakes in ([], [sway(0, 0.03, 0.05)])
        for drive in [Drive(Trajectory(OVAL), shakes)]
    )
    assert still[:, 2].std() == pytest.approx(0, abs=1e-9)
    assert (shaken.std(axis=0) > 0.4).all()


def test_robot_carried_ahead_continues_from_there() -> None:
    plain, carried = Trajectory(OVAL), Trajectory(OVAL, jumps=[(5.0, 0.25), (9.0, 0.5)])
    for t, ahead in ((4.99, 0.0), (5.0, 0.25), (8.9, 0.25), (9.0, 0.75), (20.0, 0.75)):
        expected, found = plain.at([t + ahead * plain.period]), carried.at([t])
        np.testing.assert_allclose(found.position, expected.position, atol=1e-9)
        np.testing.assert_allclose(found.T_world_base(), expected.T_world_base(), atol=1e-9)
        np.testing.assert_allclose(found.yaw_rate, expected.yaw_rate, atol=1e-9)
