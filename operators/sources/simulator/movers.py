"""Those that move: persons that follow a script, balls that roll to and fro, robots that drive a loop.

Everything repeats with a period, is smooth, and depends on time alone.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from operators.sources.simulator.body import Body, Posture
from operators.sources.simulator.scene import Doing
from operators.sources.simulator.shapes import Array, pose
from operators.sources.simulator.trajectory import Trajectory

_STRIDE = 1.25  # metres a full step, left and right


@dataclass(frozen=True)
class Act:
    """One act of a script. Pairs are values at its beginning and end, between which it moves smoothly.

    `along` metres on the path, `yaw` heading (None: the way it walks), `sit` 0 upright to 1 seated, `reach` how far the
    hand has gone towards the object, `lift` how far the held object is on its way to the mouth.
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


class Timeline:
    """Acts one after the other, again and again, from a phase on."""

    def __init__(self, acts: Sequence[Act], phase: float = 0.0) -> None:
        self.acts, self.phase = tuple(acts), phase
        self._starts = np.concatenate([[0], np.cumsum([act.seconds for act in acts])]).tolist()
        self.period: float = self._starts[-1]

    def at(self, t: float) -> tuple[Act, float, float]:
        """The act at a time, how far it is (0 to 1, smoothly: C2), and when it began."""
        u = (t + self.phase) % self.period
        k = min(bisect_right(self._starts, u) - 1, len(self.acts) - 1)
        x = (u - self._starts[k]) / self.acts[k].seconds
        return self.acts[k], x * x * x * (10 + x * (6 * x - 15)), t - (u - self._starts[k])


@dataclass(frozen=True, eq=False)
class Seat:
    """Where a person sits: the place (3,) of the pelvis."""

    pelvis: Array


class Person:
    """A person who follows a script along a path; `seat` and `object` (the place to grip it) where the script has them.

    `hand` is the one that reaches: 0 left, 1 right.
    """

    def __init__(
        self,
        body: Body,
        path: Array,
        timeline: Timeline,
        *,
        seat: Seat | None = None,
        grasp: Array | None = None,
        hand: int = 1,
    ) -> None:
        self.body, self.timeline = body, timeline
        self._seat, self._grasp, self._hand = seat, grasp, hand
        self._path = Polyline(path)
        self._known: tuple[float, Posture] | None = None
        self._parts: tuple[float, Array] | None = None

    def frame(self, t: float) -> Array:
        posture = self.posture(t)
        return pose(float(posture.pelvis[0]), float(posture.pelvis[1]), 0.0, posture.yaw)

    def parts(self, t: float) -> Array:
        if self._parts is None or self._parts[0] != t:
            self._parts = (t, self.body.poses(self.posture(t)))
        return self._parts[1]

    def held(self, t: float) -> bool:
        """Whether the hand has the object."""
        return self.timeline.at(t)[0].activity == "drinking"

    def seated(self, t: float) -> bool:
        """Whether the seat carries the person."""
        act, _, _ = self.timeline.at(t)
        return act.sit == (1.0, 1.0)

    def grip(self, t: float) -> Array:
        """Where the reaching hand is."""
        return self.body.grip(self.posture(t), self._hand)

    def posture(self, t: float) -> Posture:
        if self._known is None or self._known[0] != t:
            self._known = (t, self._posture(t))
        return self._known[1]

    def _posture(self, t: float) -> Posture:
        act, x, began = self.timeline.at(t)
        along = _mix(act.along, x)
        place, heading = self._path.at(along)
        forwards = act.along[1] >= act.along[0]
        if act.yaw is None:
            yaw = heading if forwards else heading + math.pi
        else:
            yaw = act.yaw[0] + x * _wrap(act.yaw[1] - act.yaw[0])
        sit = _mix(act.sit, x)
        pelvis = np.array([*place, self.body.hip_height])
        forward, left = np.array([math.cos(yaw), math.sin(yaw), 0]), np.array([-math.sin(yaw), math.cos(yaw), 0])
        middle = np.array([*place, 0.0])
        if self._seat is not None and sit > 0:
            back = sit * sit * (3 - 2 * sit)
            pelvis[:2] += back * (self._seat.pelvis[:2] - pelvis[:2])
            pelvis[2] += sit * (self._seat.pelvis[2] - pelvis[2])
            middle = middle + 0.06 * sit * forward
        speed = abs(act.along[1] - act.along[0]) / act.seconds * 30 * _bell(self._share(t, act, began))
        feet, swing, drop = self._gait(middle, along, yaw, min(1.0, speed / 0.5), forwards)
        pelvis[2] -= drop
        changing = act.sit[0] != act.sit[1]
        reach = _mix(act.reach, x)
        lean = 0.04 + (0.55 * math.sin(math.pi * sit) if changing else 0.0) + 0.22 * reach * (1 - _mix(act.lift, x))
        hands = self._hands(pelvis, forward, left, sit, swing, yaw, lean)
        if self._grasp is not None and (reach > 0 or _mix(act.lift, x) > 0):
            posture = Posture(pelvis, yaw, lean, feet, hands)
            goal = self._grasp + _mix(act.lift, x) * (self.body.mouth(posture) - self._grasp)
            arc = np.array([0, 0, 0.2 * math.sin(math.pi * reach)])
            hands = hands.copy()
            hands[self._hand] += reach * (goal - hands[self._hand]) + arc
        return Posture(pelvis, yaw, lean, feet, hands)

    def _share(self, t: float, act: Act, began: float) -> float:
        return min(1.0, max(0.0, (t - began) / act.seconds))

    def _gait(
        self, middle: Array, along: float, yaw: float, strength: float, forwards: bool
    ) -> tuple[Array, Array, float]:
        """Soles (2, 3), swing of the arms (2,), and how much the pelvis drops."""
        forward, left = np.array([math.cos(yaw), math.sin(yaw), 0]), np.array([-math.sin(yaw), math.cos(yaw), 0])
        feet, swing = np.zeros((2, 3)), np.zeros(2)
        run = along if forwards else -along
        for side in (0, 1):
            f = (run / _STRIDE + 0.5 * side) % 1.0
            half = 0.3 * _STRIDE
            if f < 0.6:
                ahead, lift = half - 2 * half * f / 0.6, 0.0
            else:
                g = (f - 0.6) / 0.4
                ahead, lift = half * (2 * g * g * (3 - 2 * g) - 1), 0.11 * math.sin(math.pi * g)
            sign = 1 - 2 * side
            feet[side] = middle + sign * 0.055 * self.body.height * left + strength * ahead * forward
            feet[side, 2] = strength * lift
            swing[side] = -strength * ahead
        return feet, swing, 0.035 * strength

    def _hands(
        self, pelvis: Array, forward: Array, left: Array, sit: float, swing: Array, yaw: float, lean: float
    ) -> Array:
        """Where hands are when they do nothing: hanging, or on the thighs."""
        hands = np.zeros((2, 3))
        bare = Posture(pelvis, yaw, lean, np.zeros((2, 3)), np.zeros((2, 3)))
        for side in (0, 1):
            sign = 1 - 2 * side
            shoulder = self.body.shoulder(bare, side)
            hanging = shoulder + 0.03 * sign * left - np.array([0, 0, 0.345 * self.body.height])
            hanging = hanging + (0.7 * swing[side] + 0.04) * forward + np.array([0, 0, 0.12 * abs(swing[side])])
            resting = pelvis + 0.33 * forward + 0.11 * sign * left + np.array([0, 0, 0.11])
            hands[side] = hanging + sit * (resting - hanging)
        return hands


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


