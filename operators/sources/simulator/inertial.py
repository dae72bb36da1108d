"""An inertial measurement unit on the true trajectory.

The noise model is the usual one (Kalibr, IEEE 952): white noise of a density, and a bias that walks at random.
"""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import Imu
from operators.sources.simulator.frames import Array, mounted
from operators.sources.simulator.settings import Inertial
from operators.sources.simulator.trajectory import Trajectory


def true_reading(path: Trajectory, imu: Inertial, t: float) -> tuple[Array, Array]:
    """Angular velocity (rad/s) and specific force (m/s²) in the sensor's frame, without error.

    The robot turns about its z axis alone: at the lever (x, y) from its origin a turn adds α × l + ω × (ω × l).
    """
    motion = path.at([t])
    T_base_imu = mounted(imu.mount)
    x, y, _ = T_base_imu[:3, 3]
    rate, change = float(motion.yaw_rate[0]), float(motion.yaw_acceleration[0])
    ax, ay = motion.acceleration[0]
    c, s = math.cos(motion.yaw[0]), math.sin(motion.yaw[0])
    forward = c * ax + s * ay - change * y - rate * rate * x
    left = -s * ax + c * ay + change * x - rate * rate * y
    R_imu_base = T_base_imu[:3, :3].T
    return R_imu_base @ [0.0, 0.0, rate], R_imu_base @ [forward, left, imu.gravity]


class ImuModel:
    """The sensor with its walking biases: one call for every tick, in order."""

    def __init__(self, imu: Inertial) -> None:
        self._imu = imu
        self.gyro_bias = np.array(imu.gyro_bias)
        self.accel_bias = np.array(imu.accel_bias)

    def measure(self, path: Trajectory, t: float, rng: np.random.Generator, stamp: int, frame: str) -> Imu:
        imu = self._imu
        omega, force = true_reading(path, imu, t)
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
