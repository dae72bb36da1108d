"""Infers what agents do and where they are going, from how they move."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.scene.bodies import Body
from operators.scene.relations import Relation

Array = NDArray[np.float64]

UNKNOWN = "unknown"
ACTIVITIES = (
    "standing",
    "walking",
    "sitting_down",
    "sitting",
    "standing_up",
    "reaching",
    "drinking",
    "rolling",
    "driving",
    "resting",
    UNKNOWN,
)
_WINDOW = 1.0  # seconds of the past that show how an agent moves
_WALKING, _ROLLING, _DRIVING = 0.25, 0.12, 0.07  # m/s
_KNOWN = 0.6  # probability from which an agent is said to move, or not
_RISING = 0.15  # m/s, of the head
_NEARNESS = 6.0  # log odds that a goal loses a metre that it is farther than the nearest; chosen on simulated worlds
_STEP = 0.15  # metres that an agent is elsewhere before that counts as a step: less is the jitter of its box
_FADING = 2.0  # seconds over which a step of the way fades, which counts as much as its metres
_ELSEWHERE = 2.5  # log odds of the nearest candidate, all else equal, against none of them


@dataclass
class Motion:
    """The recent past of one agent: when (s), where (3,), and how high its top is."""

    past: deque[tuple[float, Array, float]] = field(default_factory=deque)

    def add(self, time: float, body: Body) -> None:
        self.past.append((time, body.center.copy(), body.top))
        while self.past and self.past[0][0] < time - 4 * _WINDOW:
            self.past.popleft()

    def velocity(self) -> Array:
        """Mean velocity (3,) over the window, by least squares; 0 where the past is too short."""
        return self._slope(1, np.zeros(3))

    def rise(self) -> float:
        """Returns how fast the top rises, m/s."""
        return float(self._slope(2, np.zeros(())))

    def _slope(self, column: int, unknown: Array) -> Array:
        """Returns by how much a column of the past changes a second, by least squares over the window."""
        rows = [row for row in self.past if row[0] >= self.past[-1][0] - _WINDOW]
        times, values = np.array([row[0] for row in rows]), np.array([row[column] for row in rows])
        if len(times) < 3 or np.ptp(times) < 0.2:
            return unknown
        t = times - times.mean()
        return np.asarray((t @ (values - values.mean(axis=0))) / (t @ t))


def activity_of(
    body: Body, motion: Motion, relations: Mapping[Relation, float], posture: tuple[str, float] | None = None
) -> tuple[str, float, int]:
    """Returns what an agent does, how sure that is, and the id of what it does it to, -1 for nothing.

    `body` has the velocity of its motion. `posture` is what a person's joints show, `unknown` where they were looked
    for in vain, with its probability.
    """
    speed = float(np.hypot(*body.velocity[:2]))
    if not math.isnan(body.moving) and not body.person:
        sure = max(body.moving, 1 - body.moving)
        return (UNKNOWN, 0.3, -1) if sure < _KNOWN else ("driving" if body.moving > 0.5 else "resting", sure, -1)
    if len(motion.past) < 3:
        return UNKNOWN, 0.3, -1
    if "rolls" in body.roles:
        return ("rolling", _sure(speed, _ROLLING), -1) if speed > _ROLLING else ("resting", _sure(_ROLLING, speed), -1)
    if not body.person:
        return ("driving", _sure(speed, _DRIVING), -1) if speed > _DRIVING else ("resting", _sure(_DRIVING, speed), -1)
    of = {p: (score, o) for (s, p, o), score in relations.items() if s == body.id}
    rise = motion.rise()
    if abs(rise) > _RISING and speed < 0.6:
        return (
            ("standing_up" if rise > 0 else "sitting_down"),
            _sure(abs(rise), _RISING),
            of.get("sitting_on", (0, -1))[1],
        )
    if "holding" in of:
        return "drinking", of["holding"][0], of["holding"][1]
    if "reaching_for" in of:
        return "reaching", of["reaching_for"][0], of["reaching_for"][1]
    if speed > _WALKING:
        return "walking", _sure(speed, _WALKING), -1
    if posture is not None and posture[0] == "sitting":
        return "sitting", posture[1], of.get("sitting_on", (0, -1))[1]
    if "sitting_on" in of and (posture is None or posture[0] == UNKNOWN):
        return "sitting", of["sitting_on"][0], of["sitting_on"][1]
    if posture is not None:
        return *posture, -1
    return "standing", _sure(_WALKING, speed), -1


def _sure(more: float, less: float) -> float:
    """Returns a confidence in [0.5, 1] that one quantity is the larger of two."""
    return float(1 / (1 + np.exp(-4 * (more - less) / max(more + less, 1e-6))))


class GoalInference(Remembered):
    """Infers where an agent is going: a probability for each candidate, and for none of them (id -1).

    Each step of the path speaks for the candidates to which it leaves less way: its log likelihood is the way saved,
    less the way walked, so detours count against a goal. A step fades over two seconds. The nearer one is likelier.
    Candidates are judged by all of the path that is remembered and by where they are now, so it does not matter since
    when, or where before, the map has had them. The way to one is the straight line to its middle. After Ramirez and
    Geffner, "Probabilistic plan recognition using off-the-shelf classical planners", 2010, with straight lines for
    plans.
    """

    _path: deque[tuple[float, float, float]]

    def __init__(self) -> None:
        self._path = deque()

    def update(self, time: float, body: Body, candidates: Sequence[Body]) -> dict[int, float]:
        """Returns the probability of each candidate's id and of -1 after the agent's next place."""
        path = self._walked(time, *body.center[:2].tolist())
        if not candidates:
            return {-1: 1.0}
        places = np.array([each.center[:2] for each in candidates])
        left = np.hypot(*(path[:, 1:] - places[:, None]).transpose(2, 0, 1))  # (K, N)
        steps = np.hypot(*np.diff(path[:, 1:], axis=0).T)
        fade = np.exp((path[1:, 0] - time) / _FADING)
        belief = (left[:, :-1] - left[:, 1:] - steps) @ fade
        scores = belief - _NEARNESS * (left[:, -1] - left[:, -1].min())
        scores = np.append(scores, -_ELSEWHERE)
        weights = np.exp(scores - scores.max())
        ids = [*(each.id for each in candidates), -1]
        return dict(zip(ids, (weights / weights.sum()).tolist(), strict=True))

    def _walked(self, time: float, x: float, y: float) -> Array:
        """Takes the agent's next place; returns the times and places (N, 3) of its path in steps, the last one here."""
        path = self._path
        while len(path) > 1 and path[1][0] < time - 4 * _FADING:
            path.popleft()
        walked = np.array([*path, (time, x, y)])
        if not path or math.hypot(x - path[-1][1], y - path[-1][2]) >= _STEP:
            path.append((time, x, y))
        return walked
