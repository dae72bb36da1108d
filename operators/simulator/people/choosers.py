"""Persons who choose: a counter with drinks, chairs beside it, and a person who goes from one to another.

Where such a person goes next is not known from where it is: there are four drinks and two seats, and the way to most of
them leads past others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from operators.simulator.people.body import varied_body
from operators.simulator.people.inhabitants import as_point, carry
from operators.simulator.people.persons import Person
from operators.simulator.people.scripts import Act, Point, Polyline, Timeline, drinking
from operators.simulator.scene import WALKER, Builder
from operators.simulator.shapes import Array, Shape, pose
from operators.simulator.things import furniture, objects
from operators.simulator.things.furnishing import FLOOR, Wall

Rng = np.random.Generator

OUT = 0.8
"""Metres between the wall and the way that the person walks along it."""

LEAST = 3.2
"""Metres along a wall that counter and chairs take."""

_DRINKS, _SEATS, _ERRANDS = 4, 2, 8
_COUNTER, _SEAT = 1.6, 0.75  # metres along the wall
_BESIDE = 0.19  # metres that the person stands beside a thing that its right hand takes


@dataclass(frozen=True)
class Candidate:
    """A drink or a seat to choose: `stand` is where along the wall the person stands for it."""

    id: int
    label: str
    stand: float
    place: Point
    """The place at which the hand grips it, or of the pelvis on it."""


def add_chooser(builder: Builder, rng: Rng, wall: Wall, low: float, high: float) -> tuple[float, float]:
    """The furniture, and the person who walks along it between `low` and `high` (m along the wall).

    Returns the span of the wall that is taken. Raises ValueError where it is too short.
    """
    if high - low < LEAST:
        raise ValueError(f"a counter with chairs takes {LEAST} m of a wall, there are {high - low:.2f}")
    body = varied_body(rng)
    start = rng.uniform(low, high - LEAST) + 0.05
    order = rng.permutation(["counter", "seat", "seat"])
    candidates: list[Candidate] = []
    drinks: list[tuple[int, Shape, str, Array, int]] = []
    along = start
    for kind in order:
        width = _COUNTER if kind == "counter" else _SEAT
        if kind == "counter":
            table, shelf = _counter(builder, rng, wall, along + width / 2)
            for k in range(_DRINKS):
                beside = (k - (_DRINKS - 1) / 2) * 0.4 + rng.uniform(-0.03, 0.03)
                label = ("mug", "bottle")[int(rng.integers(2))]
                T = shelf @ pose(0.05, beside, 0.0, rng.uniform(-3, 3))
                id = builder.new_id()
                drinks.append((id, objects.mug(rng) if label == "mug" else objects.bottle(rng), label, T, table))
                grip = T[:3, 3] + 0.055 * wall.T_world_wall[:3, 0] + [0, 0, 0.065]
                candidates.append(Candidate(id, label, along + width / 2 + beside - _BESIDE, as_point(grip)))
        else:
            middle = along + width / 2
            shape, height = furniture.chair(rng)
            T = wall.place(OUT - 0.44, middle)
            chair = builder.put("chair", shape, T, on=FLOOR)
            pelvis = (T @ pose(-0.05, 0, height + 0.1 + 0.012 * body.height))[:3, 3]
            candidates.append(Candidate(chair, "chair", middle, as_point(pelvis)))
        along += width
    ends = [min(c.stand for c in candidates), max(c.stand for c in candidates)]
    path = np.array([wall.place(OUT, s)[:2, 3] for s in ends])
    timeline = errands(rng, candidates, ends[0], _facing(wall), _chosen(rng, candidates))
    person = Person(body, path, timeline)
    id = builder.move("person", body.parts, person)
    for drink, shape, label, T, table in drinks:
        carry(builder, person, drink, shape, label, T, table)
        builder.relate(id, "holding", drink, partial(_is, person.held, drink))
        builder.relate(id, "reaching_for", drink, partial(_is, person.reached_for, drink))
    for seat in (c for c in candidates if c.label == "chair"):
        builder.relate(id, "sitting_on", seat.id, partial(_is, person.seat, seat.place))
    builder.relate(id, "on", FLOOR, lambda t: person.seat(t) is None)
    builder.scripts.append(lambda t: person.doing(id, t))
    builder.reserve(id, Polyline(path).line(), WALKER)
    return start - 0.1, along + 0.1


def _is(state: Callable[[float], object], value: object, t: float) -> bool:
    """Returns whether a state has a value at a time."""
    return state(t) == value


def _counter(builder: Builder, rng: Rng, wall: Wall, along: float) -> tuple[int, Array]:
    """A high, narrow table at the wall; its id and `T_world_top`."""
    depth = rng.uniform(0.4, 0.44)
    shape, surface = furniture.table(rng, _COUNTER - 0.06, depth, rng.uniform(0.86, 0.9))
    T = wall.place(0.03 + depth / 2, along)
    return builder.put("table", shape, T, on=FLOOR), T @ pose(z=surface.z)


def _facing(wall: Wall) -> float:
    """Heading of who looks into the room, the wall behind."""
    return math.atan2(wall.T_world_wall[1, 0], wall.T_world_wall[0, 0])


def _chosen(rng: Rng, candidates: list[Candidate]) -> list[Candidate]:
    """Returns what is chosen, one after the other and again and again: each thing at least once, none twice in a
    row."""
    while True:
        extra = rng.integers(len(candidates), size=_ERRANDS - len(candidates))
        order = rng.permutation([*range(len(candidates)), *extra])
        if all(a != b for a, b in zip(order, np.roll(order, 1), strict=True)):
            return [candidates[int(k)] for k in order]


def errands(rng: Rng, candidates: list[Candidate], origin: float, facing: float, chosen: list[Candidate]) -> Timeline:
    """Goes to each of the chosen things in turn; whole numbers in goals are ids.

    `origin` is the place along the wall at which the way begins, `facing` the heading of who looks into the room. From
    the first look towards a thing until it is left, it is the goal.
    """
    acts: list[Act] = []
    forwards = facing + math.pi / 2  # the wall's y axis
    for before, now in zip([chosen[-1], *chosen[:-1]], chosen, strict=True):
        goal = f"sit down on chair {now.id}" if now.label == "chair" else f"drink from {now.label} {now.id}"
        here, there = before.stand - origin, now.stand - origin
        toward = facing if now.label == "chair" else facing + math.pi
        come = facing if before.label == "chair" else facing + math.pi
        go = forwards if there >= here else forwards + math.pi
        acts.append(Act("standing", float(rng.uniform(1.0, 2.5)), goal, (here, here), (come, go)))
        acts.append(Act("walking", max(1.2, abs(there - here) / 0.6), goal, (here, there)))
        acts.append(Act("standing", 0.9, goal, (there, there), (go, toward)))
        at, look = (there, there), (toward, toward)
        if now.label == "chair":
            acts += _sitting(rng, Act("sitting", 0.0, goal, at, look, seat=now.place))
        else:
            acts += drinking(Act("drinking", 0.0, goal, at, look, grasp=now.place), now.id)
    return Timeline(acts, phase=float(rng.uniform(0, sum(act.seconds for act in acts))))


def _sitting(rng: Rng, acting: Act) -> list[Act]:
    return [
        replace(acting, activity="sitting_down", seconds=1.7, sit=(0.0, 1.0)),
        replace(acting, seconds=float(rng.uniform(4, 8)), sit=(1.0, 1.0)),
        replace(acting, activity="standing_up", seconds=1.6, sit=(1.0, 0.0)),
    ]
