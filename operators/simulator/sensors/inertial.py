"""An inertial measurement unit on the true trajectory.

The noise model is the usual one (Kalibr, IEEE 952): white noise of a density, and a bias that walks at random.
"""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import Imu
from operators.simulator.drive import Drive
from operators.simulator.sensors.frames import Array, place
from operators.simulator.settings import Inertial
from operators.simulator.stage import Stage


def true_reading(drive: Drive, imu: Inertial, t: float) -> tuple[Array, Array]:
    """Angular velocity (rad/s) and specific force (m/s²) in the sensor's frame, without error.

    At the lever l from the body's origin a turn adds α × l + ω × (ω × l).
    """
    state = drive.state(t)
    T_base_imu = place(imu)
    lever, omega = T_base_imu[:3, 3], state.angular
    up = state.T_world_base[2, :3]
    force = state.acceleration + imu.gravity * up
    force = force + np.cross(state.angular_acceleration, lever) + np.cross(omega, np.cross(omega, lever))
    R_imu_base = T_base_imu[:3, :3].T
    return R_imu_base @ omega, R_imu_base @ force


class ImuModel:
    """The sensor with its walking biases: one call for every tick, in order."""

    def __init__(self, imu: Inertial) -> None:
        self.gyro_bias = np.array(imu.gyro_bias)
        self.accel_bias = np.array(imu.accel_bias)

    def measure(self, stage: Stage, imu: Inertial, t: float, rng: np.random.Generator, stamp: int, frame: str) -> Imu:
        omega, force = true_reading(stage.drive, imu, t)
        white = math.sqrt(imu.rate)  # of a density, sampled at the rate
        noise = rng.standard_normal((4, 3))
        self.gyro_bias = self.gyro_bias + imu.gyro_walk / white * noise[2]
        self.accel_bias = self.accel_bias + imu.accel_walk / white * noise[3]
        return Imu(
            stamp=stamp,
            frame=frame,
            angular_velocity=omega + self.gyro_bias + imu.gyro_noise * white * noise[0],
            linear_acceleration=force + self.accel_bias + imu.accel_noise * white * noise[1],
            angular_velocity_covariance=np.eye(3) * max(imu.gyro_noise * white, 1e-9) ** 2,
            linear_acceleration_covariance=np.eye(3) * max(imu.accel_noise * white, 1e-9) ** 2,
        )
