"""The yard: a hall with two gates and a yard before it under the open sky, which the robot drives through in turn."""

from __future__ import annotations

import math

import numpy as np

from operators.simulator.people.choosers import add_chooser
from operators.simulator.people.inhabitants import add_ball, add_rover, add_walker
from operators.simulator.scene import Builder, Light, World, WorldOptions
from operators.simulator.shapes import Array, Material, box, pose, sheet
from operators.simulator.things import furniture
from operators.simulator.things.furnishing import (
    FLOOR,
    Style,
    Wall,
    decorate,
    lay_floor,
    line_wall,
    marks_on,
    put_boxes,
    raise_wall,
    scatter,
    small_items,
)
from operators.simulator.things.furniture import tone

Rng = np.random.Generator

GATE, WIDTH, OPEN = 2.6, 1.9, 2.4
"""Metres from the middle to each gate, a gate's width and height."""

HALL, DEPTH = 9.0, 5.0
"""Metres from the front to the back of the hall, and half of its width."""

FENCE = 1.4
"""Height of the wall around the yard, metres."""


def yard(seed: int, order: WorldOptions) -> World:
    """A hall of nine by ten metres and a yard of about twelve by thirteen, drawn from the seed."""
    rng = np.random.default_rng([seed, 4])
    length, half, height = rng.uniform(11.5, 13.0), rng.uniform(6.4, 7.0), rng.uniform(3.1, 3.5)
    builder, style = Builder(), Style.drawn(rng)
    lay_floor(builder, (-HALL, -DEPTH), (0.0, DEPTH), height, style)
    ground = Material(("asphalt", "grass")[int(rng.integers(2))], tone(rng, (0.05, 0.2), (0.0, 0.2), (0.8, 1.0)), 1.2)
    builder.surface("floor", (sheet((0, -half, 0), (length, 0, 0), (0, 2 * half, 0), ground, cell=0.25),))
    _front(builder, style, half, height)
    _fence(builder, rng, length, half)
    walls = [
        Wall.between((-HALL, -DEPTH), (0, -DEPTH), height),
        Wall.between((0, DEPTH), (-HALL, DEPTH), height),
        Wall.between((-HALL, DEPTH), (-HALL, -DEPTH), height),
    ]
    kept: dict[int, tuple[float, float]] = {}
    if order.movers:
        _inhabit(builder, rng, walls[2], length, half)
        for k in range(order.people - 2):
            kept[k] = add_chooser(builder, rng, walls[k], -HALL / 2 + 1.5, HALL / 2 - 1.2)
    for k, wall in enumerate(walls):
        raise_wall(builder, wall, style, accent=k == 2)
        side = wall.length / 2 - 0.75
        free = [(-side, kept[k][0]), (kept[k][1], side)] if k in kept else [(-side, side)]
        line_wall(builder, rng, wall, free, depth=0.55 if k == 2 else 1.3)
        decorate(builder, rng, wall, windows=k == 0)
    _furnish(builder, rng, length, half)

    lamps = [Light((x, y, height - 0.1), rng.uniform(2.2, 2.8)) for x in (-6.5, -2.5) for y in (-2.3, 2.3)]
    azimuth = rng.uniform(-0.9, 0.9)
    place = 50 * np.array([math.cos(azimuth) * 0.62, math.sin(azimuth) * 0.62, 0.78])
    sun = Light(
        (float(place[0]), float(place[1]), float(place[2])), 50.0**2 * rng.uniform(1.5, 1.9), radius=0.6,
        area=((0.2, -half), (length, half)), switched=False,
    )  # fmt: skip
    path = order.drive(_tour() if order.tour else _round())
    landmarks = _landmarks(rng, walls, length, half)
    mount = (0.12, 0.0, rng.uniform(0.95, 1.15), 0.0, math.radians(rng.uniform(4, 8)), 0.0)
    return builder.world("yard", (*lamps, sun), 0.6, path, landmarks, mount, daylight=0.6, sky=(168.0, 200.0, 240.0))


_INSIDE = [(-2.0, 2.6), (-4.6, 2.5), (-6.3, 0.0), (-4.6, -2.5), (-2.0, -2.6)]
_OUTSIDE = [(4.5, -3.3), (7.2, -2.9), (8.6, 0.0), (7.2, 2.9), (4.5, 3.3)]


def _round() -> Array:
    """Waypoints counter-clockwise: out through one gate, around the yard, in through the other."""
    return np.array([*_INSIDE, (0.0, -GATE), (2.0, -2.7), *_OUTSIDE, (2.0, 2.7), (0.0, GATE)])


def _tour() -> Array:
    """Waypoints through the hall and around the yard in both directions; the ways cross before the gates."""
    up, down = [(1.3, -2.2), (2.4, 0.0), (3.2, 2.2)], [(1.3, 2.2), (2.4, 0.0), (3.2, -2.2)]
    out = [*_INSIDE, (0.0, -GATE), *up, *_OUTSIDE[::-1], (2.0, -2.7), (0.0, -GATE)]
    return np.array([*out, *_INSIDE[::-1], (0.0, GATE), *down, *_OUTSIDE, (2.0, 2.7), (0.0, GATE)])


