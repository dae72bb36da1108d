"""Where an agent is going: candidates described by the agent's path, and a probability for each."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.scene.bodies import Body

Array = NDArray[np.float64]
F32 = NDArray[np.float32]

NOWHERE = -1
"""Stands for none of the candidates."""

CARRIERS, SEATS = ("table", "shelf"), ("chair",)
KINDS = ("chair", "table", "mug", "bottle", "door", "shelf")
NAMES = (
    *(f"is a {kind}" for kind in KINDS),
    "is nowhere",
    *("away", "away at the stop", "farther than the nearest", "farther at the stop than the nearest"),
    *("ahead", "to the right", "aside", "ahead at the stop", "to the right at the stop", "aside at the stop"),
    *("closing", "cosine of the way", "speed", "speed now", "brought nearer", "share of the way that was straight"),
    *("away from the last halt", "walked", "time since the halt", "candidates in reach"),
    *("height", "height of what carries it", "gap to the other furniture"),
)
COUNT = len(NAMES)
_SPEEDS = [NAMES.index("speed"), NAMES.index("speed now")]
_MEAN, _NOW = 0.6, 0.3  # seconds over which velocities are taken
_BRAKING = 0.25  # seconds after which somebody who slows down stands
_HALTED = 0.2  # m/s
_FAR = 4.0
REACH = 5.0  # metres up to which something is a candidate
_PAUSE = 1.3  # seconds after which who stands has arrived

Score = Callable[[F32], F32]
"""Descriptions (N, COUNT) of candidates, the last of them nowhere → scores (N,), log odds up to a constant."""


@dataclass(frozen=True, eq=False)
class Places:
    """Candidates (N): ids, kinds (N, K), middles (N, 2), and what carries each: the footprint of a table or itself.

    `frames` (N, 5) are middle, heading and half sides of that footprint; `shape` (N, 3) is the thing's height, that of
    what carries it, and the gap to the nearest other furniture, metres.
    """

    ids: tuple[int, ...]
    kinds: F32
    middles: Array
    frames: Array
    shape: Array

    @classmethod
    def of(cls, candidates: Sequence[Body], furniture: Sequence[Body]) -> Places:
        """`furniture` is what may carry a candidate or stand beside it; candidates may be among it."""
        frames, shape = np.zeros((len(candidates), 5)), np.zeros((len(candidates), 3))
        for k, body in enumerate(candidates):
            base = _carrier(body, furniture)
            own = (body.id, base.id)
            gap = min((_outside(b, body.center) for b in furniture if b.id not in own), default=_FAR)
            frames[k] = (*base.center[:2], base.yaw, *(base.size[:2] / 2))
            shape[k] = body.top, base.top, min(gap, 2.0)
        return cls(
            tuple(b.id for b in candidates),
            np.array([[b.label == kind for kind in KINDS] for b in candidates], np.float32).reshape(-1, len(KINDS)),
            np.array([b.center[:2] for b in candidates]).reshape(-1, 2),
            frames,
            shape,
        )

    def around(self, place: Array, reach: float) -> Places:
        """Returns those within a reach."""
        rows = np.flatnonzero(np.hypot(*(self.middles - place[:2]).T) <= reach)
        ids = tuple(self.ids[k] for k in rows.tolist())
        return Places(ids, self.kinds[rows], self.middles[rows], self.frames[rows], self.shape[rows])

    def before(self, place: Array) -> tuple[Array, Array]:
        """Returns how far ahead and to the right (N,) candidates lie for who stands at a place (2,) and faces squarely
        what carries each."""
        c, s = np.cos(self.frames[:, 2]), np.sin(self.frames[:, 2])
        dx, dy = (self.frames[:, :2] - place).T
        along, across = c * dx + s * dy, c * dy - s * dx
        endways = np.abs(along) - self.frames[:, 3] >= np.abs(across) - self.frames[:, 4]
        sign = np.where(np.where(endways, along, across) < 0, -1.0, 1.0)
        fx, fy = np.where(endways, c, -s) * sign, np.where(endways, s, c) * sign
        ox, oy = (self.middles - place).T
        return ox * fx + oy * fy, ox * fy - oy * fx


class GoalInference:
    """Infers where an agent is going: a probability for each candidate, and for none of them (id -1).

    The path since the agent last stood still, and where it would stop, are set against each candidate: how much nearer
    it was brought for the way that was walked, how it would lie before the agent where it is used (a drink at the right
    hand, a seat behind), what stands beside it. A network scores these; scores are averaged over `memory` seconds.

    After Ramirez and Geffner, "Probabilistic plan recognition using off-the-shelf classical planners", 2010, with
    straight lines for plans and a likelihood that was learned.
    """

    def __init__(self, score: Score, memory: float) -> None:
        self._score, self._memory = score, memory
        self._scores: dict[int, float] = {}
        self._path = GoalPath()

    def update(self, time: float, body: Body, places: Places) -> dict[int, float]:
        """Returns the probability of each candidate's id and of -1 after the agent's next place."""
        since = self._path.add(time, body)
        places = places.around(body.center, REACH)
        ids = [*places.ids, NOWHERE]
        scores = self._score(self._path.describe(places)).astype(np.float64)
        keep = math.exp(-since / self._memory)
        known = self._scores
        self._scores = {
            i: keep * known[i] + (1 - keep) * s if i in known else s for i, s in zip(ids, scores.tolist(), strict=True)
        }
        most = max(self._scores.values())
        weights = {i: math.exp(v - most) for i, v in self._scores.items()}
        total = sum(weights.values())
        return {i: w / total for i, w in weights.items()}

    def snapshot(self) -> dict[str, Any]:
        return {"scores": [[i, s] for i, s in self._scores.items()], "path": self._path.snapshot()}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._scores = {int(i): float(s) for i, s in state["scores"]}
        self._path.restore(state["path"])


class GoalPath:
    """The way of an agent since it last stood still."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, float, float]] = deque()
        self._halt: tuple[float, float, float] | None = None
        self._walked = 0.0
        self._moved = -math.inf

    def add(self, time: float, body: Body) -> float:
        """Takes the agent's next place; returns the seconds since the one before."""
        x, y = float(body.center[0]), float(body.center[1])
        since, step = 0.0, 0.0
        if self._past:
            since = time - self._past[-1][0]
            step = math.hypot(x - self._past[-1][1], y - self._past[-1][2])
        self._past.append((time, x, y))
        while len(self._past) > 2 and self._past[0][0] < time - _MEAN - 1e-6:
            self._past.popleft()
        if self._speed() > _HALTED:
            self._moved = time
            self._walked += step
        if self._halt is None or time - self._moved > _PAUSE:
            self._halt, self._walked = (time, x, y), 0.0
        return since

    def describe(self, places: Places) -> F32:
        """Returns (N + 1, COUNT), the last row for nowhere."""
        assert self._halt is not None
        time, x, y = self._past[-1]
        vx, vy = self._velocity(_MEAN)
        ux, uy = self._velocity(_NOW)
        speed, now = math.hypot(vx, vy), math.hypot(ux, uy)
        here, stop = np.array([x, y]), np.array([x + _BRAKING * ux, y + _BRAKING * uy])
        away, at_stop = (np.hypot(*(places.middles - p).T) for p in (here, stop))
        halt_time, halt = self._halt[0], np.array(self._halt[1:])
        from_halt = np.hypot(*(places.middles - halt).T)
        before, before_stop = places.before(here), places.before(stop)
        toward = (places.middles - here) @ np.array([vx, vy]) / np.maximum(away, 0.1)
        near, near_stop = float(away.min(initial=_FAR)), float(at_stop.min(initial=_FAR))
        common = [min(self._walked, 5.0), min(time - halt_time, 8.0) / 8, float((at_stop < 1.0).sum()) / 4]
        rows = np.zeros((len(away) + 1, COUNT), np.float32)
        rows[:-1, : len(KINDS)] = places.kinds
        rows[:-1, len(KINDS) + 1 : -6] = np.stack(
            [
                away, at_stop, away - near, at_stop - near_stop,
                *before, np.abs(before[1]), *before_stop, np.abs(before_stop[1]),
                toward, toward / max(speed, 0.15), np.full(len(away), speed), np.full(len(away), now),
                from_halt - away, (from_halt - away) / max(self._walked, 0.3), from_halt,
            ],
            axis=1,
        )  # fmt: skip
        rows[:-1, -3:] = places.shape
        rows[-1, len(KINDS) : len(KINDS) + 3] = 1.0, near, near_stop
        rows[-1, _SPEEDS] = speed, now
        rows[:, -6:-3] = common
        return np.clip(rows, -_FAR, _FAR)

    def snapshot(self) -> dict[str, Any]:
        halt = None if self._halt is None else list(self._halt)
        moved = None if self._moved == -math.inf else self._moved
        return {"past": [list(row) for row in self._past], "halt": halt, "walked": self._walked, "moved": moved}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._past = deque((float(t), float(x), float(y)) for t, x, y in state["past"])
        halt = state["halt"]
        self._halt = None if halt is None else (float(halt[0]), float(halt[1]), float(halt[2]))
        self._walked = float(state["walked"])
        self._moved = -math.inf if state["moved"] is None else float(state["moved"])

    def _velocity(self, seconds: float) -> tuple[float, float]:
        """Returns the velocity, m/s, over the last seconds, by least squares over two places at least."""
        rows = np.array(self._past)
        if len(rows) < 2:
            return 0.0, 0.0
        rows = rows[min(int(np.searchsorted(rows[:, 0], rows[-1, 0] - seconds - 1e-6)), len(rows) - 2) :]
        t = rows[:, 0] - rows[:, 0].mean()
        weight = float(t @ t)
        if weight < 1e-6:
            return 0.0, 0.0
        vx, vy = (t @ rows[:, 1:] / weight).tolist()
        return vx, vy

    def _speed(self) -> float:
        return math.hypot(*self._velocity(_NOW))


def _carrier(body: Body, furniture: Sequence[Body]) -> Body:
    """Returns the table or shelf that a thing stands on, or the thing itself."""
    if body.label in CARRIERS:
        return body
    under = [(_outside(b, body.center), b.id, b) for b in furniture if b.label in CARRIERS and b.id != body.id]
    off, _, base = min((row for row in under if row[2].top < body.bottom + 0.15), default=(_FAR, 0, body))
    return base if off <= 0.15 and body.label not in SEATS else body


def _outside(box: Body, place: Array) -> float:
    """Returns how far a place is from a box's footprint on the ground, 0 within."""
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    dx, dy = place[0] - box.center[0], place[1] - box.center[1]
    x = max(abs(c * dx + s * dy) - box.size[0] / 2, 0.0)
    y = max(abs(c * dy - s * dx) - box.size[1] / 2, 0.0)
    return math.hypot(x, y)
