"""Infers where an agent is going from its path."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.scene.bodies import Body

Array = NDArray[np.float64]

_NEARNESS = 6.0  # log odds that a goal loses a metre that it is farther than the nearest; chosen on simulated worlds
_STEP = 0.15  # metres that an agent is elsewhere before that counts as a step: less is the jitter of its box


class GoalInference(Remembered):
    """Infers where an agent is going: a probability for each candidate, and for none of them (id -1).

    Each step of the path speaks for the candidates to which it leaves less way: its log likelihood is `trust` times the
    way saved, less the way walked, so detours count against a goal. A step fades over `memory` seconds. The nearer one
    is likelier. Candidates are judged by all of the path that is remembered and by where they are now, so it does not
    matter since when, or where before, the map has had them. The way to one is the straight line to its middle. After
    Ramirez and Geffner, "Probabilistic plan recognition using off-the-shelf classical planners", 2010, with straight
    lines for plans.
    """

    _path: deque[tuple[float, float, float]]

    def __init__(self, trust: float, memory: float, elsewhere: float) -> None:
        self._trust, self._memory, self._elsewhere = trust, memory, elsewhere
        self._path = deque()

    def update(self, time: float, body: Body, candidates: Sequence[Body]) -> dict[int, float]:
        """Returns the probability of each candidate's id and of -1 after the agent's next place."""
        path = self._walked(time, *body.center[:2].tolist())
        if not candidates:
            return {-1: 1.0}
        places = np.array([each.center[:2] for each in candidates])
        left = np.hypot(*(path[:, 1:] - places[:, None]).transpose(2, 0, 1))  # (K, N)
        steps = np.hypot(*np.diff(path[:, 1:], axis=0).T)
        fade = np.exp((path[1:, 0] - time) / self._memory)
        belief = self._trust * ((left[:, :-1] - left[:, 1:] - steps) @ fade)
        scores = belief - _NEARNESS * (left[:, -1] - left[:, -1].min())
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
