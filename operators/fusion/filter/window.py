"""The window of late: what was felt from one measurement to the next, and what was measured, to be fitted anew."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.error_state import (
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    Noise,
    State,
    exp_rotation,
    propagated,
)
from operators.fusion.filter.measurements import FullPose, Measurement, Model, Position
from operators.geometry.se3 import skew

Array = NDArray[np.float64]
_KEPT = 20_000_000_000
"""Nanoseconds of the window."""
_MOST = 200
"""Steps of the window."""
_BEFORE = 40
"""Steps before the window, by which an earlier fit is brought to its beginning."""
_APART = 180_000_000
"""Nanoseconds from one measurement of a sensor to its next that counts."""


def places(model: Model) -> bool:
    """Returns whether a measurement is of where the body is, which shows late stamps."""
    return isinstance(model, Position | FullPose)


@dataclass(frozen=True, eq=False)
class Motion:
    """Holds what was felt for a time (s), as the motion of a body that began at rest and weightless.

    Its biases are those that were taken off; `effects` (15, 15): how the motion changes with its beginning.
    """

    seconds: float
    state: State

    @staticmethod
    def begun(gyro_bias: Array, accel_bias: Array) -> Motion:
        at = np.zeros(3), np.zeros(3), np.eye(3), gyro_bias, accel_bias, np.zeros((SIZE, SIZE))
        return Motion(0.0, State(*at, effects=np.eye(SIZE)))

    def after(self, gyro: Array, accel: Array, seconds: float, noise: Noise) -> Motion:
        """Returns this and a short time more with mean readings (rad/s, m/s²)."""
        return Motion(self.seconds + seconds, propagated(self.state, gyro, accel, seconds, noise, np.zeros(3)))

    def moved(self, x: State, gravity: Array) -> tuple[State, Array, Array]:
        """Returns where it brings a state, its transition (15, 15) and covariance (15, 15)."""
        own, T = self.state, self.seconds
        by_bias = own.effects[:, SIZE - 6 :]
        off = by_bias @ np.concatenate([x.gyro_bias - own.gyro_bias, x.accel_bias - own.accel_bias])
        turn = own.rotation @ exp_rotation(off[ROTATION])
        speed, way = own.velocity + off[VELOCITY], own.position + off[POSITION]
        R = x.rotation
        F = np.eye(SIZE)
        F[POSITION, VELOCITY] = T * np.eye(3)
        F[POSITION, ROTATION], F[VELOCITY, ROTATION], F[ROTATION, ROTATION] = -R @ skew(way), -R @ skew(speed), turn.T
        to_world = np.eye(SIZE)
        to_world[POSITION, POSITION] = to_world[VELOCITY, VELOCITY] = R
        F[:9, 9:] = (to_world @ by_bias)[:9]
        there = replace(
            x,
            position=x.position + T * x.velocity + 0.5 * T * T * gravity + R @ way,
            velocity=x.velocity + T * gravity + R @ speed,
            rotation=R @ turn,
        )
        return there, F, to_world @ own.covariance @ to_world.T


@dataclass(frozen=True, eq=False)
class Step:
    """Holds the motion since the step before, the readings at its end, and what was measured there.

    `start`: the filter's estimate there before that; `told`: the filter had only begun, and knew that much.
    """

    time: int
    motion: Motion
    gyro: Array
    accel: Array
    start: State
    told: bool
    measured: tuple[Measurement, ...]


@dataclass(frozen=True, eq=False)
class Window:
    """Holds the steps of late, and the motion since the last; None before the first or where nothing was felt."""

    steps: tuple[Step, ...] = ()
    motion: Motion | None = None
    begins: bool = True

    def felt(self, gyro: Array, accel: Array, seconds: float, noise: Noise) -> Window:
        """Returns the window after a short time with mean readings (rad/s, m/s²)."""
        if self.motion is None:
            return self
        return replace(self, motion=self.motion.after(gyro, accel, seconds, noise))

    def coasted(self, seconds: float, noise: Noise) -> Window:
        """Returns the window after a time in which the body without inertial sensor kept its velocity."""
        if self.motion is None:
            return self
        own = self.motion.state
        return replace(self, motion=self.motion.after(np.zeros(3), own.accel_bias, seconds, noise))

    def broken(self) -> Window:
        """Returns the window after a time in which nothing was felt: it begins anew."""
        return Window(begins=False)

    def measured(self, entry: Measurement, before: State, gyro: Array, accel: Array) -> Window:
        """Returns the window after a measurement that is believed; `before`: the estimate without it."""
        recent = [s for s in self.steps[-20:] if entry.time - s.time < _APART]
        if any(one.sensor == entry.sensor for step in recent for one in step.measured):
            return self
        if not self.steps and not places(entry.model):
            return self
        if self.steps and entry.time == self.steps[-1].time:
            last = self.steps[-1]
            return replace(self, steps=(*self.steps[:-1], replace(last, measured=(*last.measured, entry))))
        still = Motion.begun(before.gyro_bias, before.accel_bias)
        motion = still if self.motion is None else self.motion
        start = State(
            before.position, before.velocity, before.rotation, before.gyro_bias, before.accel_bias,
            before.covariance[:SIZE, :SIZE] if self.begins else np.zeros((0, 0)),
        )  # fmt: skip
        step = Step(entry.time, motion, gyro, accel, start, self.begins, (entry,))
        return Window((*self.steps[1 - _MOST - _BEFORE :], step), still, False)

    @property
    def first(self) -> int:
        """Returns the index of the step that the window begins with: those before it have grown old."""
        if not self.steps:
            return 0
        old = sum(self.steps[-1].time - s.time > _KEPT for s in self.steps)
        return max(old, len(self.steps) - _MOST)
