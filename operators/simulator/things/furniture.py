"""Furniture: tables, chairs, shelves, doors, plants, bins, lamps and robots, of drawn size and colour.

Every function takes a generator and returns the shape in the object's own frame: origin on the floor below its middle,
front towards +x. Those that carry other things also return where.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from operators.simulator.shapes import Color, Material, Shape, at, bone, box, cylinder, ellipsoid, lathe, moved, sheet

Rng = np.random.Generator


@dataclass(frozen=True)
class Surface:
    """A rectangle that things can be put on: middle and half extents, in the carrier's frame."""

    x: float
    y: float
    z: float
    half_x: float
    half_y: float
    room: float = 10.0
    """Free height above."""


def tone(rng: Rng, hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]) -> Color:
    """A colour drawn from ranges of hue (turns, may exceed 1), saturation and value."""
    h, s, v = rng.uniform(*hue) % 1 * 6, rng.uniform(*saturation), rng.uniform(*value)
    channels = [v * (1 - s * max(0.0, min(1.0, 2 - abs((h - k) % 6 - 3)))) for k in (0, 2, 4)]
    return channels[0], channels[1], channels[2]


def any_tone(rng: Rng) -> Color:
    """Any colour that paint or plastic comes in."""
    return tone(rng, (0, 1), (0.15, 0.95), (0.35, 0.95))


def timber(rng: Rng) -> Color:
    """Wood, from pale birch to walnut, sometimes painted white or black."""
    pick = rng.uniform()
    if pick < 0.15:
        return tone(rng, (0.08, 0.12), (0.02, 0.1), (0.8, 0.95))
    if pick < 0.25:
        return tone(rng, (0.0, 0.1), (0.05, 0.2), (0.16, 0.3))
    return tone(rng, (0.055, 0.105), (0.3, 0.62), (0.42, 0.86))


def dark(rng: Rng) -> Color:
    return tone(rng, (0, 1), (0.0, 0.25), (0.12, 0.34))


def table(rng: Rng, length: float, depth: float, height: float) -> tuple[Shape, Surface]:
    """A table, `length` along y and `depth` along x: with four legs, two panels, or one column."""
    top = Material("wood", timber(rng), tile=0.9)
    thick = rng.uniform(0.025, 0.05)
    shape = box((depth, length, thick), top, center=(0, 0, height - thick / 2), cell=0.12)
    below = height - thick
    style = rng.integers(3)
    if style == 0 or length > 1.9:
        leg = Material("metal", tone(rng, (0, 1), (0, 0.2), (0.2, 0.85)), tile=0.4)
        w = rng.uniform(0.04, 0.07)
        for sx in (-1, 1):
            for sy in (-1, 1):
                shape += at(box((w, w, below), leg, cell=0.4), sx * (depth / 2 - w), sy * (length / 2 - w))
    elif style == 1:
        for sy in (-1, 1):
            shape += at(box((depth * 0.9, 0.03, below), top, cell=0.3), 0, sy * (length / 2 - 0.06))
        shape += box((0.02, length - 0.2, below * 0.5), top, center=(-depth * 0.3, 0, below * 0.7), cell=0.3)
    else:
        leg = Material("metal", dark(rng), tile=0.4)
        shape += cylinder(0.05, below, leg)
        shape += lathe([(0, 0), (min(depth, length) * 0.36, 0), (0.07, 0.05)], leg)
    return shape, Surface(0, 0, height, depth / 2 - 0.04, length / 2 - 0.04)


def chair(rng: Rng, *, swivel: bool | None = None) -> tuple[Shape, float]:
    """A chair that faces +x, and the height of its seat."""
    seat = rng.uniform(0.43, 0.48)
    width, depth = rng.uniform(0.42, 0.5), rng.uniform(0.4, 0.47)
    swivel = bool(rng.uniform() < 0.5) if swivel is None else swivel
    if swivel:
        cushion = Material("fabric", tone(rng, (0, 1), (0.1, 0.8), (0.18, 0.7)), tile=0.35)
        metal = Material("metal", dark(rng), tile=0.4)
        shape = ellipsoid(depth / 2 + 0.02, width / 2 + 0.02, 0.05, cushion, segments=16, rings=6)
        shape = at(shape, z=seat - 0.045)
        shape += at(cylinder(0.03, seat - 0.14, metal, segments=10), z=0.08)
        for k in range(5):
            arm = at(box((0.3, 0.045, 0.035), metal, center=(0.15, 0, 0.085)), yaw=k * 2 * math.pi / 5)
            wheel = at(ellipsoid(0.03, 0.03, 0.03, metal, segments=8, rings=4), 0.28, 0, 0.035)
            shape += arm + at(wheel, yaw=k * 2 * math.pi / 5)
        tall = rng.uniform(0.42, 0.6)
        back = ellipsoid(0.04, width / 2, tall / 2, cushion, segments=16, rings=8)
        shape += at(back, -depth / 2 - 0.02, 0, seat + 0.12 + tall / 2)
        shape += at(box((0.03, 0.06, 0.3), metal), -depth / 2 - 0.045, 0, seat - 0.06)
        return shape, seat
    wood = Material("wood", timber(rng), tile=0.6)
    padded = Material("fabric", any_tone(rng), tile=0.35) if rng.uniform() < 0.4 else wood
    shape = box((depth, width, 0.04), padded, center=(0, 0, seat - 0.02), cell=0.15)
    w = rng.uniform(0.03, 0.045)
    tall = rng.uniform(0.38, 0.5)
    for sy in (-1, 1):
        shape += at(box((w, w, seat - 0.04), wood, cell=0.5), depth / 2 - w / 2, sy * (width / 2 - w / 2))
        shape += at(box((w, w, seat + tall), wood, cell=0.5), -depth / 2 + w / 2, sy * (width / 2 - w / 2))
    slats = int(rng.integers(2, 5))
    for k in range(slats):
        z = seat + tall * (0.35 + 0.6 * k / max(1, slats - 1)) - 0.03
        shape += box((0.02, width - w, 0.4 * tall / slats), wood, center=(-depth / 2 + w / 2, 0, z), cell=0.3)
    return shape, seat


def shelf(rng: Rng, width: float, height: float, depth: float) -> tuple[Shape, list[Surface]]:
    """A bookcase that faces +x, and the surfaces of its boards and its top (the last one)."""
    wood = Material("wood", timber(rng), tile=0.9)
    back = Material("wood", tone(rng, (0.05, 0.12), (0.05, 0.5), (0.3, 0.75)), tile=0.9)
    t = 0.025
    boards = max(2, round(height / rng.uniform(0.34, 0.44)))
    shape: Shape = box((0.01, width, height), back, center=(-depth / 2 + 0.005, 0, height / 2), cell=0.2)
    for sy in (-1, 1):
        shape += box((depth, t, height), wood, center=(0, sy * (width / 2 - t / 2), height / 2), cell=0.2)
    surfaces = []
    for k in range(boards + 1):
        z = 0.06 + (height - 0.06 - t) * k / boards
        shape += box((depth, width - 2 * t, t), wood, center=(0, 0, z + t / 2), cell=0.15)
        free = (height - 0.06 - t) / boards - t
        inside = k < boards
        surfaces.append(Surface(0, 0, z + t, depth / 2 - 0.02, width / 2 - t - 0.02, free if inside else 10.0))
    return shape, surfaces


def door(rng: Rng, width: float, height: float, opening: float) -> Shape:
    """A door in its frame, in a wall whose inner face is the plane x = 0; the leaf is open by `opening` radians."""
    paint = timber(rng) if rng.uniform() < 0.6 else any_tone(rng)
    frame = Material("plain", tone(rng, (0, 1), (0.0, 0.15), (0.35, 0.95)), tile=0.5)
    leaf = Material(f"door:{rng.integers(3)}", paint, tile=0)
    shape: Shape = ()
    for sy in (-1, 1):
        shape += box((0.07, 0.08, height + 0.08), frame, center=(0.02, sy * (width / 2 + 0.04), height / 2 + 0.04))
    shape += box((0.07, width, 0.08), frame, center=(0.02, 0, height + 0.04))
    panel = box((0.04, width, height), leaf, center=(0, width / 2, height / 2), cell=0.4)
    knob = Material("metal", tone(rng, (0.1, 0.15), (0, 0.5), (0.6, 0.9)), tile=0.3)
    panel += at(ellipsoid(0.035, 0.03, 0.03, knob, segments=10, rings=5), 0.05, width - 0.08, height * 0.48)
    panel += box((0.03, 0.12, 0.02), knob, center=(0.06, width - 0.12, height * 0.48))
    return shape + at(panel, 0.025, -width / 2, 0, yaw=-opening)


def plant(rng: Rng, height: float) -> Shape:
    """A potted plant."""
    radius = height * rng.uniform(0.13, 0.19)
    pot_height = height * rng.uniform(0.22, 0.34)
    pot = Material(
        "plain", tone(rng, (0.0, 0.12), (0.1, 0.75), (0.35, 0.92)) if rng.uniform() < 0.7 else any_tone(rng), tile=0.3
    )
    soil = Material("carpet", (0.28, 0.2, 0.14), tile=0.2)
    shape = lathe([(0, 0), (radius * 0.7, 0), (radius, pot_height), (radius * 0.88, pot_height)], pot, segments=14)
    shape += lathe([(radius * 0.9, pot_height * 0.92), (0, pot_height * 0.95)], soil, segments=14)
    count = int(rng.integers(14, 24))
    for k in range(count):
        green = Material("leaf", tone(rng, (0.24, 0.38), (0.4, 0.85), (0.28, 0.7)), tile=0)
        size = height * rng.uniform(0.22, 0.36)
        leaf = ellipsoid(size * 0.2, size * 0.03, size / 2, green, segments=8, rings=4)
        lean = rng.uniform(0.15, 1.15)
        turn = 2 * math.pi * (k * 0.381966 + rng.uniform(-0.05, 0.05))
        c, s = math.cos(lean), math.sin(lean)
        T = np.eye(4)
        T[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
        reach = rng.uniform(0.2, 0.62) * (height - pot_height)
        T[:3, 3] = [s * size / 2, 0, min(pot_height + reach + c * size / 2, height - c * size / 2)]
        stem = at(moved(leaf, T), yaw=turn)
        shape += stem
    shape += at(
        bone((height - pot_height) * 0.6, 0.015, 0.008, Material("wood", (0.35, 0.3, 0.15), tile=0.3), segments=6),
        z=pot_height * 0.9,
    )
    return shape


def bin(rng: Rng) -> Shape:
    """A waste bin: a cone frustum open at the top, or a pedal bin."""
    height, radius = rng.uniform(0.3, 0.55), rng.uniform(0.12, 0.19)
    body = Material(("metal", "plain")[int(rng.integers(2))], tone(rng, (0, 1), (0, 0.6), (0.2, 0.85)), tile=0.4)
    inner = Material("plain", (0.1, 0.1, 0.1), tile=0.4)
    if rng.uniform() < 0.5:
        low = radius * 0.75
        shape = lathe([(0, 0), (low, 0), (radius, height), (radius * 0.93, height)], body)
        return shape + lathe([(radius * 0.93, height), (low, height * 0.25), (0, height * 0.25)], inner)
    shape = lathe([(0, 0), (radius, 0), (radius, height * 0.85)], body)
    lid = Material("plain", dark(rng), tile=0.3)
    return shape + lathe(
        [(radius * 1.04, height * 0.85), (radius, height * 0.93), (radius * 0.6, height), (0, height)], lid
    )


def floor_lamp(rng: Rng) -> Shape:
    """A lamp with a shade on a pole."""
    height = rng.uniform(1.3, 1.75)
    return _lamp(rng, height, rng.uniform(0.14, 0.18), rng.uniform(0.14, 0.22), rng.uniform(0.2, 0.3))


def table_lamp(rng: Rng) -> Shape:
    """The same, small enough for a desk."""
    height = rng.uniform(0.36, 0.52)
    return _lamp(rng, height, rng.uniform(0.07, 0.09), rng.uniform(0.08, 0.12), rng.uniform(0.12, 0.18))


def _lamp(rng: Rng, height: float, foot: float, shade: float, drop: float) -> Shape:
    metal = Material("metal", tone(rng, (0.05, 0.15), (0, 0.5), (0.2, 0.85)), tile=0.3)
    cloth = Material("fabric", tone(rng, (0.05, 0.16), (0.05, 0.45), (0.85, 1.0)), tile=0.3, glow=1.12)
    shape = lathe([(0, 0), (foot, 0), (foot, 0.02), (0.012, 0.04)], metal, segments=16)
    shape += cylinder(0.012, height - drop * 0.5, metal, segments=8)
    return shape + lathe([(shade, height - drop), (shade * 0.62, height), (0, height)], cloth, segments=18)


def rover(rng: Rng) -> Shape:
    """A small service robot that faces +x: a round base with a tower, or a boxy one with a mast."""
    shell = Material(f"robot:{rng.integers(3)}", tone(rng, (0, 1), (0.0, 0.55), (0.6, 0.98)), tile=0.6)
    black = Material("plain", (0.1, 0.1, 0.12), tile=0.3)
    eye = Material("plain", tone(rng, (0.45, 0.62), (0.6, 0.95), (0.85, 1.0)), tile=0.3, glow=1.15)
    if rng.uniform() < 0.5:
        r = rng.uniform(0.17, 0.22)
        h = rng.uniform(0.42, 0.62)
        shape = cylinder(r * 0.88, 0.03, black, segments=20)
        shape += lathe([(0, 0.03), (r, 0.03), (r, 0.14), (r * 0.62, 0.2)], shell, segments=20)
        shape += at(
            lathe(
                [(r * 0.62, 0.0), (r * 0.5, h - 0.3), (r * 0.72, h - 0.2), (r * 0.6, h - 0.08), (0, h - 0.04)], shell
            ),
            z=0.2,
        )
        face = h + 0.04
        shape += box((0.03, r * 0.9, 0.07), eye, center=(r * 0.62, 0, face))
    else:
        w, length, h = rng.uniform(0.28, 0.36), rng.uniform(0.36, 0.46), rng.uniform(0.2, 0.3)
        shape = box((length, w, h), shell, center=(0, 0, 0.06 + h / 2), cell=0.15)
        for sx in (-1, 1):
            for sy in (-1, 1):
                turn = np.eye(4)
                turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
                wheel = moved(cylinder(0.07, 0.05, black, segments=16), turn)
                shape += at(wheel, sx * length * 0.32, sy * (w / 2 + 0.02) + 0.025, 0.07)
        mast = rng.uniform(0.25, 0.45)
        shape += at(cylinder(0.02, mast, black, segments=8), -length * 0.2, 0, 0.06 + h)
        shape += box((0.08, 0.2, 0.08), shell, center=(-length * 0.2, 0, 0.1 + h + mast))
        shape += box((0.01, 0.15, 0.04), eye, center=(-length * 0.2 + 0.043, 0, 0.1 + h + mast))
    return shape


def picture(pattern: str, width: float, height: float, *, glow: float = 0.0) -> Shape:
    """A poster, window or whiteboard: a thin panel that faces +x, its back on the plane x = 0, middle at the origin."""
    face = Material(pattern, tile=0, glow=glow)
    rim = Material("plain", (0.4, 0.38, 0.36), tile=0.5)
    shape = box((0.02, width, height), rim, center=(0.01, 0, 0))
    front = sheet((0.021, -width / 2, -height / 2), (0, width, 0), (0, 0, height), face, 0.3)
    return (*shape, front)
