"""Persons that follow a script: from what they are to do to the posture of their bodies."""

from __future__ import annotations

import math

import numpy as np

from operators.simulator.people.body import Body, Posture
from operators.simulator.people.scripts import Point, Polyline, Timeline, mix
from operators.simulator.scene import CurrentActivity
from operators.simulator.shapes import Array, pose
from operators.simulator.trajectory import wrapped

_STRIDE = 1.25  # metres a full step, left and right


class Person:
    """A person who follows a script along a path. `hand` is the one that reaches: 0 left, 1 right."""

    def __init__(self, body: Body, path: Array, timeline: Timeline, *, hand: int = 1) -> None:
        self.body, self.timeline, self._hand = body, timeline, hand
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

    def doing(self, thing: int, t: float) -> CurrentActivity:
        act, _, began = self.timeline.at(t)
        return CurrentActivity(thing, act.activity, began, act.goal, act.object)

    def held(self, t: float) -> int:
        """The object that the hand has, -1 for none."""
        act = self.timeline.at(t)[0]
        return act.object if act.activity == "drinking" else -1

    def reached_for(self, t: float) -> int:
        """The object that the hand goes to or puts back, -1 for none."""
        act, _, _ = self.timeline.at(t)
        return act.object if act.activity == "reaching" else -1

    def seat(self, t: float) -> Point | None:
        """The place of the pelvis on the seat that carries the person, if one does."""
        act, _, _ = self.timeline.at(t)
        return act.seat if act.sit == (1.0, 1.0) else None

    def grip(self, t: float) -> Array:
        """Returns where the reaching hand is."""
        return self.body.grip(self.posture(t), self._hand)

    def posture(self, t: float) -> Posture:
        if self._known is None or self._known[0] != t:
            self._known = (t, self._posture(t))
        return self._known[1]

    def _posture(self, t: float) -> Posture:
        act, x, began = self.timeline.at(t)
        along = mix(act.along, x)
        place, heading = self._path.at(along)
        forwards = act.along[1] >= act.along[0]
        if act.yaw is None:
            yaw = heading if forwards else heading + math.pi
        else:
            yaw = act.yaw[0] + x * wrapped(act.yaw[1] - act.yaw[0])
        sit = mix(act.sit, x)
        pelvis = np.array([*place, self.body.hip_height])
        forward, left = np.array([math.cos(yaw), math.sin(yaw), 0]), np.array([-math.sin(yaw), math.cos(yaw), 0])
        middle = np.array([*place, 0.0])
        if act.seat is not None and sit > 0:
            back = sit * sit * (3 - 2 * sit)
            seat = np.array(act.seat)
            pelvis[:2] += back * (seat[:2] - pelvis[:2])
            pelvis[2] += sit * (seat[2] - pelvis[2])
            middle = middle + 0.06 * sit * forward
        share = min(1.0, max(0.0, (t - began) / act.seconds))
        slope = share * share * (1 - share) * (1 - share)  # of the smootherstep, over 30
        speed = abs(act.along[1] - act.along[0]) / act.seconds * 30 * slope
        run = along if forwards else -along
        feet, swing, drop = self._gait(middle, forward, left, run, min(1.0, speed / 0.5))
        pelvis[2] -= drop
        changing = act.sit[0] != act.sit[1]
        reach = mix(act.reach, x)
        lean = 0.04 + (0.55 * math.sin(math.pi * sit) if changing else 0.0) + 0.22 * reach * (1 - mix(act.lift, x))
        hands = self._hands(pelvis, forward, left, sit, swing, yaw, lean)
        if act.grasp is not None and (reach > 0 or mix(act.lift, x) > 0):
            posture = Posture(pelvis, yaw, lean, feet, hands)
            grasp = np.array(act.grasp)
            goal = grasp + mix(act.lift, x) * (self.body.mouth(posture) - grasp)
            arc = np.array([0, 0, 0.2 * math.sin(math.pi * reach)])
            hands = hands.copy()
            hands[self._hand] += reach * (goal - hands[self._hand]) + arc
        return Posture(pelvis, yaw, lean, feet, hands)

    def _gait(
        self, middle: Array, forward: Array, left: Array, run: float, strength: float
    ) -> tuple[Array, Array, float]:
        """Soles (2, 3), swing of the arms (2,), and how much the pelvis drops."""
        feet, swing = np.zeros((2, 3)), np.zeros(2)
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
        """Returns where hands are when they do nothing: hanging, or on the thighs."""
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
