"""Measurement models of an inertial body: residual and Jacobian of each kind of measurement.

A residual is measurement - prediction, to first order Jacobian @ error. `rate` is the gyroscope's reading of the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.error_state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    State,
    cross,
    log_rotation,
)
from operators.geometry.se3 import skew

Array = NDArray[np.float64]
_I3 = np.eye(3)


@dataclass(frozen=True, eq=False)
class Position:
    """A place (3,) in the world of a point at `lever` (3,) in the body; NaN where an axis is not known."""

    value: Array
    lever: Array

    def innovation(self, state: State, rate: Array) -> tuple[Array, Array]:
        H = np.zeros((3, SIZE))
        H[:, POSITION] = _I3
        H[:, ROTATION] = -state.rotation @ skew(self.lever)
        known = np.isfinite(self.value)
        return (self.value - state.position - state.rotation @ self.lever)[known], H[known]

    def widening(self, residual: Array, seconds: float) -> Array:
        return _wide(residual, (POSITION, 1.0), (VELOCITY, 1.0 / max(seconds, 0.1)))


@dataclass(frozen=True, eq=False)
class Orientation:
    """A rotation (3, 3) of the body in the world."""

    value: Array

    def innovation(self, state: State, rate: Array) -> tuple[Array, Array]:
        residual = log_rotation(state.rotation.T @ self.value)
        H = np.zeros((3, SIZE))
        H[:, ROTATION] = _left_inverse(residual)
        return residual, H

    def widening(self, residual: Array, seconds: float) -> Array:
        return _wide(residual, (ROTATION, 1.0))


@dataclass(frozen=True, eq=False)
class FullPose:
    """Place (3,) and rotation (3, 3) of the body in the world."""

    place: Array
    rotation: Array

    def innovation(self, state: State, rate: Array) -> tuple[Array, Array]:
        first, H = Position(self.place, np.zeros(3)).innovation(state, rate)
        second, J = Orientation(self.rotation).innovation(state, rate)
        return np.concatenate([first, second]), np.vstack([H, J])

    def widening(self, residual: Array, seconds: float) -> Array:
        place = _wide(residual[:3], (POSITION, 1.0), (VELOCITY, 1.0 / max(seconds, 0.1)))
        return place + _wide(residual[3:], (ROTATION, 1.0))


@dataclass(frozen=True, eq=False)
class Velocity:
    """Velocity of a point at `lever` (3,) in the body, along the rows of `axes` (M, 3), directions in the body."""

    value: Array
    axes: Array
    lever: Array

    def innovation(self, state: State, rate: Array) -> tuple[Array, Array]:
        own = state.rotation.T @ state.velocity
        turning = rate - state.gyro_bias
        H = np.zeros((len(self.axes), SIZE))
        H[:, VELOCITY] = self.axes @ state.rotation.T
        H[:, ROTATION] = self.axes @ skew(own)
        H[:, GYRO_BIAS] = self.axes @ skew(self.lever)
        return self.value - self.axes @ (own + cross(turning, self.lever)), H

    def widening(self, residual: Array, seconds: float) -> Array:
        return _wide(residual, (VELOCITY, 1.0))


@dataclass(frozen=True, eq=False)
class AngularRate:
    """Angular velocity along the rows of `axes` (M, 3), directions in the body."""

    value: Array
    axes: Array

    def innovation(self, state: State, rate: Array) -> tuple[Array, Array]:
        H = np.zeros((len(self.axes), SIZE))
        H[:, GYRO_BIAS] = -self.axes
        return self.value - self.axes @ (rate - state.gyro_bias), H

    def widening(self, residual: Array, seconds: float) -> Array:
        return _wide(residual, (GYRO_BIAS, 1.0))


@dataclass(frozen=True, eq=False)
class RestingForce:
    """The accelerometer's reading (3,) of a body at rest; `gravity` (3,) in the world."""

    value: Array
    gravity: Array

    def innovation(self, state: State, rate: Array) -> tuple[Array, Array]:
        expected = -(state.rotation.T @ self.gravity)
        H = np.zeros((3, SIZE))
        H[:, ROTATION] = skew(expected)
        H[:, ACCEL_BIAS] = _I3
        return self.value - expected - state.accel_bias, H

    def widening(self, residual: Array, seconds: float) -> Array:
        return _wide(residual / np.linalg.norm(self.gravity), (ROTATION, 1.0))


@dataclass(frozen=True, eq=False)
class MagneticHeading:
    """The direction of a magnetic field (3,) in the body, of which the world's azimuth (rad, x towards y) is known."""

    field: Array
    azimuth: float

    def innovation(self, state: State, rate: Array) -> tuple[Array, Array]:
        east, north, _ = state.rotation @ self.field
        change = -state.rotation @ skew(self.field)
        H = np.zeros((1, SIZE))
        H[0, ROTATION] = (east * change[1] - north * change[0]) / max(east * east + north * north, 1e-18)
        off = self.azimuth - math.atan2(north, east)
        return np.array([math.atan2(math.sin(off), math.cos(off))]), H

    def widening(self, residual: Array, seconds: float) -> Array:
        return _wide(residual, (ROTATION, 1.0))


@dataclass(frozen=True, eq=False)
class Range:
    """The distance (1,) of a point at `lever` (3,) in the body from a place (3,) in the world."""

    value: Array
    beacon: Array
    lever: Array

    def innovation(self, state: State, rate: Array) -> tuple[Array, Array]:
        away = state.position + state.rotation @ self.lever - self.beacon
        distance = max(float(np.linalg.norm(away)), 1e-9)
        H = np.zeros((1, SIZE))
        H[0, POSITION] = away / distance
        H[0, ROTATION] = -(away / distance) @ state.rotation @ skew(self.lever)
        return self.value - distance, H

    def widening(self, residual: Array, seconds: float) -> Array:
        return _wide(residual, (POSITION, 1.0), (VELOCITY, 1.0 / max(seconds, 0.1)))


Model = Position | Orientation | FullPose | Velocity | AngularRate | RestingForce | MagneticHeading | Range
"""One kind of measurement. `innovation(state, rate)` gives the residual (M,) and its Jacobian (M, 15);
`widening(residual, seconds)` variances (15,) that make room for a residual which arose in a time."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Holds a sensor's measurement of a time (ns), with covariance (M, M).

    `clock`: which of the state's time offsets is the sensor's, -1 for none; `assumed`: seconds taken for it in `time`.
    """

    time: int
    sensor: str
    model: Model
    noise: Array
    clock: int = -1
    assumed: float = 0.0


def _left_inverse(w: Array) -> Array:
    """The inverse of SO(3)'s left Jacobian (3, 3)."""
    angle = float(np.linalg.norm(w))
    W = skew(w)
    d = 1.0 / 12.0 if angle < 1e-4 else (1.0 - angle / (2.0 * math.tan(angle / 2.0))) / angle**2
    return np.asarray(_I3 - 0.5 * W + d * (W @ W))


def _wide(residual: Array, *scales: tuple[slice, float]) -> Array:
    out = np.zeros(SIZE)
    for block, scale in scales:
        out[block] = float(residual @ residual) * scale**2
    return out
