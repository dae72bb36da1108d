"""A control input in the place of inertial samples: a body whose velocities follow what it was told."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.error_state import GYRO_BIAS, ROTATION, VELOCITY, State
from operators.geometry.se3 import skew

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Command:
    """Velocities that a body was told at a time (ns): linear (3,) in m/s and angular (3,) in rad/s, in its own axes.

    They are followed with the time constant `lag` (s), and hold for `lasts` (ns).
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
