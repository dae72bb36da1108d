"""Errors of sensors that last, which the filter estimates beside its state: time offsets, drifting places, scales.

An error that outlasts a measurement is no white noise: taken for that, it averages out in the covariance and stays in
the estimate. Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation", 2001, 8.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.error_state import SIZE, GaussMarkovProcess, State
from operators.fusion.filter.measurements import FullPose, Model, Position, Velocity

Array = NDArray[np.float64]
_CLOCK_WALK = 1e-4
"""Random walk of a sensor's time offset, s/√s."""


@dataclass(frozen=True)
class SensorErrors:
    """Holds the errors that are states, by sensor, in the order of the state's `errors`.

    `clocks`: standard deviation of the first time offset, s; `drifts`: standard deviations of what is added to a
    position (east, north, up, m) and the time in which that changes, s; `scales`: that of the share by which a forward
    speed is too large, which stays.
    """

    clocks: tuple[tuple[str, float], ...] = ()
    drifts: tuple[tuple[str, tuple[float, float, float], float], ...] = ()
    scales: tuple[tuple[str, float], ...] = ()

    @property
    def sigmas(self) -> list[float]:
        """Standard deviations (K,) at first."""
        moved = [sigma for _, sigmas, _ in self.drifts for sigma in sigmas]
        return [*(sigma for _, sigma in self.clocks), *moved, *(sigma for _, sigma in self.scales)]

    @property
    def wander(self) -> GaussMarkovProcess:
        """Returns how they change."""
        decay = [0.0] * len(self.clocks)
        noise = [_CLOCK_WALK] * len(self.clocks)
        for _, sigmas, seconds in self.drifts:
            decay += [1.0 / seconds] * 3
            noise += [sigma * math.sqrt(2.0 / seconds) for sigma in sigmas]
        return GaussMarkovProcess(
            np.array(decay + [0.0] * len(self.scales)), np.array(noise + [0.0] * len(self.scales))
        )

    def taken_off(self, sensor: str, model: Model, state: State, residual: Array, J: Array) -> Array:
        """Returns the residual (M,) without the drift or scale that a sensor is believed to have.

        What these do to it is written into its Jacobian J (M, 15 + K).
        """
        first = len(self.clocks)
        for name, _, _ in self.drifts:
            if name == sensor and isinstance(model, Position | FullPose):
                known = np.isfinite(model.value) if isinstance(model, Position) else np.ones(3, np.bool_)
                rows = np.flatnonzero(known)
                here = np.arange(len(rows))
                J[here, SIZE + first + rows] = 1.0
                residual = residual.copy()
                residual[here] -= state.errors[first + rows]
            first += 3
        for name, _ in self.scales:
            if name == sensor and isinstance(model, Velocity):
                J[:, SIZE + first] = model.value
                residual = residual - model.value * state.errors[first]
            first += 1
        return residual
