"""Infers activities and goals of agents from how they move."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
_WINDOW = 1.0  # seconds of the past that tell how an agent moves
_WALKING, _ROLLING, _DRIVING = 0.25, 0.12, 0.07  # m/s
_RISING = 0.15  # m/s, of the head
_NEARNESS = 4.0  # log odds that a goal loses for each metre that it is farther away than the nearest
_ARM = (0.5, -0.19)  # metres ahead and to the left at which somebody has what the right hand takes
_EFFORT = 0.25  # metres that reaching for something counts as farther than walking up to something


class Motion:
    """The recent past of one agent: when (s), where (3,), and how high its top is."""

    def __init__(self) -> None:
        self.past: deque[tuple[float, Array, float]] = deque()

    def add(self, time: float, body: Body) -> None:
        self.past.append((time, body.center.copy(), body.top))
        while self.past and self.past[0][0] < time - 4 * _WINDOW:
            self.past.popleft()

    def velocity(self) -> Array:
        """Mean velocity (3,) over the window, by least squares; 0 where the past is too short."""
        times, places, _ = self._recent()
        if len(times) < 3 or np.ptp(times) < 0.2:
            return np.zeros(3)
        t = times - times.mean()
        return np.asarray((t @ (places - places.mean(axis=0))) / (t @ t))

    def rise(self) -> float:
        """Returns how fast the top rises, m/s."""
        times, _, tops = self._recent()
        if len(times) < 3 or np.ptp(times) < 0.2:
            return 0.0
        t = times - times.mean()
        return float(t @ (tops - tops.mean()) / (t @ t))

    def _recent(self) -> tuple[Array, Array, Array]:
        now = self.past[-1][0]
        rows = [row for row in self.past if row[0] >= now - _WINDOW]
        return np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), np.array([r[2] for r in rows])


def activity_of(body: Body, motion: Motion, relations: Mapping[Relation, float]) -> tuple[str, float, int]:
    """Returns what an agent does, how sure that is, and the id of what it does it to, -1 for nothing.

    `body` has the velocity of its motion.
    """
    speed = float(np.hypot(*body.velocity[:2]))
    if len(motion.past) < 3:
        return UNKNOWN, 0.3, -1
    if body.label == "ball":
        return ("rolling", _sure(speed, _ROLLING), -1) if speed > _ROLLING else ("resting", _sure(_ROLLING, speed), -1)
    if body.label != "person":
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
    if "sitting_on" in of:
        return "sitting", of["sitting_on"][0], of["sitting_on"][1]
    return "standing", _sure(_WALKING, speed), -1


def _sure(more: float, less: float) -> float:
    """Returns a confidence in [0.5, 1] that one quantity is the larger of two."""
    return float(1 / (1 + np.exp(-4 * (more - less) / max(more + less, 1e-6))))


def way_to(place: tuple[float, float], goal: Body, support: Body | None) -> float:
    """Returns the metres that are left from a place on the ground to a goal.

    What lies on a support is reached for, from where one stands square to the support with the thing before the right
    hand: the nearest such place counts. Anything else is walked up to.
    """
    (x, y), (u, v, _) = place, goal.center.tolist()
    if support is None:
        return math.hypot(u - x, v - y)
    ahead, left = _ARM
    ways = []
    for side in range(4):
        c, s = math.cos(support.yaw + side * math.pi / 2), math.sin(support.yaw + side * math.pi / 2)
        ways.append(math.hypot(u - (ahead * c - left * s) - x, v - (ahead * s + left * c) - y))
    return min(ways) + _EFFORT


class GoalInference:
    """Infers where an agent is going: a probability for each candidate, and for none of them (id -1).

    Each step of the path speaks for the candidates to which it leaves less way: its log likelihood is `trust` times the
    way saved, less the way walked, so detours count against a goal. The past fades over `memory` seconds; so does what
    was believed when the agent stands still. After Ramirez and Geffner, "Probabilistic plan recognition using
    off-the-shelf classical planners", 2010, with straight lines for plans.
    """

    def __init__(self, trust: float, memory: float, elsewhere: float) -> None:
        self._trust, self._memory, self._elsewhere = trust, memory, elsewhere
        self._belief: dict[int, float] = {}
        self._last: tuple[float, Array] | None = None

    def update(
        self, time: float, body: Body, candidates: Sequence[Body], supports: Mapping[int, Body]
    ) -> dict[int, float]:
        """Returns the probability of each candidate's id and of -1 after the agent's next place.

        `supports`: what candidates lie on, by their ids.
        """
        x, y, _ = body.center.tolist()
        away = {each.id: way_to((x, y), each, supports.get(each.id)) for each in candidates}
        if self._last is not None and time > self._last[0]:
            fade = float(np.exp(-(time - self._last[0]) / self._memory))
            u, v = self._last[1].tolist()
            walked = float(np.hypot(x - u, y - v))
            belief = {}
            for each in candidates:
                saved = way_to((u, v), each, supports.get(each.id)) - away[each.id]
                belief[each.id] = fade * self._belief.get(each.id, 0.0) + self._trust * (saved - walked)
            self._belief = belief
        self._last = (time, body.center[:2].copy())
        nearest = min(away.values(), default=0.0)
        scores = {i: self._belief.get(i, 0.0) - _NEARNESS * (d - nearest) for i, d in away.items()}
        scores[-1] = -self._elsewhere
        most = max(scores.values())
        weights = {i: float(np.exp(v - most)) for i, v in scores.items()}
        total = sum(weights.values())
        return {i: w / total for i, w in weights.items()}

    def snapshot(self) -> dict[str, Any]:
        return {
            "belief": [[i, v] for i, v in self._belief.items()],
            "last": None if self._last is None else [*self._last],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        self._belief = {int(i): float(v) for i, v in state["belief"]}
        last = state["last"]
        self._last = None if last is None else (float(last[0]), np.array(last[1], np.float64))
