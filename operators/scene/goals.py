"""Infers where an agent is going from its path."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.scene.bodies import Body

Array = NDArray[np.float64]

SEATS = ("chair",)
_NEARNESS = 6.0  # log odds that a goal loses for each metre that it is farther away than the nearest
_ARM = (0.5, -0.19)  # metres ahead and to the left at which somebody has what the right hand takes
_BEFORE = (0.44, 0.0)  # the same of the seat that somebody sits down on
_SMALL = 0.5  # metres: what is no larger is taken by hand
_STEP = 0.15  # metres that an agent is elsewhere before that counts as a step: less is the jitter of its box
_SIDES = np.array([[[c, -s], [s, c]] for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))], np.float64)


def stands(goal: Body, support: Body | None) -> tuple[Array, float]:
    """Returns the places on the ground (4, 2) from which a goal is had, and the metres that are left to it there.

    What lies on a support is reached for, from where one stands square to the support with the thing before the right
    hand; who wants to sit down stands before the seat first. Each of the four sides of support or seat may be the one:
    which of them are free is not known. A small thing that lies on nothing known is in reach all around; anything else
    is walked up to.
    """
    place, small = goal.center[:2], max(goal.size.tolist()) <= _SMALL
    seat = goal.label in SEATS
    if not seat and (support is None or not small):
        return np.tile(place, (4, 1)), math.hypot(*_ARM) if small else 0.0
    (ahead, left), yaw = (_ARM, support.yaw) if support is not None and not seat else (_BEFORE, goal.yaw)
    c, s = math.cos(yaw), math.sin(yaw)
    return place - _SIDES @ (ahead * c - left * s, ahead * s + left * c), 0.0


class GoalInference:
    """Infers where an agent is going: a probability for each candidate, and for none of them (id -1).

    Each step of the path speaks for the candidates to which it leaves less way: its log likelihood is `trust` times the
    way saved, less the way walked, so detours count against a goal. A step fades over `memory` seconds. The nearer one
    is likelier. Candidates are judged by all of the path that is remembered and by where they are now, so it does not
    matter since when, or where before, the map has had them. One that is had from several places is as likely as the
    likeliest of these. After Ramirez and Geffner, "Probabilistic plan recognition using off-the-shelf classical
    planners", 2010, with straight lines for plans.
    """

    def __init__(self, trust: float, memory: float, elsewhere: float) -> None:
        self._trust, self._memory, self._elsewhere = trust, memory, elsewhere
        self._path: deque[tuple[float, float, float]] = deque()

    def update(
        self, time: float, body: Body, candidates: Sequence[Body], supports: Mapping[int, Body]
    ) -> dict[int, float]:
        """Returns the probability of each candidate's id and of -1 after the agent's next place.

        `supports`: what candidates lie on, by their ids.
        """
        path = self._walked(time, *body.center[:2].tolist())
        if not candidates:
            return {-1: 1.0}
        had = [stands(each, supports.get(each.id)) for each in candidates]
        places = np.array([four for four, _ in had])  # (K, 4, 2)
        offsets = places[:, :, None] - path[:, 1:]
        left = np.abs(np.hypot(offsets[..., 0], offsets[..., 1]) - np.array([ring for _, ring in had])[:, None, None])
        steps = np.hypot(*np.diff(path[:, 1:], axis=0).T)
        fade = np.exp((path[1:, 0] - time) / self._memory)
        belief = self._trust * ((left[..., :-1] - left[..., 1:] - steps) @ fade)  # (K, 4)
        away = left[..., -1]
        scores = (belief - _NEARNESS * (away - away.min())).max(axis=1)
        scores = np.append(scores, -self._elsewhere)
        weights = np.exp(scores - scores.max())
        ids = [*(each.id for each in candidates), -1]
        return dict(zip(ids, (weights / weights.sum()).tolist(), strict=True))

    def _walked(self, time: float, x: float, y: float) -> Array:
        """Takes the agent's next place; returns the times and places (N, 3) of its path in steps, the last one here."""
        path = self._path
        while len(path) > 1 and path[1][0] < time - 4 * self._memory:
            path.popleft()
        walked = np.array([*path, (time, x, y)])
        if not path or math.hypot(x - path[-1][1], y - path[-1][2]) >= _STEP:
            path.append((time, x, y))
        return walked

    def snapshot(self) -> dict[str, Any]:
        return {"path": [[*place] for place in self._path]}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._path = deque((float(t), float(x), float(y)) for t, x, y in state["path"])
