"""The robot's path: a smooth closed curve in the plane, driven within limits of speed and turning rate.

Position and heading have analytic derivatives: the curve is a quintic spline over time (four times continuously
differentiable), its heading is its tangent, as a robot with two driven wheels moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, CubicSpline, make_interp_spline

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motion:
    """The planar state at times (N,): all arrays (N, ...), in the world frame; rates in seconds and radians."""

    position: Array  # (N, 2) m
    velocity: Array  # (N, 2)
    acceleration: Array  # (N, 2)
    yaw: Array  # (N,) continuous: it grows with every round
    yaw_rate: Array
    yaw_acceleration: Array

    def speed(self) -> Array:
        """Forward speed (N,); there is no other: the robot never slips sideways."""
        return np.asarray(np.hypot(self.velocity[:, 0], self.velocity[:, 1]))

    def T_world_base(self) -> Array:
        """(N, 4, 4)."""
        T = np.zeros((len(self.yaw), 4, 4))
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
        T[:, :2, 3] = self.position
        T[:, 2, 2] = T[:, 3, 3] = 1
        return T


class Trajectory:
    """A closed path through waypoints (N, 2), driven again and again.

    The robot stands still for `hold` seconds, then speeds up within `ramp` seconds. `speed` (m/s) is kept on straights
    and lowered in curves so that the turning rate stays within `turn_rate` (rad/s). Each of `jumps` is a time and a
    share of the round by which the robot is carried ahead at that time, in no time: a kidnapping.
    """

    def __init__(
        self,
        waypoints: ArrayLike,
        *,
        speed: float = 0.6,
        turn_rate: float = 0.7,
        hold: float = 0.0,
        ramp: float = 1.5,
        jumps: Sequence[tuple[float, float]] = (),
    ) -> None:
        """Raises ValueError for fewer than four waypoints."""
        points = np.asarray(waypoints, np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 4:
            raise ValueError(f"a closed path needs at least four waypoints (N, 2), got shape {points.shape}")
        self.hold, self.ramp, self._jumps = hold, ramp, tuple(jumps)
        samples, times = _timed(points, speed, turn_rate)
        self.period = float(times[-1])
        knots = np.linspace(0, self.period, max(24, math.ceil(self.period * 4)) + 1)
        resampled = np.stack([np.interp(knots, times, samples[:, k]) for k in (0, 1)], axis=1)
        resampled[-1] = resampled[0]
        self._curve: tuple[BSpline, ...] = tuple(
            make_interp_spline(knots, resampled, k=5, bc_type="periodic").derivative(order) if order
            else make_interp_spline(knots, resampled, k=5, bc_type="periodic")
            for order in range(4)
        )  # fmt: skip
        around = np.linspace(0, self.period, 2001)
        velocity = self._curve[1](around[:-1])
        heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        closing = math.atan2(velocity[0, 1], velocity[0, 0])
        heading = np.append(heading, heading[-1] + wrapped(closing - heading[-1]))
        self._coarse_times, self._coarse_heading = around, heading

    def at(self, times: ArrayLike) -> Motion:
        """The state at `times` (N,) seconds since the start; earlier ones stand still at the first pose."""
        t = np.atleast_1d(np.asarray(times, np.float64))
        tau, d1, d2 = self.clock(t)
        rounds = np.floor(tau / self.period)
        inside = tau - rounds * self.period
        p, v, a, j = (curve(inside) for curve in self._curve)
        square = (v * v).sum(axis=1)
        cross = v[:, 0] * a[:, 1] - v[:, 1] * a[:, 0]
        rate = cross / square
        rate_slope = (v[:, 0] * j[:, 1] - v[:, 1] * j[:, 0]) / square - 2 * rate * (v * a).sum(axis=1) / square
        exact = np.arctan2(v[:, 1], v[:, 0])
        coarse = np.interp(inside, self._coarse_times, self._coarse_heading)
        yaw = exact + 2 * math.pi * np.round((coarse - exact) / (2 * math.pi))
        yaw = yaw + rounds * (self._coarse_heading[-1] - self._coarse_heading[0])
        return Motion(
            p,
            v * d1[:, None],
            a * (d1 * d1)[:, None] + v * d2[:, None],
            yaw,
            rate * d1,
            rate_slope * d1 * d1 + rate * d2,
        )

    def outline(self, count: int = 400) -> Array:
        """(count, 2) points of the whole path."""
        return np.asarray(self._curve[0](np.linspace(0, self.period, count, endpoint=False)))

    def clock(self, t: Array) -> tuple[Array, Array, Array]:
        """Time along the curve (N,) and its two derivatives; it leaps where the robot is carried ahead."""
        tau, d1, d2 = self._phase(t)
        for at, share in self._jumps:
            tau = tau + np.where(t >= at, share * self.period, 0.0)
        return tau, d1, d2

    def _phase(self, t: Array) -> tuple[Array, Array, Array]:
        """The same without being carried: a seventh-order start without a jerk.

        Its slope is the smootherstep 6x⁵ − 15x⁴ + 10x³ of x = (t − hold) / ramp.
        """
        if self.hold == 0:
            tau = np.maximum(t, 0.0)
            moving = np.asarray(t >= 0, np.float64)
            return tau, moving, np.zeros_like(t)
        x = np.clip((t - self.hold) / self.ramp, 0, 1)
        area = x**6 - 3 * x**5 + 2.5 * x**4
        after = np.maximum(t - self.hold - self.ramp, 0)
        slope = 6 * x**5 - 15 * x**4 + 10 * x**3
        curve = (30 * x**4 - 60 * x**3 + 30 * x**2) / self.ramp
        return self.ramp * area + after, slope, curve


def _timed(points: Array, speed: float, turn_rate: float) -> tuple[Array, Array]:
    """Dense samples (M, 2) along a smooth closed curve through the points, and the time of each."""
    closed = np.concatenate([points, points[:1]])
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    spline = CubicSpline(chord, closed, bc_type="periodic")
    u = np.linspace(0, chord[-1], 4000)
    p, d, dd = spline(u), spline(u, 1), spline(u, 2)
    norm = np.linalg.norm(d, axis=1)
    curvature = np.abs(d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / norm**3
    limit = np.minimum(speed, 0.8 * turn_rate / np.maximum(curvature, 1e-6))
    step = np.linalg.norm(np.diff(p, axis=0), axis=1)
    reach = max(1, round(0.4 / float(step.mean())))  # slow down over 0.4 m before a curve
    window = np.arange(-reach, reach + 1)
    around = limit[:-1][(np.arange(len(limit) - 1)[:, None] + window) % (len(limit) - 1)]
    lowest = around.min(axis=1)
    weights = np.hanning(len(window) + 2)[1:-1]
    smooth = (lowest[(np.arange(len(lowest))[:, None] + window) % len(lowest)] * weights).sum(axis=1) / weights.sum()
    times = np.concatenate([[0], np.cumsum(step / smooth)])
    return p, times


def wrapped(angle: float) -> float:
    """Returns an angle within half a turn of 0."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
