"""Features of an agent, one vector for each moment: its recent motion and surroundings, as evidence of its activity."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.scene.bodies import Body

Array = NDArray[np.float64]

WINDOW = 2.5
"""Seconds of the past from which motion is taken; what was before is in the state of the network."""

MATTERING: frozenset[str] = frozenset(("agent", "seat", "support", "drink"))
"""Roles of the classes that features are made of; others change nothing."""
_SHORT, _LONG = 0.6, 1.6
_BEFORE = 0.5  # seconds before its first look at which an agent is put by its velocity
FAR = 3.0  # metres at which things are as good as not there
_REACH = 1.2  # metres up to which something is done to a thing

NAMES = (
    *("is a person", "is a robot", "is a ball"),
    *("time known", "time since seen", "time step", "distance of the robot"),
    *("height of the top", "height of the bottom", "longer side", "shorter side", "height"),
    *("top below its highest", "top above its lowest", "longer side over its least", "shorter side over its least"),
    *("speed, short", "speed, long", "rise, short", "rise, long", "way gone", "growth of the longer side"),
    *("seat: away", "seat: closing", "seat: head above its foot", "seat: speed along"),
    *("table: gap", "table: closing", "table: height"),
    *("drink: gap", "drink: closing", "drink: below the top", "drink: lifted", "drink: speed", "drink: second gap"),
    "drinks in reach",
)
COUNT = len(NAMES)


@dataclass(frozen=True)
class Look:
    """An agent at one time: seconds, middle (3,), full size (3,)."""

    time: float
    center: Array
    size: Array

    @property
    def top(self) -> float:
        return float(self.center[2] + self.size[2] / 2)


class Surroundings(Remembered):
    """The things around the agents of a scene, and how small ones have moved of late."""

    _pasts: dict[int, deque[tuple[float, Array]]]
    _lowest: dict[int, float]

    def __init__(self) -> None:
        self._pasts, self._lowest = {}, {}
        self.restored()

    def restored(self) -> None:
        """Waits for the next update to learn what is there."""
        self._now: dict[str, list[Body]] = {}

    def update(self, time: float, things: Sequence[Body]) -> None:
        """Takes all things of one time, agents among them."""
        self._now = {role: [b for b in things if role in b.roles] for role in ("seat", "support", "drink")}
        there = {b.id for b in self._now["drink"]}
        self._pasts = {i: past for i, past in self._pasts.items() if i in there}
        self._lowest = {i: z for i, z in self._lowest.items() if i in there}
        for body in self._now["drink"]:
            past = self._pasts.setdefault(body.id, deque())
            past.append((time, body.center.copy()))
            while past[0][0] < time - _SHORT:
                past.popleft()
            z = float(body.center[2])
            self._lowest[body.id] = min(self._lowest.get(body.id, z), z)

    def of(self, now: Look, before: Look) -> list[float]:
        """Returns what stands around an agent that was elsewhere shortly before."""
        return [*self._seat(now, before), *self._table(now, before), *self._drinks(now, before)]

    def object_of(self, activity: str, body: Body) -> int:
        """Returns the id of what an agent does something to, -1 for nothing: the seat or the drink nearest to it."""
        group = {
            "sitting": "seat",
            "sitting_down": "seat",
            "standing_up": "seat",
            "reaching": "drink",
            "drinking": "drink",
        }
        rows = self._now.get(group.get(activity, ""), [])
        near = ((_flat(b.center - body.center) - 2 * self._raised(b), b.id) for b in rows)
        away, id = min(near, default=(FAR, -1))
        return id if away < _REACH else -1

    def _raised(self, drink: Body) -> float:
        """Returns how far a drink is above its lowest place: one in the hand is the one that matters."""
        return min(float(drink.center[2]) - self._lowest.get(drink.id, float(drink.center[2])), 0.3)

    def _seat(self, now: Look, before: Look) -> tuple[float, float, float, float]:
        away, _, seat = min(
            ((_flat(b.center - now.center), b.id, b) for b in self._now["seat"]), default=(FAR, 0, None)
        )
        if seat is None or away >= FAR:
            return 1.0, 0.0, 0.0, 0.0
        closing = _flat(seat.center - before.center) - away
        step = now.center - before.center
        along = float(step[:2] @ (seat.center - now.center)[:2]) / max(away, 0.1)
        return away / FAR, closing, now.top - seat.bottom - 1.0, along

    def _table(self, now: Look, before: Look) -> tuple[float, float, float]:
        apart, _, table = min(
            ((_outside(b, now.center), b.id, b) for b in self._now["support"]), default=(FAR, 0, None)
        )
        if table is None or apart >= FAR:
            return 1.0, 0.0, 0.0
        return apart / FAR, _outside(table, before.center) - apart, table.top

    def _drinks(self, now: Look, before: Look) -> tuple[float, ...]:
        rows = sorted((_flat(b.center - now.center), b.id, b) for b in self._now["drink"])[:6]
        rows.sort(key=lambda row: row[0] - 2 * self._raised(row[2]))
        if not rows or rows[0][0] >= FAR:
            return 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0
        away, id, drink = rows[0]
        closing = _flat(drink.center - before.center) - away
        first = self._pasts[id][0]
        seconds = max(self._pasts[id][-1][0] - first[0], 0.1)
        speed = float(np.linalg.norm(drink.center - first[1])) / seconds
        second = rows[1][0] if len(rows) > 1 else FAR
        lifted = float(drink.center[2]) - self._lowest[id]
        reached = sum(row[0] < 0.9 for row in rows) / 4
        second = min(second, FAR) / FAR
        return away / FAR, closing, now.top - float(drink.center[2]), lifted, speed, second, reached


class AgentWindow(Remembered):
    """Sliding window of one agent's motion."""

    _looks: deque[Look]
    _begun: float | None
    _step: float
    _heights: tuple[float, float] | None

    def __init__(self) -> None:
        self._looks, self._begun, self._step, self._heights = deque(), None, 0.0, None

    def add(self, time: float, body: Body) -> None:
        """Adds the agent's body at a time; times rise. The velocity of a new rigid agent gives its earlier position."""
        if self._looks:
            self._step = time - self._looks[-1].time
        elif not body.person and body.velocity.any():  # that of a person is mostly of limbs and of what hides
            gone = _BEFORE * body.velocity * (1, 1, 0)
            self._looks.append(Look(time - _BEFORE, body.center - gone, body.size.copy()))
        self._begun = time if self._begun is None else self._begun
        self._looks.append(Look(time, body.center.copy(), body.size.copy()))
        while self._looks[0].time < time - WINDOW:
            self._looks.popleft()
        low, high = self._heights or (body.top, body.top)
        self._heights = min(low, body.top), max(high, body.top)

    def vector(self, body: Body, unseen: float, around: Surroundings, robot: Array | None) -> NDArray[np.float32]:
        """Returns (COUNT,); `unseen` seconds have gone since a sensor saw it, `robot` (2,) is where the robot is."""
        now, begun, heights = self._looks[-1], self._begun, self._heights
        assert begun is not None
        assert heights is not None
        short, long = self._since(_SHORT), self._since(_LONG)
        before = self._looks[-len(short)]
        sides = np.sort(now.size[:2])
        past = np.sort(np.array([look.size[:2] for look in self._looks]), axis=1)
        fast, rise = _slope(short)
        fast_long, rise_long = _slope(long)
        apart = 0.5 if robot is None else min(_flat(robot - now.center[:2]), 8.0) / 8
        values = [
            *map(float, (body.person, not (body.person or "rolls" in body.roles), "rolls" in body.roles)),
            min(now.time - begun, 5.0) / 5, min(unseen, 3.0) / 3, min(self._step, 1.0), apart,
            now.top, body.bottom, float(sides[1]), float(sides[0]), float(now.size[2]),
            heights[1] - now.top, now.top - heights[0],
            float(sides[1] - past[:, 1].min()), float(sides[0] - past[:, 0].min()),
            fast, fast_long, rise, rise_long,
            _flat(now.center - self._looks[0].center),
            float(sides[1] - np.sort(before.size[:2])[1]),
            *around.of(now, before),
        ]  # fmt: skip
        return np.clip(np.nan_to_num(np.array(values, np.float32)), -3, 3)

    def _since(self, seconds: float) -> list[Look]:
        """Returns the looks of so many seconds, two at least where there are two."""
        end = self._looks[-1].time
        rows = [look for look in self._looks if look.time >= end - seconds - 1e-6]
        return rows if len(rows) > 1 or len(self._looks) < 2 else [self._looks[-2], self._looks[-1]]


def _slope(looks: Sequence[Look]) -> tuple[float, float]:
    """Returns speed on the ground and of the top, m/s, by least squares."""
    if len(looks) < 2:
        return 0.0, 0.0
    t = np.array([look.time for look in looks])
    t = t - t.mean()
    weight = float(t @ t)
    if weight < 1e-6:
        return 0.0, 0.0
    velocity = t @ np.array([look.center for look in looks]) / weight
    return _flat(velocity), float(t @ np.array([look.top for look in looks])) / weight


def _flat(offset: Array) -> float:
    return math.hypot(offset[0], offset[1])


def _outside(box: Body, place: Array) -> float:
    """Returns how far a place is from a box's footprint on the ground, 0 within."""
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    dx, dy = place[0] - box.center[0], place[1] - box.center[1]
    x = max(abs(c * dx + s * dy) - box.size[0] / 2, 0.0)
    y = max(abs(-s * dx + c * dy) - box.size[1] / 2, 0.0)
    return math.hypot(x, y)
