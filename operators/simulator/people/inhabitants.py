"""Brings movers into a world: persons with their chairs and mugs, balls and robots, and what touches what and when."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from operators.simulator.people.body import drawn_body
from operators.simulator.people.movers import CarriedObject, Driving, Rolling
from operators.simulator.people.persons import Person
from operators.simulator.people.scripts import Point, Polyline, Timeline, coffee_break, errand, pacing
from operators.simulator.scene import ROVER, WALKER, Builder
from operators.simulator.shapes import Array, Shape, pose
from operators.simulator.things import furniture, objects
from operators.simulator.things.furnishing import FLOOR, Wall, put_desk
from operators.simulator.things.furniture import Surface
from operators.simulator.trajectory import Trajectory

Rng = np.random.Generator

_BESIDE = 0.48  # metres between the table's edge and the middle of a chair that stands beside it


@dataclass(frozen=True, eq=False)
class Place:
    """A chair beside a table and the mug in reach: the person sits parallel to the table's edge."""

    chair: int
    table: int
    mug: int
    T_mug: Array
    pelvis: Array
    yaw: float
    hand: int
    stand: Array
    """(2,) where one stands before sitting down."""


def set_place(
    builder: Builder, rng: Rng, table: int, T_table: Array, surface: Surface, along: float, sense: int
) -> Place:
    """A swivel chair on the table's +x side at `along` (y), facing along y by `sense` (1 or -1), and a mug."""
    shape, seat = furniture.chair(rng, swivel=True)
    edge = surface.x + surface.half_x + 0.04
    yaw = sense * math.pi / 2
    T_chair = T_table @ pose(edge + _BESIDE, along, 0, yaw)
    chair = builder.put("chair", shape, T_chair, on=FLOOR)
    T_mug = T_table @ pose(edge - 0.1, along + sense * 0.3, surface.z, rng.uniform(-3, 3))
    T_pelvis = T_chair @ pose(-0.05, 0, seat + 0.1)
    mug = builder.new_id()
    heading = math.atan2(T_chair[1, 0], T_chair[0, 0])
    stand = (T_chair @ pose(0.42, 0, 0))[:2, 3]
    return Place(chair, table, mug, T_mug, T_pelvis[:3, 3], heading, 0 if sense > 0 else 1, stand)


def arm_room(surface: Surface, along: float, sense: int) -> list[tuple[float, float, float]]:
    """Circles (x, y, radius) on the table that the mug of a place needs, and the arm that reaches for it."""
    return [(surface.x + surface.half_x - 0.06, along + sense * ahead, 0.2) for ahead in (-0.05, 0.1, 0.25, 0.4)]


def seat_person(builder: Builder, rng: Rng, place: Place, path: Array, timeline: Timeline) -> int:
    """The person of a place, the mug, and their contacts; returns the person's id."""
    body = drawn_body(rng)
    # The hand takes the mug at its side, from where the person sits.
    side = place.pelvis[:2] - place.T_mug[:2, 3]
    side = side / np.linalg.norm(side)
    grasp = place.T_mug[:3, 3] + np.array([0.055 * side[0], 0.055 * side[1], 0.055])
    pelvis = place.pelvis + np.array([0, 0, 0.012 * body.height])
    timeline = timeline.with_place(as_point(pelvis), as_point(grasp))
    person = Person(body, path, timeline, hand=place.hand)
    id = builder.new_id()
    builder.move("person", body.parts, person, id=id)
    carry(builder, person, place.mug, objects.mug(rng), "mug", place.T_mug, place.table)
    builder.relate(id, "holding", place.mug, lambda t: person.held(t) == place.mug)
    builder.relate(id, "sitting_on", place.chair, lambda t: person.seat(t) is not None)
    builder.relate(id, "on", FLOOR, lambda t: person.seat(t) is None)
    builder.relate(id, "reaching_for", place.mug, lambda t: person.reached_for(t) == place.mug)
    builder.scripts.append(lambda t: person.doing(id, t))
    builder.reserve(id, np.concatenate([Polyline(path).line(), place.pelvis[None, :2]]), WALKER)
    return id


