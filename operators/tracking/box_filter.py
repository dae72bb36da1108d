"""A Kalman filter of one image box: centre and size, each with its rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BoxNoise:
    """Noise of boxes and their motion, as shares of the box's height.

    `position` and `size` are standard deviations of a box with score 1, `weak` is how much larger they are at score 0;
    `acceleration` and `growth` those of the white acceleration of centre and size, per s².
    """

    position: float = 0.03
    size: float = 0.05
    weak: float = 1.0
    acceleration: float = 4.0
    growth: float = 0.4


class BoxFilter:
    """Follows (centre x, centre y, width, height) at constant velocity; the four are independent of each other.

    Noise grows with the box's height, as in Wojke et al., "Simple online and realtime tracking with a deep association
    metric", 2017, and with the weakness of the score, as in Du et al., "GIAOTracker", 2021.
    """

    def __init__(self, box: Array, score: float, noise: BoxNoise) -> None:
        self._noise = noise
        self.mean = np.zeros((4, 2))
        self.mean[:, 0] = _middle(box)
        height = self.mean[3, 0]
        self.covariance = np.zeros((4, 2, 2))
        self.covariance[:, 0, 0] = self._measured(score) * height**2
        self.covariance[:, 1, 1] = (np.array([1.0, 1.0, 0.3, 0.3]) * height) ** 2

    def predict(self, seconds: float) -> None:
        """Moves on by a time; sizes stay above one pixel."""
        F = np.array([[1.0, seconds], [0.0, 1.0]])
        steps = np.array([[seconds**4 / 4, seconds**3 / 2], [seconds**3 / 2, seconds**2]])
        n, height = self._noise, self.mean[3, 0]
        spread = (np.array([n.acceleration, n.acceleration, n.growth, n.growth]) * height) ** 2
        self.mean = self.mean @ F.T
        self.covariance = F @ self.covariance @ F.T + spread[:, None, None] * steps
        self.mean[2:, 0] = np.maximum(self.mean[2:, 0], 1.0)

    def hold_size(self) -> None:
        """Stops growing and shrinking: what is not seen is taken to keep its size."""
        self.mean[2:, 1] = 0.0

    def update(self, box: Array, score: float) -> None:
        """Takes a measured box (x1, y1, x2, y2)."""
        R = self._measured(score) * self.mean[3, 0] ** 2
        S = self.covariance[:, 0, 0] + R
        K = self.covariance[:, :, 0] / S[:, None]
        self.mean = self.mean + K * (_middle(box) - self.mean[:, 0])[:, None]
        self.covariance = self.covariance - K[:, :, None] * self.covariance[:, None, 0, :]
        self.mean[2:, 0] = np.maximum(self.mean[2:, 0], 1.0)

    @property
    def box(self) -> Array:
        """The box (4,) as (x1, y1, x2, y2)."""
        middle, size = self.mean[:2, 0], self.mean[2:, 0]
        return np.concatenate([middle - size / 2, middle + size / 2])

    def snapshot(self) -> dict[str, Any]:
        return {"mean": self.mean, "covariance": self.covariance}

    def restore(self, state: dict[str, Any]) -> None:
        self.mean, self.covariance = np.array(state["mean"]), np.array(state["covariance"])

    def _measured(self, score: float) -> Array:
        n = self._noise
        spread = np.array([n.position, n.position, n.size, n.size]) * (1 + n.weak * (1 - score))
        return np.asarray(spread**2)


def _middle(box: Array) -> Array:
    return np.array([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2, box[2] - box[0], box[3] - box[1]])
