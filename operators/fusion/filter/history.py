"""Input of the filter and its record: samples, commands, measurements, and the estimate after each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.error_state import GYRO_BIAS, ROTATION, VELOCITY, Noise, State
from operators.fusion.filter.gate import Health
from operators.fusion.filter.measurements import Measurement
from operators.fusion.filter.window import Window
from operators.geometry.se3 import skew

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sample:
    """Readings of the inertial sensor: time (ns), rad/s (3,), m/s² (3,), and their noise."""

    time: int
    gyro: Array
    accel: Array
    noise: Noise


@dataclass(frozen=True, eq=False)
class Command:
    """A control input in the place of inertial samples: velocities that were commanded at a time (ns).

    They are linear (3,) in m/s and angular (3,) in rad/s, in its own axes, are followed with the time constant `lag`
    (s), and hold for `lasts` (ns).
    """

    time: int
    linear: Array
    angular: Array
    lag: float
    lasts: int = 1_000_000_000

    def drive(self, state: State, before: Array, time: int, seconds: float) -> State:
        """Draws the velocities of a state without inertial sensor towards the command, for a short time until `time`.

        The velocity turns with the body, whose rotation (3, 3) was `before`; its angular velocity is -gyro_bias.
        """
        if time - self.time > self.lasts:
            return state
        share = 1.0 - math.exp(-seconds / self.lag)
        F = np.eye(len(state.covariance))
        turned = state.rotation @ before.T
        F[VELOCITY, VELOCITY] = (1.0 - share) * turned
        F[VELOCITY, ROTATION] = -share * state.rotation @ skew(self.linear)
        F[GYRO_BIAS, GYRO_BIAS] *= 1.0 - share
        return replace(
            state,
            velocity=(1.0 - share) * turned @ state.velocity + share * state.rotation @ self.linear,
            gyro_bias=(1.0 - share) * state.gyro_bias - share * self.angular,
            covariance=F @ state.covariance @ F.T,
        )


@dataclass(frozen=True, eq=False)
class Restart:
    """Holds an estimate of a time (ns) that takes the place of the one that measurements made."""

    time: int
    state: State


Entry = Sample | Measurement | Command | Restart


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One of several estimates, with the logarithm of its weight.

    `against`: the given first heading, against which it is followed for a time in motion.
    """

    weight: float
    state: State
    against: bool = False


@dataclass(frozen=True, eq=False)
class Node:
    """The estimate after an entry: its time (ns), the readings of that time, and what became of each sensor.

    `refuted`: measurements contradict the given first heading; `doubted`: it may be wrong; `moving`:
    nanoseconds in motion so far; `window`: what was felt and measured of late.
    """

    time: int
    hypotheses: tuple[Hypothesis, ...]
    gyro: Array
    accel: Array
    health: Mapping[str, Health] = field(default_factory=dict)
    command: Command | None = None
    refuted: bool = False
    doubted: bool = False
    moving: int = 0
    window: Window = field(default_factory=Window)
