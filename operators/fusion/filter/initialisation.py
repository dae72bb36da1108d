"""The first estimate of an inertial body: level by gravity, gyroscope bias by rest, heading as far as it is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operators.fusion.filter.error_state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    Noise,
    State,
    updated,
)
from operators.fusion.filter.history import Hypothesis, Node, Sample
from operators.fusion.filter.measurements import AngularRate, RestingForce
from operators.geometry.se3 import skew

Array = NDArray[np.float64]
COASTING = (1.0, 1e-3)
"""Standard deviations of the first biases (rad/s, m/s²) of a body without inertial sensor."""
TILT = 0.1
"""Standard deviation of the first level, rad."""
_MISTOLD = -7.0
"""Logarithm of the weight of a heading other than the one told."""


@dataclass(frozen=True)
class Prior:
    """Holds what is known before anything is measured.

    `position` and `heading` (rad), with standard deviations; without a heading, every one is as likely. Standard
    deviations of the biases; limits on the readings' standard deviations below which the body rests; the standard
    deviations of velocity (m/s) and of the mean acceleration (m/s²) of one that does not.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position_sigma: float = 1000.0
    heading: float | None = None
    heading_sigma: float = 0.1
    gyro_bias: float = 0.02
    accel_bias: float = 0.2
    rest_gyro: float = 0.02
    rest_accel: float = 0.3
    moving_velocity: float = 1.0
    moving_accel: float = 0.5
    headings: int = 12

    def unfelt(self, gravity: float) -> float:
        """Returns the standard deviation (m/s²) of what an inertial sensor known so little may fail to feel."""
        return math.hypot(self.accel_bias, gravity * TILT)


def prior_of(
    at_origin: bool, heading: float | None, heading_sigma: float, gyro_bias: float, accel_bias: float
) -> Prior:
    """Returns what parameters say is known; `at_origin`: the first pose is the world's frame but for the heading."""
    prior = Prior(heading=heading, heading_sigma=heading_sigma, gyro_bias=gyro_bias, accel_bias=accel_bias)
    if at_origin:
        return replace(prior, position_sigma=1e-3, heading=heading or 0.0, heading_sigma=1e-3, headings=1)
    return prior


def rests(samples: Sequence[Sample], prior: Prior) -> bool:
    """Returns whether the readings are those of a body at rest: steady, and of about the strength of gravity."""
    gyro, accel = np.array([s.gyro for s in samples]), np.array([s.accel for s in samples])
    steady = float(gyro.std(axis=0).max()) < prior.rest_gyro and float(accel.std(axis=0).max()) < prior.rest_accel
    mean = float(np.linalg.norm(gyro.mean(axis=0)))
    return steady and mean < 5 * prior.gyro_bias and abs(float(np.linalg.norm(accel.mean(axis=0))) - 9.81) < 0.5


def first_node(
    samples: Sequence[Sample], prior: Prior, gravity: float, *, at_rest: bool, T_body_base: Array | None = None
) -> Node:
    """Returns the estimate at the last of the samples, with one hypothesis for each heading in question.

    `T_body_base` (4, 4): the frame to which the prior's position and heading refer; None for the body itself.
    """
    base = np.eye(4) if T_body_base is None else T_body_base
    gyro = np.mean([s.gyro for s in samples], axis=0)
    accel = np.mean([s.accel for s in samples], axis=0)
    count = len(samples)
    up = accel / np.linalg.norm(accel)
    level = _levelling(up)
    forward = level @ base[:3, 0]
    level = _turn(-math.atan2(forward[1], forward[0])) @ level  # now the base heads along x
    known = prior.heading is not None
    centre = prior.heading if prior.heading is not None else 0.0
    around = [centre + 2 * math.pi * k / prior.headings for k in range(prior.headings)]
    even = math.pi / prior.headings
    last = samples[-1]
    headings = [(heading, even, 0.0, False) for heading in around]
    if known:  # it may be wrong: the others are followed for a while too
        headings = [(centre, prior.heading_sigma, 0.0, False)]
        if prior.heading_sigma < even:
            headings += [(heading, even, _MISTOLD, True) for heading in around[1:]]
    period = (samples[-1].time - samples[0].time) * 1e-9 / max(count - 1, 1)
    noise = samples[-1].noise
    down = np.array([0.0, 0.0, -gravity])
    made = []
    for heading, spread, weight, against in headings:
        R = _turn(heading) @ level
        P = np.zeros((SIZE, SIZE))
        P[POSITION, POSITION] = np.eye(3) * prior.position_sigma**2
        P[VELOCITY, VELOCITY] = np.eye(3) * (0.01 if at_rest else prior.moving_velocity) ** 2
        tilt = np.eye(3) - np.outer(R[2], R[2])  # in the body: the tilt, observed by gravity, and the heading about it
        P[ROTATION, ROTATION] = tilt * TILT**2 + np.outer(R[2], R[2]) * spread**2
        P[GYRO_BIAS, GYRO_BIAS] = np.eye(3) * prior.gyro_bias**2
        P[ACCEL_BIAS, ACCEL_BIAS] = np.eye(3) * prior.accel_bias**2
        state = State(np.array(prior.position) - R @ base[:3, 3], np.zeros(3), R, np.zeros(3), np.zeros(3), P)
        force = RestingForce(accel, down)
        sigma2 = noise.accel**2 / period / count if at_rest else prior.moving_accel**2
        state = updated(state, *force.innovation(state, gyro), np.eye(3) * sigma2)
        if at_rest:
            rate = AngularRate(np.zeros(3), np.eye(3))
            sigma2 = noise.gyro**2 / period / count + 1e-8
            state = updated(state, *rate.innovation(state, gyro), np.eye(3) * sigma2)
        made.append(Hypothesis(weight, state, against))
    return Node(last.time, tuple(made), last.gyro, last.accel)


def coasting_node(stamp: int, prior: Prior, gravity: float) -> Node:
    """Returns the estimate of a body without inertial sensor: level, with the heading known or not, at any velocity."""
    up = np.array([0.0, 0.0, gravity])
    quiet = Noise(1e-3, 1e-3, 0.0, 0.0)
    samples = [Sample(stamp - 1, np.zeros(3), up, quiet), Sample(stamp, np.zeros(3), up, quiet)]
    if prior.heading is None:
        prior = replace(prior, heading=0.0, heading_sigma=math.pi)
    gyro_bias, accel_bias = COASTING
    prior = replace(prior, gyro_bias=gyro_bias, accel_bias=accel_bias, moving_velocity=10.0, moving_accel=1.0)
    return first_node(samples, prior, gravity, at_rest=False)


def _levelling(up: Array) -> Array:
    """The rotation (3, 3) that brings a direction to z by the shortest way, or about x where it points down."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    if up[2] < -0.999999:
        return np.diag([1.0, -1.0, -1.0])
    W = skew(axis)
    return np.asarray(np.eye(3) + W + W @ W / (1.0 + up[2]))


def _turn(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
