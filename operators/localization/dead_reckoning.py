"""Steps of a robot between odometry messages, turned by the wheels or, better, by a gyroscope."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Odometry
from dataflow.messages.geometry import yaw_of
from dataflow.operator import Remembered
from operators.estimation.particles import wrapped
from operators.localization.motion import DriveNoise

Array = NDArray[np.float64]
_STILL = 1e-4
_LEARNING = 0.02
_MEMORY = 0.95
"""Share of a difference between wheels and gyroscope that is left after another step."""


class DeadReckoning(Remembered):
    """Gives steps (x, y, turn) and their covariances; learns the gyroscope's bias while the wheels stand.

    Where wheels and gyroscope disagree about the last turns by more than three standard deviations, one of them is
    wrong (a slipping wheel): a step's heading is then only as good as they agree.
    """

    bias: float
    disagreements: int
    _last: tuple[int, Array] | None
    _rates: list[tuple[int, float]]
    _apart: Array

    def __init__(self, noise: DriveNoise) -> None:
        self._noise, self.bias, self.disagreements = noise, 0.0, 0
        self._last, self._rates, self._apart = None, [], np.zeros(2)

    def feel(self, stamp: int, rate: float) -> None:
        """Takes a rate about the robot's vertical axis: its time (ns), rad/s."""
        self._rates.append((stamp, rate))

    @property
    def stamp(self) -> int | None:
        """The time of the last odometry message, ns."""
        return None if self._last is None else self._last[0]

    def step(self, odometry: Odometry) -> tuple[int, Array, Array] | None:
        """Returns the time (ns) of the last message, the step since and its covariance; None at the first."""
        now = np.array([*odometry.position[:2], float(yaw_of(odometry.orientation))])
        before, self._last = self._last, (odometry.stamp, now)
        if before is None:
            return None
        begin, pose = before
        seconds = (odometry.stamp - begin) * 1e-9
        c, s = math.cos(pose[2]), math.sin(pose[2])
        dx, dy = (now - pose)[:2]
        turn = float(wrapped(now[2:] - pose[2:])[0])
        step = np.array([c * dx + s * dy, c * dy - s * dx, turn])
        rate = self._mean_rate(begin, odometry.stamp)
        if rate is None:
            return begin, step, self._noise.covariance(step, seconds, by_gyro=False)
        if abs(dx) + abs(dy) + abs(turn) < _STILL:
            self.bias += _LEARNING * (rate - self.bias)
            return begin, np.zeros(3), self._noise.covariance(np.zeros(3), seconds, by_gyro=True)
        felt = (rate - self.bias) * seconds
        by_wheels = self._noise.covariance(step, seconds, by_gyro=False)
        step[2] = felt
        covariance = self._noise.covariance(step, seconds, by_gyro=True)
        self._apart = _MEMORY * self._apart + np.array([felt - turn, by_wheels[2, 2] + covariance[2, 2]])
        if self._apart[0] ** 2 > 9 * self._apart[1]:
            self.disagreements += 1
            covariance[2, 2] += (felt - turn) ** 2
        return begin, step, covariance

    def _mean_rate(self, begin: int, end: int) -> float | None:
        """Mean of the rates of a span; None where there are none."""
        within = [rate for stamp, rate in self._rates if begin < stamp <= end]
        self._rates = [(stamp, rate) for stamp, rate in self._rates if stamp > end]
        return sum(within) / len(within) if within else None