def carry(builder: Builder, person: Person, id: int, shape: Shape, label: str, T: Array, on: int) -> None:
    """A thing that lies on another one and that a person takes and puts back by a script."""
    acts, timeline = person.timeline.acts, person.timeline
    first = next(k for k, act in enumerate(acts) if act.object == id and act.activity == "reaching")
    reached = sum(act.seconds for act in acts[: first + 1])
    builder.move(label, (shape,), CarriedObject(id, T, person, reached - 1e-6 - timeline.phase), id=id)
    builder.relate(id, "on", on, lambda t: person.held(t) != id)


def as_point(p: Array) -> Point:
    """A place (3,) as a tuple."""
    return float(p[0]), float(p[1]), float(p[2])


def add_desk_worker(builder: Builder, rng: Rng, wall: Wall, along: float, sense: int, far: float, out: float) -> int:
    """A desk at a wall, and a person who comes along the wall, `out` metres off, from `far`, sits down and drinks."""
    surface_guess = Surface(0, 0, 0.74, 0.34, 0.7)
    T = wall.place(0.42, along)
    desk = put_desk(
        builder, rng, T, rng.uniform(1.3, 1.6), items=4, chair=False, keep_free=arm_room(surface_guess, 0.0, sense)
    )
    place = set_place(builder, rng, desk.id, T, desk.surface, 0.0, sense)
    waypoints = [(out, far), (out, along + 0.6 * (far - along)), (out - 0.05, along + sense * 1.25)]
    path = np.array([wall.place(d, s)[:2, 3] for d, s in waypoints] + [place.stand])
    timeline = errand(path, place.yaw, place.mug, desk.id, phase=rng.uniform(0, 30))
    return seat_person(builder, rng, place, path, timeline)


def add_drinker(
    builder: Builder, rng: Rng, table: int, T_table: Array, surface: Surface, along: float, sense: int
) -> int:
    """A person who sits beside a table all the time and drinks now and then."""
    place = set_place(builder, rng, table, T_table, surface, along, sense)
    timeline = coffee_break(place.yaw, place.mug, phase=rng.uniform(0, 12))
    return seat_person(builder, rng, place, place.stand[None], timeline)


def add_walker(builder: Builder, rng: Rng, path: Array) -> int:
    """A person who walks a path to and fro."""
    body = drawn_body(rng)
    person = Person(body, path, pacing(path, walk=rng.uniform(0.55, 0.75), phase=rng.uniform(0, 30)))
    id = builder.move("person", body.parts, person)
    builder.reserve(id, Polyline(path).line(), WALKER)
    builder.relate(id, "on", FLOOR)
    builder.scripts.append(lambda t: person.doing(id, t))
    return id


def add_ball(
    builder: Builder,
    rng: Rng,
    a: Array,
    b: Array,
    *,
    radius: float,
    z: float = 0.0,
    on: int = FLOOR,
    seconds: float = 4.0,
) -> int:
    """A ball that rolls between two points (2,)."""
    rolling = Rolling(a, b, radius, z=z, seconds=seconds, phase=rng.uniform(0, 10))
    shape = objects.ball(rng, radius)
    id = builder.move("ball", (shape,), rolling)
    builder.reserve(id, np.array([a, b]), radius)
    builder.relate(id, "on", on)
    builder.scripts.append(lambda t: rolling.doing(id, t))
    return id


def add_rover(builder: Builder, rng: Rng, waypoints: Array, *, speed: float = 0.3) -> int:
    """A robot that drives a closed path."""
    path = Trajectory(waypoints, speed=speed, turn_rate=1.2)
    driving = Driving(path, phase=rng.uniform(0, path.period))
    shape = furniture.rover(rng)
    id = builder.move("robot", (shape,), driving)
    builder.reserve(id, path.outline(), ROVER)
    builder.relate(id, "on", FLOOR)
    builder.scripts.append(lambda t: driving.doing(id, t))
    return id
