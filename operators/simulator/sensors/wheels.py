"""Two driven wheels: encoder counts, and the odometry that a robot's controller makes of them."""

from __future__ import annotations

import math

import numpy as np

from dataflow.messages import Odometry, WheelTicks
from dataflow.messages.geometry import quaternion_from_yaw
from operators.simulator.sensors.frames import Array
from operators.simulator.settings import Wheels
from operators.simulator.trajectory import Trajectory

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


class WheelModel:
    """Counts and dead-reckons from tick to tick: one call for every tick, in order."""

    def __init__(self, wheels: Wheels, seed: int) -> None:
        self._off_scale = np.random.default_rng([seed, 31]).normal(0, wheels.scale_error, 2)
        self._time: float | None = None
        self._turned = np.zeros(2)  # metres at the rim: left, right
        self._counts = np.zeros(2, np.int64)
        self._pose = np.zeros(3)  # x, y, yaw as the controller believes
        self._spread = np.diag([0.0, 0.0, 0.0, wheels.scale_error**2, wheels.scale_error**2])  # pose, both scales

    def measure(
        self, wheels: Wheels, path: Trajectory, t: float, rng: np.random.Generator, stamp: int, frame: str, base: str
    ) -> tuple[WheelTicks, Odometry]:
        scale = 1 + np.array(wheels.bias) + self._off_scale
        metres_per_count = 2 * math.pi * wheels.radius / wheels.ticks_per_turn
        since = t if self._time is None else self._time
        rolled = _rolled(path, wheels.track, since, t)
        self._time = t
        slips = rng.standard_normal(2) * wheels.slip
        self._turned += rolled * scale + slips * np.sqrt(np.abs(rolled))
        counts = np.floor(self._turned / metres_per_count).astype(np.int64)
        left, right = (counts - self._counts) * metres_per_count
        self._counts = counts
        self._advance(wheels, float(left), float(right))
        elapsed = t - since
        if elapsed == 0:  # nothing has been counted yet: the rate is that of a period at the present speed
            elapsed = 1 / (wheels.rate or 1)
            rolled = _rim_speeds(path, wheels.track, np.array([t]))[:, 0] * elapsed
            left, right = rolled * scale + slips * np.sqrt(np.abs(rolled))
        speed, rate = (left + right) / 2 / elapsed, (right - left) / wheels.track / elapsed
        ticks = WheelTicks(
            stamp=stamp,
            names=("left", "right"),
            ticks=counts,
            ticks_per_radian=np.full(2, wheels.ticks_per_turn / (2 * math.pi)),
            radii=np.full(2, wheels.radius),
        )
        odometry = Odometry(
            stamp=stamp,
            frame=frame,
            child_frame=base,
            position=np.array([self._pose[0], self._pose[1], 0.0]),
            orientation=quaternion_from_yaw(self._pose[2]),
            pose_covariance=_spatial(self._spread[:3, :3]),
            linear=np.array([speed, 0.0, 0.0]),
            angular=np.array([0.0, 0.0, rate]),
        )
        return ticks, odometry

    def _advance(self, wheels: Wheels, left: float, right: float) -> None:
        """Second-order dead reckoning, and the covariance of what the wheels' errors do to it.

        Slip is fresh at every step; a wheel's scale error is the same for ever, so it stays in the state: what it does
        to the pose adds up along the way instead of averaging out.
        """
        forward, turn = (left + right) / 2, (right - left) / wheels.track
        middle = self._pose[2] + turn / 2
        c, s = math.cos(middle), math.sin(middle)
        self._pose += [forward * c, forward * s, turn]
        b = wheels.track
        G = np.array([[c / 2 + forward * s / (2 * b), c / 2 - forward * s / (2 * b)],
                      [s / 2 - forward * c / (2 * b), s / 2 + forward * c / (2 * b)],
                      [-1 / b, 1 / b]])  # fmt: skip
        F = np.eye(5)
        F[:2, 2] = -forward * s, forward * c
        F[:3, 3:] = G * [left, right]
        self._spread = F @ self._spread @ F.T
        self._spread[:3, :3] += wheels.slip**2 * (G * np.abs([left, right])) @ G.T


def _rolled(path: Trajectory, track: float, start: float, end: float) -> Array:
    """Returns what the left and the right wheel roll between two times, metres: Gauss-Legendre quadrature of their
    speeds."""
    if end <= start:
        return np.zeros(2)
    speeds = _rim_speeds(path, track, start + (end - start) * (_NODES + 1) / 2)
    return np.asarray(speeds @ _WEIGHTS / 2 * (end - start))


def _rim_speeds(path: Trajectory, track: float, times: Array) -> Array:
    """m/s (2, N) of the left and the right wheel on the floor."""
    motion = path.at(times)
    speed, turn = motion.speed(), motion.yaw_rate * track / 2
    return np.array([speed - turn, speed + turn])


def _spatial(planar: Array) -> Array:
    """The covariance (6, 6) of (x, y, z, rotations) of one of (x, y, yaw): the rest is known."""
    full = np.diag([0, 0, 1e-9, 1e-9, 1e-9, 0.0])
    index = [0, 1, 5]
    full[np.ix_(index, index)] = planar + 1e-9 * np.eye(3)
    return full