def _front(builder: Builder, style: Style, half: float, height: float) -> None:
    """The hall's front with its two gates."""
    thick, top = 0.2, height + 0.3
    edges = [-half, -GATE - WIDTH / 2, -GATE + WIDTH / 2, GATE - WIDTH / 2, GATE + WIDTH / 2, half]
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        builder.surface("wall", box((thick, b - a, top), style.wall, center=(0, (a + b) / 2, top / 2), cell=0.25))
    for a, b in zip(edges[1:-1:2], edges[2:-1:2], strict=True):
        lintel = (0.0, (a + b) / 2, (OPEN + top) / 2)
        builder.surface("wall", box((thick, b - a, top - OPEN), style.wall, center=lintel, cell=0.25))


def _fence(builder: Builder, rng: Rng, length: float, half: float) -> None:
    """A low wall around the yard."""
    stone = Material("plaster", tone(rng, (0.02, 0.12), (0.05, 0.4), (0.5, 0.85)), tile=0.9)
    for size, center in (
        ((length, 0.15, FENCE), (length / 2, -half - 0.075, FENCE / 2)),
        ((length, 0.15, FENCE), (length / 2, half + 0.075, FENCE / 2)),
        ((0.15, 2 * half + 0.3, FENCE), (length + 0.075, 0.0, FENCE / 2)),
    ):
        builder.surface("wall", box(size, stone, center=center, cell=0.25))


def _inhabit(builder: Builder, rng: Rng, back: Wall, length: float, half: float) -> None:
    """A person who walks at the back of the hall; in the yard another, a ball and a robot, each along its fence."""
    reach = back.length / 2 - 1.6
    add_walker(builder, rng, np.array([back.place(0.9, s * reach)[:2, 3] for s in (-1.0, -0.3, 0.4, 1.0)]))
    y = half - 1.1
    add_walker(builder, rng, np.array([(3.0, -y), (length / 2, -y + 0.05), (length - 1.0, -y)]))
    add_ball(builder, rng, np.array([2.5, y]), np.array([length - 2.5, y]), radius=rng.uniform(0.09, 0.15), seconds=9.0)
    angle = np.linspace(0, 2 * math.pi, 10, endpoint=False)
    way = np.stack([length - 1.1 + 0.3 * np.sin(angle), 2.6 * np.cos(angle)], axis=1)
    add_rover(builder, rng, way)


def _furnish(builder: Builder, rng: Rng, length: float, half: float) -> None:
    """Returns what stands in the yard: bushes and a table in its middle, boxes and bins along the fences."""
    for k in range(3):
        angle = 2 * math.pi * (k / 3 + rng.uniform(-0.05, 0.05))
        bush = furniture.plant(rng, rng.uniform(1.3, 2.1))
        builder.put("plant", bush, pose(5.9 + 0.8 * math.cos(angle), 0.8 * math.sin(angle)), on=FLOOR)
    shape, surface = furniture.table(rng, 0.7, 0.5, 0.72)
    T = pose(5.9, 0.0, 0.0, rng.uniform(-math.pi, math.pi))
    id = builder.put("table", shape, T, on=FLOOR)
    scatter(builder, rng, id, T, surface, small_items(rng, 4))
    for x in np.arange(1.2, length - 1.0, 1.6):
        for side in (-1, 1):
            piece = builder.draft()
            T = pose(float(x) + rng.uniform(-0.3, 0.3), side * (half - 0.4), 0, -side * math.pi / 2)
            if rng.uniform() < 0.5:
                put_boxes(piece, rng, T)
            else:
                name = ("bin", "plant", "chair")[int(rng.integers(3))]
                thing = {
                    "bin": lambda: furniture.bin(rng),
                    "plant": lambda: furniture.plant(rng, rng.uniform(0.6, 1.2)),
                    "chair": lambda: furniture.chair(rng, swivel=False)[0],
                }[name]()
                piece.put(name, thing, T, on=FLOOR)
            builder.keep(piece)


def _landmarks(rng: Rng, walls: list[Wall], length: float, half: float) -> Array:
    """Points on the walls of the hall, on its front and on the fences."""
    points = marks_on(rng, walls, (-0.33, 0.0, 0.33), 1.0)
    for y in (-0.7 * half, 0.0, 0.7 * half):
        points += [np.array([side * 0.12, y, rng.uniform(1.2, 2.2)]) for side in (-1, 1)]
        points.append(np.array([length - 0.02, y, rng.uniform(0.6, 1.2)]))
    for x in (0.25 * length, 0.6 * length):
        points += [np.array([x, side * (half - 0.02), rng.uniform(0.6, 1.2)]) for side in (-1, 1)]
    return np.array(points)
