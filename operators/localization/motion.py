"""Motion of a robot in the plane: steps (x, y, turn) in its own frame, their noise, and samples of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.estimation.particles import wrapped

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DriveNoise:
    """Holds what the steps of a differential drive are worth: standard deviations for every √m of way and √rad of turn.

    `forward`, `side`: m/√m; `turn`: rad/√m; `spin`: √rad; `gyro`: rad/s of a gyroscope's rate, where it gives the
    turn; `jitter` (m, rad): of every second, so that samples never fall together.
    """

    forward: float = 0.05
    side: float = 0.02
    turn: float = 0.05
    spin: float = 0.05
    gyro: float = 0.01
    jitter: tuple[float, float] = (0.01, 0.005)

    def covariance(self, step: Array, seconds: float, *, by_gyro: bool) -> Array:
        """Returns the covariance (3, 3) of a step (x, y, turn) that took a time."""
        way, turned = math.hypot(step[0], step[1]), abs(float(step[2]))
        if by_gyro:
            heading = (self.gyro * seconds) ** 2
        else:
            heading = self.turn**2 * way + self.spin**2 * turned
        place = self.jitter[0] ** 2 * seconds
        return np.diag(
            [self.forward**2 * way + place, self.side**2 * way + place, heading + self.jitter[1] ** 2 * seconds]
        )


def moved(poses: Array, step: Array, covariance: Array, rng: np.random.Generator) -> Array:
    """Returns poses (N, 3) after a step (3,) in their own frames, each with independent noise."""
    steps = step + rng.standard_normal((len(poses), 3)) @ np.linalg.cholesky(covariance + 1e-12 * np.eye(3)).T
    return composed(poses, steps)


def composed(poses: Array, steps: Array) -> Array:
    """Returns poses (N, 3) after steps (N, 3) or (3,)."""
    steps = np.broadcast_to(steps, poses.shape)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = steps[:, 0], steps[:, 1]
    return np.column_stack(
        [poses[:, 0] + c * x - s * y, poses[:, 1] + s * x + c * y, wrapped(poses[:, 2] + steps[:, 2])]
    )
