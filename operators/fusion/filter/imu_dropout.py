"""Samples while the inertial sensor is silent: the turning that others see, and no acceleration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.fusion.filter.error_state import Noise, State
from operators.fusion.filter.history import Sample

Array = NDArray[np.float64]
_SEEN = 300_000_000  # ns for which a turning that was seen goes on
_TURNING = 0.05  # rad/s/√Hz: density of the noise of a turning that another sensor sees


class ImuDropout(Remembered):
    """Makes samples in the inertial sensor's place once it has given none for `patience` (s)."""

    bridged: int
    _felt: int
    _seen: int
    _turning: Array

    def __init__(self, patience: float, gravity: float, unknown: Noise) -> None:
        self._patience = round(patience * 1e9)
        self._up = np.array([0.0, 0.0, gravity])
        self._unknown = unknown
        self._felt, self._seen, self._turning, self.bridged = -1, -1, np.zeros(3), 0

    def felt(self, time: int) -> None:
        """Takes note that the inertial sensor gave a sample."""
        self._felt = time

    def saw(self, time: int, turning: Array) -> None:
        """Takes note of a turning (3,), rad/s, that another sensor saw."""
        if np.isfinite(turning).all():
            self._seen, self._turning = time, turning

    def lasts(self, time: int) -> bool:
        """Returns whether the inertial sensor has been silent for too long."""
        return self._felt >= 0 and time - self._felt > self._patience

    def sample(self, time: int, state: State) -> Sample:
        """Returns what the sensor would read if the body kept its velocity and turned as others see it."""
        self.bridged += 1
        seen = self._seen >= 0 and time - self._seen <= _SEEN
        turning = self._turning if seen else np.zeros(3)
        noise = self._unknown
        if seen:
            noise = Noise(_TURNING, noise.accel, noise.gyro_walk, noise.accel_walk)
        return Sample(time, turning + state.gyro_bias, state.rotation.T @ self._up + state.accel_bias, noise)
