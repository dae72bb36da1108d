"""Relations of upright boxes in space, each with a score in [0, 1].

`supports`, `right_of` and `behind` are the inverses of `on`, `left_of` and `in_front_of`, and not stored twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.scene.bodies import Body, BoxPairs

Array = NDArray[np.float64]
Relation = tuple[int, str, int]
"""Subject, predicate, object: ids of nodes."""

INVERSES = {"supports": "on", "right_of": "left_of", "behind": "in_front_of"}
PREDICATES = (
    "on",
    "in",
    "under",
    "above",
    "near",
    "left_of",
    "in_front_of",
    "part_of",
    "sitting_on",
    "holding",
    "facing",
    "approaching",
    "reaching_for",
    "heads_for",
    "connected_to",
)
SYMMETRIC = frozenset({"near", "connected_to"})
"""Predicates that hold both ways, and are stored once."""

FLOOR, ROBOT, ROOM = 0, -1, -2
"""Ids of nodes that are not objects."""

AT_ONCE = frozenset({"left_of", "in_front_of"})
"""Predicates judged from where the robot is, which changes as it turns: a mean over time would show where it looked."""

_STEEP = 12.5  # by so much the score of these rises, by the share of the larger difference by which it leads

TABLETOP = "tabletop"
"""Class of the surfaces above the floor on which things stand."""

SURFACE = -10
"""Ids below this are surfaces other than the floor: walls, table tops, ceilings; or rooms, far below it."""


@dataclass(frozen=True)
class RelationRules:
    """Lengths in metres, speeds in m/s.

    `flat` is by how much the plane of a surface is off: the middle of what lies flat on it may be so far below it.
    """

    touch: float = 0.08
    flat: float = 0.03
    near: float = 0.5
    side: float = 0.15
    above: float = 1.0
    hand: float = 0.35
    small: float = 0.4
    closing: float = 0.2


def relations_of(
    bodies: Sequence[Body], T_world_robot: Array | None, rules: RelationRules, known: BoxPairs | None = None
) -> dict[Relation, float]:
    """Returns the relations that hold now between nodes, surfaces and robot among them, with their scores.

    A thing may stand on a table and on that table's top, which is part of it.
    `known` spares what was worked out before for pairs of bodies that are where they were.
    """
    finder = _Finder(BoxPairs() if known is None else known, rules)
    finder.boxes.update(bodies)
    found = finder.found
    things = sorted((b for b in bodies if b.id > FLOOR), key=lambda b: b.id)
    tops = [b for b in bodies if b.id < SURFACE and b.label == TABLETOP]
    floor = next((b for b in bodies if b.id == FLOOR), None)
    held: set[int] = set()
    centers = np.array([b.center for b in things]).reshape(-1, 3)
    spheres = _gaps(centers, np.array([b.radius for b in things]))
    agents = np.array([b.agent for b in things], bool)
    around = _pairs(things, (spheres <= 1.5 + rules.above) & agents[:, None])
    stacks = _pairs(things, _gaps(centers[:, :2], np.array([b.flat_radius for b in things])) <= 0.0)
    beside = _pairs(things, np.triu(spheres <= 1.2 * rules.near))  # each two once, since ids rise
    for person in things:
        if person.agent:
            held |= finder.contact(person, [b for b in around[person.id] if not b.agent], things)
    sitting = {s for s, p, _ in found if p == "sitting_on"}
    for body in things:
        if body.id not in held and body.id not in sitting:
            hidden = 0.0 if floor is None or body.agent else body.hidden_foot(floor.top)
            finder.placed(body, stacks[body.id], floor, hidden)
            if not body.person:
                finder.on_top(body, tops, hidden)
    seen: dict[int, list[float]] = {}
    if T_world_robot is not None:
        seen = {b.id: (T_world_robot[:3, :2].T @ b.center).tolist() for b in things}
    for first in things:
        for second in stacks[first.id]:
            finder.stacked(first, second)
        for second in beside[first.id]:
            finder.beside(first, second, seen)
        if first.agent:
            for second in around[first.id]:
                finder.moving(first, second)
    for top in tops:
        finder.part(top, things)
    if any(b.id == ROOM for b in bodies):
        building = [b for b in bodies if b.id == FLOOR or (b.id < SURFACE and b not in tops)]
        found |= {(b.id, "part_of", ROOM): 1.0 for b in building}
    return found


def _gaps(centers: Array, radii: Array) -> Array:
    """Returns how far spheres, or circles, are apart (N, N); below 0 where they overlap."""
    square = np.zeros((len(centers), len(centers)))
    for along in centers.T:
        apart = along - along[:, None]
        square += apart * apart
    return np.asarray(np.sqrt(square) - radii - radii[:, None])


def _pairs(things: Sequence[Body], near: NDArray[np.bool_]) -> dict[int, list[Body]]:
    """Returns the other things that are near each one (N, N), by its id."""
    close: dict[int, list[Body]] = {b.id: [] for b in things}
    for k, j in zip(*(found.tolist() for found in np.nonzero(near)), strict=True):
        if k != j:
            close[things[k].id].append(things[j])
    return close


@dataclass
class _Finder:
    """Finds relations of bodies, two by two, and keeps them with their scores."""

    boxes: BoxPairs
    rules: RelationRules
    found: dict[Relation, float] = field(default_factory=dict)

    def placed(self, body: Body, others: Sequence[Body], floor: Body | None, hidden: float) -> None:
        """Finds what a thing is in, or else what it stands or lies on: one thing at most.

        `hidden` is how surely it stands on the floor and something hides its foot: then it is not on what its box ends
        at.
        """
        best: tuple[float, str, int] = (0.0, "", 0)
        for other in others:
            if other.agent:
                continue
            off = abs(body.bottom - other.top)
            upon = off <= 2 * self.rules.touch and body.height > other.top - self.rules.flat
            if not upon and min(body.top, other.top) <= max(body.bottom, other.bottom):
                continue
            share = self.boxes.share(body, other)
            if "container" in other.roles and other.volume > 1.5 * body.volume and share > 0.3:
                inside = min(body.top, other.top) - max(body.bottom, other.bottom)
                deep = inside / max(float(body.size[2]), 1e-3)
                if deep > 0.5 and body.height < other.top - 0.02:
                    best = max(best, (0.5 * min(1.0, share / 0.6) + 0.5 * min(1.0, deep), "in", other.id))
                    continue
            if share > 0.3 and upon:
                score = min(1.0, share / 0.6) * (1 - 0.5 * off / (2 * self.rules.touch)) * (1 - hidden)
                best = max(best, (score, "on", other.id))
        height = body.bottom if floor is None else body.bottom - floor.top
        if best[0] < 0.5 and floor is not None and height <= 0.3:
            best = max(best, (1 - max(0.0, height) / 0.6, "on", FLOOR))
        best = max(best, (hidden, "on", FLOOR))
        if best[0] > 0:
            self.found[body.id, best[1], best[2]] = best[0]

    def on_top(self, body: Body, tops: Sequence[Body], hidden: float) -> None:
        """Finds the surface above the floor that a thing stands or lies on; `hidden` as in `placed`."""
        best: tuple[float, int] = (0.0, 0)
        for top in tops:
            off = abs(body.bottom - top.top)
            upon = body.center[2] > top.top - self.rules.flat
            if off <= 2 * self.rules.touch and upon and (share := self.boxes.share(body, top)) > 0.3:
                score = min(1.0, share / 0.6) * (1 - 0.5 * off / (2 * self.rules.touch)) * (1 - hidden)
                best = max(best, (score, top.id))
        if best[0] > 0:
            self.found[body.id, "on", best[1]] = best[0]

    def part(self, top: Body, things: Sequence[Body]) -> None:
        """Finds the thing that a surface above the floor is the top of."""
        best: tuple[float, int] = (0.0, 0)
        for body in things:
            off = abs(body.top - top.top)
            if not body.agent and off <= 3 * self.rules.touch and (share := self.boxes.share(top, body)) > 0.5:
                best = max(best, (share * (1 - 0.5 * off / (3 * self.rules.touch)), body.id))
        if best[0] > 0:
            self.found[top.id, "part_of", best[1]] = best[0]

    def stacked(self, first: Body, second: Body) -> None:
        """Finds above and under of things that do not touch."""
        between = first.bottom - second.top
        if self.rules.touch < between <= self.rules.above and self.boxes.share(first, second) > 0.5:
            self.found[first.id, "above", second.id] = 1 - 0.5 * between / self.rules.above
        if second.top > first.top and second.bottom < first.bottom + 0.1 and not second.agent:
            share = self.boxes.share(first, second)  # it stands beneath a table: within its box
            if share > 0.4 and "container" not in second.roles and first.top < second.top - self.rules.touch:
                self.found[first.id, "under", second.id] = share

    def beside(self, first: Body, second: Body, seen: Mapping[int, Sequence[float]]) -> None:
        """Finds near, and of things near each other which is left of or in front of the other.

        `seen` are how far ahead and how far left each is for the robot; empty without one. That of the two whose
        difference is the larger one, and at least `side`, has a score from 0.5 on; that of the other falls fast.
        """
        apart = self.boxes.gap(first, second)
        if apart > 1.2 * self.rules.near:
            return
        self.found[first.id, "near", second.id] = min(max(1 - 0.5 * apart / self.rules.near, 0.0), 1.0)
        if not seen or apart > self.rules.near:
            return
        x, y = (a - b for a, b in zip(seen[first.id], seen[second.id], strict=True))
        for predicate, own, other in (("left_of", y, abs(x)), ("in_front_of", -x, abs(y))):
            least = max(other, self.rules.side)
            score = 0.5 + _STEEP * (abs(own) - least) / least
            if score > 0:
                a, b = (first.id, second.id) if own > 0 else (second.id, first.id)
                self.found[a, predicate, b] = min(1.0, score)

    def contact(self, person: Body, others: Sequence[Body], things: Sequence[Body]) -> set[int]:
        """Finds what an agent sits on and what it holds; returns the ids of what is held."""
        held = set()
        for other in others:
            if "seat" in other.roles and person.person:
                away = _from_middle(person.center, other)
                low = person.top - other.bottom < 1.5
                if away < 0.45 and low:
                    self.found[person.id, "sitting_on", other.id] = 1 - away
            elif float(other.size.max()) <= self.rules.small and person.person:
                supported = any(
                    abs(other.bottom - b.top) < self.rules.touch and self.boxes.share(other, b) > 0.3
                    for b in things
                    if not b.agent and b.id != other.id
                )
                lifted = 0.5 < other.center[2] - person.bottom < float(person.size[2]) + 0.1
                if not supported and lifted and self.boxes.gap(person, other) < self.rules.hand / 2:
                    self.found[person.id, "holding", other.id] = 1 - self.boxes.gap(person, other) / self.rules.hand
                    held.add(other.id)
        return held

    def moving(self, agent: Body, other: Body) -> None:
        """Finds facing and approaching of an agent that moves: it faces the way it goes."""
        speed = float(np.hypot(*agent.velocity[:2]))
        way = (other.center - agent.center)[:2]
        distance = float(np.hypot(*way))
        if speed < self.rules.closing or distance < 0.1:
            return
        cosine = float(agent.velocity[:2] @ way) / (speed * distance)
        if cosine > 0.85:
            self.found[agent.id, "facing", other.id] = cosine
        closing = cosine * speed - float(other.velocity[:2] @ way) / distance
        if cosine > 0.9 and closing > self.rules.closing and distance < 3:
            self.found[agent.id, "approaching", other.id] = cosine * min(1.0, closing / 0.4)


def _from_middle(place: Array, seat: Body) -> float:
    """Returns how far a place is on the ground from the line in the middle of a seat on which persons sit, metres.

    It is as long as the seat is longer than wide: persons sit anywhere along a bench.
    """
    c, s = np.cos(seat.yaw), np.sin(seat.yaw)
    x, y = (place - seat.center)[:2].tolist()
    along, across = abs(c * x + s * y), abs(c * y - s * x)
    longer = float(seat.size[0] - seat.size[1]) / 2
    return float(np.hypot(max(along - max(longer, 0.0), 0.0), max(across - max(-longer, 0.0), 0.0)))


class Hysteresis(Remembered):
    """Smooths scores over time: a relation begins where its mean reaches `begin` and ends where it falls to `end`.

    Those of `AT_ONCE` do so by the score of the moment.
    """

    _means: dict[Relation, float]
    _held: dict[Relation, None]
    _stamp: int | None

    def __init__(self, begin: float, end: float, seconds: float) -> None:
        self._begin, self._end, self._seconds = begin, end, seconds
        self._means, self._held, self._stamp = {}, {}, None
        self.restored()

    def restored(self) -> None:
        self._ordered: list[Relation] | None = None  # what is held; None where that has to be sorted anew

    def update(
        self, stamp: int, now: dict[Relation, float]
    ) -> tuple[dict[Relation, float], list[Relation], list[Relation]]:
        """Returns what holds, with its mean score, what begins, and what ends."""
        share = 1.0
        if self._stamp is not None:
            share = 1 - float(np.exp(-(stamp - self._stamp) * 1e-9 / self._seconds))
        self._stamp = stamp
        means = {
            r: now.get(r, 0.0) if r[1] in AT_ONCE else before + share * (now.get(r, 0.0) - before)
            for r, before in self._means.items()
        }
        for relation in sorted(now.keys() - means.keys()):
            means[relation] = now[relation] if relation[1] in AT_ONCE else share * now[relation]
        began = sorted(r for r in now if r not in self._held and means[r] >= self._begin)
        ended = [r for r in self._held if means[r] <= self._end]
        for relation in began:
            self._held[relation] = None
        for relation in ended:
            del self._held[relation]
        if began or ended or self._ordered is None:
            self._ordered = sorted(self._held)
        self._means = {r: m for r, m in means.items() if m > 0.02}
        return {r: min(means[r], 1.0) for r in self._ordered}, began, ended

    def forget(self, ids: set[int]) -> None:
        """Drops the relations of nodes that are no more."""
        self._means = {r: m for r, m in self._means.items() if not {r[0], r[2]} & ids}
        self._held = {r: None for r in self._held if not {r[0], r[2]} & ids}
        self._ordered = None