def errand(
    path: Array, sit_yaw: float, mug: int, table: int, *, walk: float = 0.62, wait: float = 2.0, phase: float = 0.0
) -> Timeline:
    """Walks to a chair at the end of the path, sits down, drinks from a mug, gets up, and walks back."""
    line = Polyline(path)
    _, leave = line.at(0.0)
    _, arrive = line.at(line.length)
    stroll = max(1.5, line.length / walk)
    full, none = (line.length, line.length), (0.0, 0.0)
    go, drink, back = f"sit down at table {table}", f"drink from mug {mug}", "walk away"
    return Timeline(
        [
            Act("standing", wait, go, none, (leave + math.pi, leave)),
            Act("walking", stroll, go, (0.0, line.length)),
            Act("standing", 0.9, go, full, (arrive, sit_yaw)),
            Act("sitting_down", 1.7, go, full, (sit_yaw, sit_yaw), sit=(0.0, 1.0)),
            *_drinking(full, sit_yaw, mug, drink),
            Act("standing_up", 1.6, back, full, (sit_yaw, sit_yaw), sit=(1.0, 0.0)),
            Act("standing", 0.9, back, full, (sit_yaw, arrive + math.pi)),
            Act("walking", stroll, back, (line.length, 0.0)),
        ],
        phase,
    )


def coffee_break(yaw: float, mug: int, *, phase: float = 0.0) -> Timeline:
    """Sits all the time and drinks now and then."""
    goal = f"drink from mug {mug}"
    rest = Act("sitting", 3.0, "rest", (0.0, 0.0), (yaw, yaw), sit=(1.0, 1.0))
    return Timeline([rest, *_drinking((0.0, 0.0), yaw, mug, goal)], phase)


def _drinking(along: tuple[float, float], yaw: float, mug: int, goal: str) -> list[Act]:
    def act(name: str, seconds: float, reach: tuple[float, float], lift: tuple[float, float], object: int) -> Act:
        return Act(name, seconds, goal, along, (yaw, yaw), (1.0, 1.0), reach, lift, object)

    return [
        act("sitting", 1.6, (0.0, 0.0), (0.0, 0.0), -1),
        act("reaching", 1.2, (0.0, 1.0), (0.0, 0.0), mug),
        act("drinking", 1.3, (1.0, 1.0), (0.0, 1.0), mug),
        act("drinking", 1.0, (1.0, 1.0), (1.0, 1.0), mug),
        act("drinking", 1.3, (1.0, 1.0), (1.0, 0.0), mug),
        act("reaching", 1.0, (1.0, 0.0), (0.0, 0.0), mug),
        act("sitting", 1.4, (0.0, 0.0), (0.0, 0.0), -1),
    ]


