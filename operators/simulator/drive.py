"""Models how the robot's body moves: along its path in the plane, and in six degrees of freedom where it is shaken.

A shake is a smooth random function with analytic derivatives: the bumps of a floor, or the sway of a hand. The body's
pose is the path's pose times the shake's, so that velocities and accelerations follow from both without differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operators.simulator.trajectory import Trajectory

Array = NDArray[np.float64]

_WAVES = 6  # sines that make up one random function


@dataclass(frozen=True, eq=False)
class State:
    """The body at a time; all vectors (3,) in its own frame.

    `acceleration` is that of its origin, without gravity; `angular_acceleration` the derivative of `angular`.
    """

    T_world_base: Array
    linear: Array
    angular: Array
    acceleration: Array
    angular_acceleration: Array

    def velocity_of(self, lever: Array) -> Array:
        """Of a point (3,) fixed to the body, in the world."""
        return np.asarray(self.T_world_base[:3, :3] @ (self.linear + np.cross(self.angular, lever)))


class Shake:
    """Six random functions of one variable: shifts x, y, z (m), then roll, pitch and yaw (rad).

    `deviations` (6,) are their standard deviations, `band` the lowest and the highest frequency (1/s). With `driven`
    the variable is the time that the robot has driven: one that stands is not shaken.
    """

    def __init__(
        self, rng: np.random.Generator, deviations: ArrayLike, band: tuple[float, float], *, driven: bool
    ) -> None:
        self.driven = driven
        self._amplitude = np.asarray(deviations, np.float64)[:, None] * np.sqrt(2 / _WAVES)
        share = (np.arange(_WAVES) + rng.uniform(0, 1, (6, _WAVES))) / _WAVES  # spread over the band, none alike
        self._pulse = 2 * np.pi * band[0] * (band[1] / band[0]) ** share
        self._phase = rng.uniform(0, 2 * np.pi, (6, _WAVES))

    def at(self, u: Array) -> Array:
        """Values and first and second derivatives (3, N, 6) at u (N,)."""
        angle = self._pulse * u[:, None, None] + self._phase
        sine, cosine = self._amplitude * np.sin(angle), self._amplitude * np.cos(angle)
        pulse = self._pulse
        return np.array([wave.sum(axis=2) for wave in (sine, cosine * pulse, -sine * pulse * pulse)])


def bumps(seed: int, height: float) -> Shake:
    """An uneven floor: its height under the robot has a deviation (m), and the robot tilts as a 0.4 m base does."""
    tilt = height / 0.2
    rng = np.random.default_rng([seed, 61])
    return Shake(rng, [0.0, 0.0, height, tilt, tilt, 0.0], (0.8, 4.0), driven=True)


def sway(seed: int, way: float, turn: float) -> Shake:
    """A rig in a walking person's hands: shifted by a deviation `way` (m), turned by one of `turn` (rad)."""
    rng = np.random.default_rng([seed, 62])
    return Shake(rng, [way, way, way, turn, turn, turn], (0.3, 2.0), driven=False)


class Drive:
    """The path in the plane and what shakes the body on it."""

    def __init__(self, path: Trajectory, shakes: Sequence[Shake] = ()) -> None:
        self.path, self._shakes = path, tuple(shakes)

    def poses(self, times: ArrayLike) -> Array:
        """`T_world_base` (N, 4, 4) at times (N,)."""
        t = np.atleast_1d(np.asarray(times, np.float64))
        T = self.path.at(t).T_world_base()
        if not self._shakes:
            return T
        offset = self._offsets(t)[0]
        shaken = np.tile(np.eye(4), (len(t), 1, 1))
        shaken[:, :3, :3] = _rotations(offset[:, 3:])
        shaken[:, :3, 3] = offset[:, :3]
        return np.asarray(T @ shaken)

    def state(self, t: float) -> State:
        """The body at a time."""
        motion = self.path.at([t])
        (d, d1, d2) = self._offsets(np.array([t]))[:, 0]
        R = _rotations(d[None, 3:])[0].T  # from the path's frame to the body's
        omega = np.array([0.0, 0.0, float(motion.yaw_rate[0])])
        alpha = np.array([0.0, 0.0, float(motion.yaw_acceleration[0])])
        c, s = np.cos(motion.yaw[0]), np.sin(motion.yaw[0])
        ax, ay = motion.acceleration[0]
        along = np.array([c * ax + s * ay, -s * ax + c * ay, 0.0])
        shift, shift1, shift2 = d[:3], d1[:3], d2[:3]
        linear = np.array([float(motion.speed()[0]), 0.0, 0.0]) + np.cross(omega, shift) + shift1
        acceleration = (
            along
            + np.cross(alpha, shift)
            + np.cross(omega, np.cross(omega, shift))
            + 2 * np.cross(omega, shift1)
            + shift2
        )
        own, own_change = _body_rates(d[3:], d1[3:], d2[3:])
        carried = R @ omega
        return State(
            self.poses([t])[0],
            R @ linear,
            carried + own,
            R @ acceleration,
            R @ alpha - np.cross(own, carried) + own_change,
        )

    def _offsets(self, t: Array) -> Array:
        """All shakes together, with their derivatives by time: (3, N, 6)."""
        total = np.zeros((3, len(t), 6))
        for shake in self._shakes:
            if shake.driven:
                u, u1, u2 = (part[:, None] for part in self.path.clock(t))
                x, x1, x2 = shake.at(u[:, 0])
                total += np.array([x, x1 * u1, x2 * u1 * u1 + x1 * u2])
            else:
                total += shake.at(t)
        return total


def _rotations(angles: Array) -> Array:
    """(N, 3, 3) of roll, pitch and yaw (N, 3): turned about fixed x, then y, then z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles.T), np.sin(angles.T)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _body_rates(angles: Array, rates: Array, changes: Array) -> tuple[Array, Array]:
    """Angular velocity (3,) and its derivative in the body's frame, of roll, pitch, yaw and their derivatives."""
    (roll, pitch, _), (p, q, r), (p1, q1, r1) = angles, rates, changes
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    omega = np.array([p - r * sp, q * cr + r * cp * sr, -q * sr + r * cp * cr])
    alpha = np.array(
        [
            p1 - r1 * sp - r * q * cp,
            q1 * cr - q * p * sr + r1 * cp * sr - r * q * sp * sr + r * p * cp * cr,
            -q1 * sr - q * p * cr + r1 * cp * cr - r * q * sp * cr - r * p * cp * sr,
        ]
    )
    return omega, alpha
