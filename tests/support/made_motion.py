"""A body on a known trajectory, with what an inertial sensor on it measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
GRAVITY = np.array([0.0, 0.0, -9.80665])


@dataclass(frozen=True)
class Motion:
    """Rest for `rest` seconds, then ever faster swings in all directions."""

    rest: float = 0.6
    phase: float = 0.0

    def position(self, t: Array) -> Array:
        s = np.maximum(np.asarray(t, float) - self.rest, 0.0)
        ramp = 1 - np.exp(-(s**2))
        swings = [np.sin(0.9 * s + self.phase), 1.3 * np.sin(0.7 * s), 0.6 * np.sin(1.1 * s)]
        start = np.array([np.sin(self.phase), 0.0, 0.0])
        return np.stack(swings, axis=-1) * ramp[..., None] * 1.5 + start

    def rotation(self, t: Array) -> Rotation:
        s = np.maximum(np.asarray(t, float) - self.rest, 0.0)
        ramp = 1 - np.exp(-(s**2))
        angles = np.stack([0.5 * s + self.phase, 0.4 * np.sin(0.8 * s) * ramp, 0.3 * np.sin(1.2 * s) * ramp], axis=-1)
        angles[..., 0] = self.phase + 0.4 * s * ramp
        return Rotation.from_euler("zyx", angles)

    def velocity(self, t: Array) -> Array:
        h = 1e-4
        return (self.position(t + h) - self.position(t - h)) / (2 * h)

    def readings(self, t: Array) -> tuple[Array, Array]:
        """Angular velocity (N, 3) and specific force (N, 3) in the body at times (N,)."""
        h = 1e-4
        acceleration = (self.position(t + h) - 2 * self.position(t) + self.position(t - h)) / h**2
        rate = (self.rotation(t - h).inv() * self.rotation(t + h)).as_rotvec() / (2 * h)
        return rate, self.rotation(t).inv().apply(acceleration - GRAVITY)
