"""The corridor: a ring of four passages around a block, with doors, that leads back to where it starts."""

from __future__ import annotations

import math

import numpy as np

from operators.simulator.people.choosers import add_chooser
from operators.simulator.people.inhabitants import add_ball, add_rover, add_walker
from operators.simulator.scene import Builder, Light, World, WorldOptions
from operators.simulator.shapes import Array
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
)

LANE = 1.0
"""Metres between the block and the robot's path; those who come towards it keep to the outer wall."""


def corridor(seed: int, order: WorldOptions) -> World:
    """A ring of about thirty metres, drawn from the seed."""
    rng = np.random.default_rng([seed, 2])
    block_x, block_y, width = rng.uniform(3.0, 4.2), rng.uniform(2.0, 3.0), rng.uniform(2.75, 3.0)
    height = rng.uniform(2.5, 2.8)
    x, y = block_x + width, block_y + width
    builder, style = Builder(), Style.drawn(rng)
    lay_floor(builder, (-x, -y), (x, y), height, style)
    outer = ring(x, y, height)
    inner = ring(block_x, block_y, height, inside=False)
    cast = order.cast(["walker", "walker", "ball", "rover"])
    roles = [str(role) for role in rng.permutation(cast)] if order.movers else [""] * 4
    kept = [
        _inhabit(builder, rng, wall, role, wall.length / 2 - 1.9) if role else None
        for wall, role in zip(outer, roles, strict=True)
    ]
    for wall, own in zip(outer, kept, strict=True):
        half = wall.length / 2 - 0.6
        raise_wall(builder, wall, style)
        if own is None:
            spans = _doors(builder, rng, wall, half, int(rng.integers(1, 3)))
            line_wall(builder, rng, wall, _between(spans, half - width + 0.6), depth=0.5)
        else:
            spans = []
            line_wall(builder, rng, wall, _between([own], half - width + 0.6), depth=0.5)
        decorate(builder, rng, wall, windows=rng.uniform() < 0.5, taken=spans)
    for wall in inner:
        half = wall.length / 2 - 0.2
        raise_wall(builder, wall, style, accent=True)
        spans = _doors(builder, rng, wall, half, int(rng.integers(0, 2)), opened=0.0)
        line_wall(builder, rng, wall, _between(spans, half), depth=0.5)
        decorate(builder, rng, wall, windows=False, taken=spans)

    lights = [
        Light((px, py, height - 0.1), rng.uniform(1.5, 1.9), radius=0.3)
        for px, py in _lamp_places(x - width / 2, y - width / 2)
    ]
    landmarks = marks_on(rng, (*outer, *inner), (-0.35, -0.1, 0.1, 0.35), 1.2, astray=0.05)
    path = order.drive(_tour(block_x, block_y, width) if order.tour else _lane(block_x, block_y))
    mount = (0.12, 0.0, rng.uniform(0.95, 1.15), 0.0, math.radians(rng.uniform(4, 8)), 0.0)
    return builder.world("corridor", lights, 0.5, path, np.array(landmarks), mount)


def _lane(x: float, y: float) -> Array:
    """Waypoints counter-clockwise around the block, at an even distance from it."""
    points: list[tuple[float, float]] = []
    for k, (cx, cy) in enumerate([(x, -y), (x, y), (-x, y), (-x, -y)]):
        start = -math.pi / 2 + k * math.pi / 2
        for turn in np.linspace(0, math.pi / 2, 5):
            points.append((cx + LANE * math.cos(start + turn), cy + LANE * math.sin(start + turn)))
        nx, ny = [(x, y), (-x, y), (-x, -y), (x, -y)][k]
        end = points[-1]
        following = (nx + LANE * math.cos(start + math.pi / 2), ny + LANE * math.sin(start + math.pi / 2))
        count = max(1, round(math.dist(end, following) / 1.2))
        points += [
            (end[0] + (following[0] - end[0]) * j / count, end[1] + (following[1] - end[1]) * j / count)
            for j in range(1, count)
        ]
    return np.array(points)


def _tour(x: float, y: float, width: float) -> Array:
    """Waypoints around the block counter-clockwise and back clockwise, with a turn in one corner after each round."""
    lap = [(float(px), float(py)) for px, py in _lane(x, y)[5:]]  # without the corner in which it turns
    c = width - 0.84  # of the turn's middle, from the block's corner
    turn = [(0.3, 1.0), (c - 1.0, 1.12), (c - 0.5, c - 0.36), (c - 0.23, c + 0.2), (c + 0.1, c + 0.31),
            (c + 0.31, c + 0.1), (c + 0.18, c - 0.23), (c - 0.4, c - 0.55), (c - 1.0, 1.0), (0.2, 0.98)]  # fmt: skip
    there = [(x + u, -y - v) for u, v in turn]
    back = [(x + v, -y - u) for u, v in turn]
    return np.array([*lap, *there, *lap[::-1], *back])


def _doors(
    builder: Builder, rng: np.random.Generator, wall: Wall, half: float, count: int, *, opened: float = 0.35
) -> list[tuple[float, float]]:
    """Doors spread along a wall; returns the spans that they take."""
    spans = []
    for k in range(count):
        middle = half * ((2 * k + 1) / count - 1) * 0.75 + rng.uniform(-0.2, 0.2)
        width = rng.uniform(0.82, 0.95)
        angle = rng.uniform(0, opened) if rng.uniform() < 0.5 else 0.0
        leaf = furniture.door(rng, width, rng.uniform(2.0, 2.1), angle)
        builder.put("door", leaf, wall.place(0.0, middle), on=FLOOR)
        spans.append((middle - width / 2 - 0.15, middle + width / 2 + 0.15))
    return spans


def _between(spans: list[tuple[float, float]], half: float) -> list[tuple[float, float]]:
    """Returns what is left of (-half, half) without the spans, which rise."""
    edges = [-half, *(edge for span in spans for edge in span), half]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 0.5]


def _inhabit(
    builder: Builder, rng: np.random.Generator, wall: Wall, role: str, reach: float
) -> tuple[float, float] | None:
    """Someone or something that moves along an outer wall, `reach` metres to both sides of its middle.

    Returns the span of the wall that is kept free for its own furniture, if any.
    """
    out = 0.85

    def places(*points: tuple[float, float]) -> Array:
        return np.array([wall.place(d, s)[:2, 3] for d, s in points])

    if role == "chooser":
        return add_chooser(builder, rng, wall, -reach, reach)
    if role == "walker":
        add_walker(builder, rng, places((out, -reach), (out, -0.3 * reach), (out + 0.04, 0.4 * reach), (out, reach)))
    elif role == "ball":
        a, b = places((out, -reach * 0.7), (out, reach * 0.7))
        add_ball(builder, rng, a, b, radius=rng.uniform(0.09, 0.15), seconds=rng.uniform(5, 7))
    else:
        angle = np.linspace(0, 2 * math.pi, 10, endpoint=False)
        add_rover(builder, rng, places(*((out + 0.14 * math.sin(a), 0.7 * reach * math.cos(a)) for a in angle)))
    return None


def _lamp_places(x: float, y: float) -> list[tuple[float, float]]:
    return [(sx * x * u, sy * y) for sx, sy, u in ((1, 1, 0.5), (-1, 1, 0.5), (1, -1, 0.5), (-1, -1, 0.5))] + [
        (sx * x, sy * y * 0.45) for sx in (-1, 1) for sy in (-1, 1)
    ]
