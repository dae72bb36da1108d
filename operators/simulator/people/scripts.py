"""Holds what movers are to do: acts one after the other, and the ways along which they do it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from operators.simulator.shapes import Array

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Act:
    """One act of a script. Pairs are values at its beginning and end, between which it moves smoothly.

    `along` metres on the path, `yaw` heading (None: the way it walks), `sit` 0 upright to 1 seated, `reach` how far the
    hand has gone towards the object, `lift` how far the held object is on its way to the mouth. `seat` is where the
    pelvis is when seated, `grasp` where the hand grips the object.
    """

    activity: str
    seconds: float
    goal: str
    along: tuple[float, float] = (0.0, 0.0)
    yaw: tuple[float, float] | None = None
    sit: tuple[float, float] = (0.0, 0.0)
    reach: tuple[float, float] = (0.0, 0.0)
    lift: tuple[float, float] = (0.0, 0.0)
    object: int = -1
    seat: Point | None = None
    grasp: Point | None = None


class Timeline:
    """Acts one after the other, again and again, from a phase on."""

    def __init__(self, acts: Sequence[Act], phase: float = 0.0) -> None:
        self.acts, self.phase = tuple(acts), phase
        self._starts = np.concatenate([[0], np.cumsum([act.seconds for act in acts])]).tolist()
        self.period: float = self._starts[-1]

    def with_place(self, seat: Point, grasp: Point) -> Timeline:
        """The same script at one seat, with one place to grip."""
        return Timeline([replace(act, seat=seat, grasp=grasp) for act in self.acts], self.phase)

    def at(self, t: float) -> tuple[Act, float, float]:
        """The act at a time, how far it is (0 to 1, smoothly: C2), and when it began."""
        u = (t + self.phase) % self.period
        k = min(bisect_right(self._starts, u) - 1, len(self.acts) - 1)
        x = (u - self._starts[k]) / self.acts[k].seconds
        return self.acts[k], x * x * x * (10 + x * (6 * x - 15)), t - (u - self._starts[k])


class Polyline:
    """A smooth path (N, 2) by its length; a single point stands still."""

    def __init__(self, points: Array) -> None:
        self._points = np.asarray(points, np.float64)
        step = np.linalg.norm(np.diff(self._points, axis=0), axis=1)
        chord = np.concatenate([[0], np.cumsum(step)])
        self._spline = CubicSpline(chord, self._points) if len(chord) > 1 else None
        if self._spline is None:
            self._run, self._at, self.length = np.zeros(1), np.zeros(1), 0.0
            return
        fine = np.linspace(0, chord[-1], 400)
        walked = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self._spline(fine), axis=0), axis=1))])
        self._run, self._at, self.length = walked, fine, float(walked[-1])

    def line(self) -> Array:
        """Points (N, 2) along the path."""
        return self._points if self._spline is None else np.asarray(self._spline(self._at))

    def at(self, along: float) -> tuple[Array, float]:
        """Place (2,) and heading."""
        if self._spline is None:
            return self._points[0], 0.0
        u = float(np.interp(along, self._run, self._at))
        d = self._spline(u, 1)
        return np.asarray(self._spline(u)), math.atan2(float(d[1]), float(d[0]))


def errand(path: Array, sit_yaw: float, mug: int, table: int, *, phase: float) -> Timeline:
    """Walks to a chair at the end of the path, sits down, drinks from a mug, gets up, and walks back."""
    line, leave, arrive, stroll = _there_and_back(path, 0.62)
    full, none = (line.length, line.length), (0.0, 0.0)
    go, drink, back = f"sit down at table {table}", f"drink from mug {mug}", "walk away"
    return Timeline(
        [
            Act("standing", 2.0, go, none, (leave + math.pi, leave)),
            Act("walking", stroll, go, (0.0, line.length)),
            Act("standing", 0.9, go, full, (arrive, sit_yaw)),
            Act("sitting_down", 1.7, go, full, (sit_yaw, sit_yaw), sit=(0.0, 1.0)),
            *_sipping(full, sit_yaw, mug, drink),
            Act("standing_up", 1.6, back, full, (sit_yaw, sit_yaw), sit=(1.0, 0.0)),
            Act("standing", 0.9, back, full, (sit_yaw, arrive + math.pi)),
            Act("walking", stroll, back, (line.length, 0.0)),
        ],
        phase,
    )


def coffee_break(yaw: float, mug: int, *, phase: float) -> Timeline:
    """Sits all the time and drinks now and then."""
    goal = f"drink from mug {mug}"
    rest = Act("sitting", 3.0, "rest", (0.0, 0.0), (yaw, yaw), sit=(1.0, 1.0))
    return Timeline([rest, *_sipping((0.0, 0.0), yaw, mug, goal)], phase)


def drinking(acting: Act, drink: int) -> list[Act]:
    """The acts of drinking from a thing, by one who otherwise does as in `acting`."""
    return [
        replace(acting, activity=name, seconds=seconds, reach=reach, lift=lift, object=drink)
        for name, seconds, reach, lift in (
            ("reaching", 1.2, (0.0, 1.0), (0.0, 0.0)),
            ("drinking", 1.3, (1.0, 1.0), (0.0, 1.0)),
            ("drinking", 1.0, (1.0, 1.0), (1.0, 1.0)),
            ("drinking", 1.3, (1.0, 1.0), (1.0, 0.0)),
            ("reaching", 1.0, (1.0, 0.0), (0.0, 0.0)),
        )
    ]


def _sipping(along: tuple[float, float], yaw: float, mug: int, goal: str) -> list[Act]:
    """The same, seated before and after."""
    seated = Act("sitting", 1.6, goal, along, (yaw, yaw), (1.0, 1.0))
    return [seated, *drinking(seated, mug), replace(seated, seconds=1.4)]


def pacing(path: Array, *, walk: float, phase: float) -> Timeline:
    """Walks to the end of the path, stands there, and comes back."""
    line, leave, arrive, stroll = _there_and_back(path, walk)
    return Timeline(
        [
            Act("standing", 2.5, "wait", (0.0, 0.0), (leave + math.pi, leave)),
            Act("walking", stroll, "walk to and fro", (0.0, line.length)),
            Act("standing", 2.5, "wait", (line.length, line.length), (arrive, arrive + math.pi)),
            Act("walking", stroll, "walk to and fro", (line.length, 0.0)),
        ],
        phase,
    )


def _there_and_back(path: Array, walk: float) -> tuple[Polyline, float, float, float]:
    """The path, its headings at the beginning and the end, and the seconds that it takes at a speed (m/s)."""
    line = Polyline(path)
    return line, line.at(0.0)[1], line.at(line.length)[1], max(1.5, line.length / walk)


def mix(ends: tuple[float, float], x: float) -> float:
    return ends[0] + x * (ends[1] - ends[0])
