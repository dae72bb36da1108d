"""A Kalman filter of one image box: centre and size, each with its rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered

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


class BoxFilter(Remembered):
    """Follows (centre x, centre y, width, height) at constant velocity; the four are independent of each other.

    Noise grows with the box's height, as in Wojke et al., "Simple online and realtime tracking with a deep association
    metric", 2017, and with the weakness of the score, as in Du et al., "GIAOTracker", 2021.
    """

    mean: Array
    covariance: Array

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
        predict([self], self._noise, seconds)

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
        box: Array = boxes_of([self])[0]
        return box

    def _measured(self, score: float) -> Array:
        n = self._noise
        spread = np.array([n.position, n.position, n.size, n.size]) * (1 + n.weak * (1 - score))
        return np.asarray(spread**2)


class FilterpyBoxFilter(BoxFilter):
    """The same filter run by filterpy: equal to rounding, at several times the time."""

    def predict(self, seconds: float) -> None:
        """Moves on by a time; sizes stay above one pixel."""
        F, steps = _motion(seconds)
        spread = _accelerations(self._noise, self.mean[3, 0])
        for i in range(4):
            moved = kalman().predict(self.mean[i], self.covariance[i], F, spread[i] * steps)
            self.mean[i], self.covariance[i] = moved
        self.mean[2:, 0] = np.maximum(self.mean[2:, 0], 1.0)

    def update(self, box: Array, score: float) -> None:
        """Takes a measured box (x1, y1, x2, y2)."""
        R = self._measured(score) * self.mean[3, 0] ** 2
        for i, measured in enumerate(_middle(box)):
            seen = kalman().update(self.mean[i], self.covariance[i], measured, R[i : i + 1, None], np.eye(1, 2))
            self.mean[i], self.covariance[i] = seen
        self.mean[2:, 0] = np.maximum(self.mean[2:, 0], 1.0)


@cache
def kalman() -> ModuleType:
    """Returns `filterpy.kalman`, imported at the first call, since it loads much of scipy."""
    return import_module("filterpy.kalman")


def predict(filters: Sequence[BoxFilter], noise: BoxNoise, seconds: float) -> None:
    """Moves filters of one noise on by a time; all at once but where filterpy runs them. Sizes stay above one pixel."""
    if not filters:
        return
    if isinstance(filters[0], FilterpyBoxFilter):
        for filter in filters:
            filter.predict(seconds)
        return
    F, steps = _motion(seconds)
    means, covariances = np.stack([f.mean for f in filters]), np.stack([f.covariance for f in filters])
    spread = _accelerations(noise, means[:, 3, 0, None])
    means = means @ F.T
    means[:, 2:, 0] = np.maximum(means[:, 2:, 0], 1.0)
    covariances = F @ covariances @ F.T + spread[..., None, None] * steps
    for filter, mean, covariance in zip(filters, means, covariances, strict=True):
        filter.mean, filter.covariance = mean, covariance


def boxes_of(filters: Sequence[BoxFilter]) -> Array:
    """Returns the boxes (N, 4) of filters as (x1, y1, x2, y2)."""
    means = np.array([f.mean[:, 0] for f in filters]).reshape(-1, 4)
    middle, half = means[:, :2], means[:, 2:] / 2
    return np.concatenate([middle - half, middle + half], axis=1)


def _motion(seconds: float) -> tuple[Array, Array]:
    """Returns the transition (2, 2) of a value and its rate, and the noise (2, 2) of unit white acceleration."""
    step = np.array([seconds**2 / 2, seconds])
    return np.array([[1.0, seconds], [0.0, 1.0]]), np.outer(step, step)


def _accelerations(noise: BoxNoise, heights: Array | float) -> Array:
    """Returns the variances (..., 4) of the accelerations for boxes of these heights (..., 1), in pixels²/s⁴."""
    return np.asarray((np.array([noise.acceleration, noise.acceleration, noise.growth, noise.growth]) * heights) ** 2)


def _middle(box: Array) -> Array:
    left, upper, right, lower = box.tolist()
    return np.array([(left + right) / 2, (upper + lower) / 2, right - left, lower - upper])
