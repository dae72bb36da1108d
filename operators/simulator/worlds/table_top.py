"""The table top: a small room with a laid table in its middle, which the robot circles, looking at it."""

from __future__ import annotations

import math

import numpy as np

from operators.simulator.people.choosers import add_chooser
from operators.simulator.people.inhabitants import add_ball, add_drinker, add_walker, arm_room
from operators.simulator.scene import Builder, Light, World, WorldOptions
from operators.simulator.shapes import Array, pose
from operators.simulator.things import furniture, objects
from operators.simulator.things.furnishing import (
    FLOOR,
    Style,
    decorate,
    lay_floor,
    line_wall,
    marks_on,
    raise_wall,
    ring,
    scatter,
    small_items,
)


def table_top(seed: int, order: WorldOptions) -> World:
    """A room of about seven metres with one table, drawn from the seed."""
    rng = np.random.default_rng([seed, 3])
    half_x, half_y, height = rng.uniform(3.4, 3.8), rng.uniform(3.4, 3.8), rng.uniform(2.4, 2.7)
    builder, style = Builder(), Style.drawn(rng)
    lay_floor(builder, (-half_x, -half_y), (half_x, half_y), height, style)
    walls = ring(half_x, half_y, height)
    walked, door_wall = (int(k) for k in rng.permutation(4)[:2])
    if order.movers:
        ways = [walls[walked].place(0.88, s * (walls[walked].length / 2 - 1.3)) for s in (-1.0, -0.3, 0.4, 1.0)]
        add_walker(builder, rng, np.array([T[:2, 3] for T in ways]))
    kept: dict[int, tuple[float, float]] = {}
    if order.movers:
        others = [k for k in range(4) if k not in (walked, door_wall)]
        for k in others[: order.people - 2]:
            half = walls[k].length / 2 - 1.5
            kept[k] = add_chooser(builder, rng, walls[k], -half, half)
    for k, wall in enumerate(walls):
        raise_wall(builder, wall, style, accent=k == 0)
        half = wall.length / 2 - 0.6
        taken: list[tuple[float, float]] = []
        free = [(-half, half)]
        if k == door_wall:
            leaf = furniture.door(rng, 0.9, 2.05, rng.uniform(0, 0.4))
            builder.put("door", leaf, wall.place(0.0, 0.0), on=FLOOR)
            taken, free = [(-0.6, 0.6)], [(-half, -0.65), (0.65, half)]
        if k in kept:
            free = [(-half, kept[k][0]), (kept[k][1], half)]
        line_wall(builder, rng, wall, free, depth=0.55)
        decorate(builder, rng, wall, windows=k % 2 == 0, taken=taken)
    _lay_table(builder, rng, order.movers)
    lights = [
        Light((0.9 * math.cos(a), 0.9 * math.sin(a), height - 0.1), rng.uniform(1.4, 1.9))
        for a in rng.uniform(0, 6) + np.array([0, 2.1, 4.2])
    ]
    landmarks = np.array(marks_on(rng, walls, (-0.3, 0.0, 0.3), 1.0))
    path = order.drive(_rosette() if order.tour else _circle(rng), at_most=0.6)
    mount = (0.0, 0.12, rng.uniform(1.15, 1.3), 0.0, math.radians(rng.uniform(15, 19)), math.pi / 2)
    return builder.world("table_top", lights, 0.62, path, landmarks, mount)


def _circle(rng: np.random.Generator) -> Array:
    """Waypoints counter-clockwise around the table: what the robot's left camera sees is the table."""
    angle = np.linspace(0, 2 * math.pi, 12, endpoint=False) + rng.uniform(0, 6)
    radius = 1.86 + 0.07 * np.sin(2 * angle + rng.uniform(0, 6))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _rosette() -> Array:
    """Waypoints of two rounds, now nearer and now farther, that cross each other three times."""
    angle = np.linspace(0, 4 * math.pi, 28, endpoint=False)
    radius = 1.78 + 0.13 * np.sin(1.5 * angle)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _lay_table(builder: Builder, rng: np.random.Generator, movers: bool) -> None:
    shape, surface = furniture.table(rng, rng.uniform(1.35, 1.6), rng.uniform(0.8, 0.95), rng.uniform(0.7, 0.76))
    T = pose(0, 0, 0, rng.uniform(-math.pi, math.pi))
    id = builder.put("table", shape, T, on=FLOOR)
    taken: list[tuple[float, float, float]] = []
    lane = -surface.half_x * rng.uniform(0.25, 0.5)
    if movers:
        sense = int(rng.choice([-1, 1]))
        taken += arm_room(surface, -0.15 * sense, sense)
        add_drinker(builder, rng, id, T, surface, -0.15 * sense, sense)
        radius = rng.uniform(0.035, 0.06)
        ends = [(T @ pose(lane, s * surface.half_y * 0.75))[:2, 3] for s in (-1, 1)]
        add_ball(builder, rng, ends[0], ends[1], radius=radius, z=surface.z, on=id, seconds=3.5)
        steps = np.linspace(-0.8, 0.8, 24) * surface.half_y
        taken += [(lane, float(y), radius + 0.015) for y in steps]
    items = small_items(rng, 9)
    items.insert(0, ("mug", objects.mug(rng)))
    items.insert(0, ("bottle", objects.bottle(rng)))
    if rng.uniform() < 0.6:
        items.insert(0, ("lamp", furniture.table_lamp(rng)))
    scatter(builder, rng, id, T, surface, items, taken=taken)
