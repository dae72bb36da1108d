"""Infers activities of agents from how they move."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

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
_KNOWN = 0.6  # probability from which an agent is said to move, or not
_RISING = 0.15  # m/s, of the head


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
