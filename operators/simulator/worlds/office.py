"""The office: a room with desks and shelves along its walls, a table in its middle that the robot drives around."""

from __future__ import annotations

import math

import numpy as np

from operators.simulator.people.choosers import add_chooser
from operators.simulator.people.inhabitants import add_ball, add_desk_worker, add_rover, add_walker
from operators.simulator.scene import WALKER, Builder, Light, World, WorldOptions
from operators.simulator.shapes import Array, pose
from operators.simulator.things import furniture
from operators.simulator.things.furnishing import (
    FLOOR,
    Style,
    Wall,
    decorate,
    lay_floor,
    line_wall,
    marks_on,
    raise_wall,
    ring,
    scatter,
    small_items,
)

REACH = 2.45
"""Metres between the walls and the robot's path: furniture, then room for those who walk, roll or drive there."""

OUT = 1.8
"""Metres between a wall and the middle of its lane."""


def office(seed: int, order: WorldOptions) -> World:
    """A world of about nine by eight metres, drawn from the seed."""
    rng = np.random.default_rng([seed, 1])
    half_x, half_y, height = rng.uniform(4.3, 5.0), rng.uniform(3.7, 4.2), rng.uniform(2.5, 2.9)
    builder, style = Builder(), Style.drawn(rng)
    lay_floor(builder, (-half_x, -half_y), (half_x, half_y), height, style)
    walls = ring(half_x, half_y, height)
    accent = int(rng.integers(4))
    door_wall = int(rng.integers(4))
    cast = order.cast(["worker", "walker", "ball", "rover"])
    roles = [str(role) for role in rng.permutation(cast)] if order.movers else [""] * 4
    while roles[door_wall] in ("worker", "chooser"):
        door_wall = (door_wall + 1) % 4
    turn = int(rng.choice([-1, 1]))
    kept = [_inhabit(builder, rng, wall, role, turn) if role else None for wall, role in zip(walls, roles, strict=True)]
    for k, wall in enumerate(walls):
        raise_wall(builder, wall, style, accent=k == accent)
        half = wall.length / 2 - 0.75  # the corners stay free: furniture of two walls would meet there
        free = [(-half, half)]
        taken: list[tuple[float, float]] = []
        if k == door_wall:
            middle, width = rng.uniform(-0.4, 0.4) * half, rng.uniform(0.85, 0.95)
            shape = furniture.door(rng, width, rng.uniform(2.0, 2.1), rng.uniform(0.0, 0.9))
            builder.put("door", shape, wall.place(0.0, middle), on=FLOOR)
            free = [(-half, middle - 0.75), (middle + 0.75, half)]
            taken.append((middle - 0.65, middle + 0.65))
        span = kept[k]
        if span is not None:
            free = [(-half, span[0]), (span[1], half)]
        line_wall(builder, rng, wall, free)
        decorate(builder, rng, wall, windows=k in (0, 2), taken=taken)

    a, b = half_x - REACH, half_y - REACH
    path = order.drive(_tour(a, b) if order.tour else _loop(rng, a, b))
    if order.tour:
        for side in (-1, 1):
            _island(builder, rng, 0.42, x=side * 0.55 * a)
    else:
        _island(builder, rng, min(a, b) - 0.42)
    lights = [
        Light((sx * half_x * 0.5, sy * half_y * 0.5, height - 0.1), rng.uniform(1.7, 2.2))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    landmarks = np.array(marks_on(rng, walls, (-0.36, -0.12, 0.12, 0.36), 1.0, astray=0.05))
    pitch = math.radians(rng.uniform(7, 11))
    mount = (0.12, 0.0, rng.uniform(0.95, 1.15), 0.0, pitch, 0.0)
    return builder.world("office", lights, 0.62, path, landmarks, mount)


def _loop(rng: np.random.Generator, a: float, b: float) -> Array:
    """Waypoints of an uneven oval, counter-clockwise."""
    angle = np.linspace(0, 2 * math.pi, 12, endpoint=False) + rng.uniform(0, 2 * math.pi)
    wobble = 1 - 0.06 * (1 + np.sin(3 * angle + rng.uniform(0, 6)))
    return np.stack([a * wobble * np.cos(angle), b * wobble * np.sin(angle)], axis=1)


def _tour(a: float, b: float) -> Array:
    """Waypoints once around counter-clockwise, then as an eight: the way crosses itself in the middle of the room.

    The left half is driven in both directions.
    """
    around = [-55, -20, 20, 55, 90, 125, 160, 200, 235, 270, 305, 340, 380, 415]
    back = [235, 200, 160, 125]
    rim = [(0.95 * a * math.cos(math.radians(t)), 0.95 * b * math.sin(math.radians(t))) for t in (*around, *back)]
    middle = (0.0, 0.0)
    return np.array([middle, *rim[: len(around)], middle, *rim[len(around) :]])


def _inhabit(
    builder: Builder, rng: np.random.Generator, wall: Wall, role: str, turn: int
) -> tuple[float, float] | None:
    """Someone or something that moves along a wall, between its furniture and the robot's path.

    Lanes lie like the vanes of a pinwheel that turns by `turn` (1 or -1): each goes on into the corner at one end of
    its wall and stops at the other before the lane that comes from there. Returns the span of the wall that is kept
    free for its own furniture, if any.
    """
    corner = wall.length / 2 - 1.25
    stop = -(wall.length / 2 - OUT - 2 * WALKER - 0.1)

    def places(*points: tuple[float, float]) -> Array:
        """(N, 2) of (metres from `OUT` to the robot's path, share of the way from `stop` to `corner`)."""
        return np.array([wall.place(OUT + d, turn * (stop + s * (corner - stop)))[:2, 3] for d, s in points])

    if role == "worker":
        desk = turn * max(-0.35 * (wall.length / 2 - 0.75), 3.1 - wall.length / 2)
        add_desk_worker(builder, rng, wall, desk, turn, turn * corner, OUT)
        return desk - 1.2, desk + 1.2
    if role == "chooser":
        low, high = sorted((turn * (stop - 0.11), turn * corner))
        return add_chooser(builder, rng, wall, low, high)
    if role == "walker":
        add_walker(builder, rng, places((0.0, 0.0), (0.03, 0.35), (0.0, 0.7), (0.0, 1.0)))
    elif role == "ball":
        a, b = places((0.0, 0.1), (0.0, 0.9))
        add_ball(builder, rng, a, b, radius=rng.uniform(0.09, 0.15), seconds=rng.uniform(4, 6))
    else:
        angle = np.linspace(0, 2 * math.pi, 8, endpoint=False)
        add_rover(builder, rng, places(*((0.14 * math.sin(a) - 0.03, 0.5 + 0.5 * math.cos(a)) for a in angle)))
    return None


def _island(builder: Builder, rng: np.random.Generator, radius: float, *, x: float = 0.0) -> None:
    """A small table in the middle of the room or `x` metres beside it, within a circle, and what lies on it."""
    length, depth = radius * rng.uniform(1.25, 1.4), radius * rng.uniform(0.8, 1.0)
    shape, surface = furniture.table(rng, length, depth, rng.uniform(0.45, 0.75))
    T = pose(x, 0, 0, rng.uniform(-math.pi, math.pi))
    id = builder.put("table", shape, T, on=FLOOR)
    scatter(builder, rng, id, T, surface, small_items(rng, 6))