def pacing(path: Array, *, walk: float = 0.7, wait: float = 2.5, phase: float = 0.0) -> Timeline:
    """Walks to the end of the path, stands there, and comes back."""
    line = Polyline(path)
    _, leave = line.at(0.0)
    _, arrive = line.at(line.length)
    stroll = max(1.5, line.length / walk)
    return Timeline(
        [
            Act("standing", wait, "wait", (0.0, 0.0), (leave + math.pi, leave)),
            Act("walking", stroll, "walk to and fro", (0.0, line.length)),
            Act("standing", wait, "wait", (line.length, line.length), (arrive, arrive + math.pi)),
            Act("walking", stroll, "walk to and fro", (line.length, 0.0)),
        ],
        phase,
    )


def person_doing(thing: int, person: Person, t: float) -> Doing:
    """What a person's script says."""
    act, _, began = person.timeline.at(t)
    return Doing(thing, act.activity, began, act.goal, act.object)


class Rolling:
    """A ball of a radius that rolls from a to b (2,) on the plane z, rests, and rolls back."""

    def __init__(
        self, a: Array, b: Array, radius: float, *, z: float = 0.0, seconds: float = 4.0, phase: float = 0.0
    ) -> None:
        self._a, self._b, self.radius, self._z = np.asarray(a, float), np.asarray(b, float), radius, z
        way = float(np.linalg.norm(self._b - self._a))
        self.timeline = Timeline(
            [
                Act("rolling", seconds, "roll away", (0.0, way)),
                Act("resting", 1.0, "rest", (way, way)),
                Act("rolling", seconds, "roll back", (way, 0.0)),
                Act("resting", 1.5, "rest", (0.0, 0.0)),
            ],
            phase,
        )
        self._direction = (self._b - self._a) / way

    def frame(self, t: float) -> Array:
        """Below the ball's middle, on what it rolls on."""
        x, y = self._a + self._run(t) * self._direction
        return pose(float(x), float(y), self._z)

    def parts(self, t: float) -> Array:
        """The ball about its middle, turned as far as it rolled."""
        angle = self._run(t) / self.radius
        axis = np.array([-self._direction[1], self._direction[0], 0.0])
        K = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0.0]])
        T = self.frame(t)
        T[2, 3] += self.radius
        T[:3, :3] = np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K
        return T[None]

    def doing(self, thing: int, t: float) -> Doing:
        act, _, began = self.timeline.at(t)
        return Doing(thing, act.activity, began, act.goal)

    def _run(self, t: float) -> float:
        act, x, _ = self.timeline.at(t)
        return _mix(act.along, x)


STANDING = 0.05
"""A robot that is slower than this, m/s, counts as standing."""


class Driving:
    """A robot that drives a closed path; in its narrow bends it all but stands."""

    def __init__(self, path: Trajectory, phase: float = 0.0) -> None:
        self._path, self._phase = path, phase
        times = np.linspace(0, path.period, 4000, endpoint=False)
        drives = path.at(times).speed() >= STANDING
        turns = np.flatnonzero(drives != np.roll(drives, 1))
        self._turns = [(float(times[k]), "driving" if drives[k] else "resting") for k in turns]

    def frame(self, t: float) -> Array:
        return np.asarray(self._path.at([t + self._phase]).T_world_base()[0])

    def parts(self, t: float) -> Array:
        return self.frame(t)[None]

    def doing(self, thing: int, t: float) -> Doing:
        if not self._turns:
            return Doing(thing, "driving", 0.0, "drive a loop")
        u = (t + self._phase) % self._path.period
        begin, activity = self._turns[bisect_right(self._turns, (u, "~")) - 1]
        return Doing(thing, activity, t - (u - begin) % self._path.period, "drive a loop")


class Carried:
    """A thing that lies still except while a person's hand has it: then it moves with the hand, upright."""

    def __init__(self, T_rest: Array, person: Person, grasped_at: float) -> None:
        """`grasped_at` is a time at which the hand is at the thing without having lifted it."""
        self._rest, self._person = T_rest, person
        self._grip = person.grip(grasped_at)

    def frame(self, t: float) -> Array:
        T = self._rest.copy()
        if self._person.held(t):
            T[:3, 3] += self._person.grip(t) - self._grip
        return T

    def parts(self, t: float) -> Array:
        return self.frame(t)[None]


def _mix(ends: tuple[float, float], x: float) -> float:
    return ends[0] + x * (ends[1] - ends[0])


def _bell(x: float) -> float:
    """Slope of the smootherstep over 30."""
    return x * x * (1 - x) * (1 - x)


def _wrap(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi
