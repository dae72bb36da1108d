"""Things that are put on furniture or carried: mugs, bottles, books, boxes, balls and monitors, of drawn size and
colour.

As in `furniture`: origin below the middle, front towards +x.
"""

from __future__ import annotations

import math

import numpy as np

from operators.simulator.shapes import Material, Shape, at, bone, box, ellipsoid, lathe, moved, sheet
from operators.simulator.things.furniture import any_tone, dark, tone

Rng = np.random.Generator


def mug(rng: Rng) -> Shape:
    """A mug with its handle towards +y."""
    r, h = rng.uniform(0.037, 0.047), rng.uniform(0.085, 0.115)
    print_ = f"label:{rng.integers(4)}" if rng.uniform() < 0.5 else "plain"
    color = any_tone(rng) if rng.uniform() < 0.7 else tone(rng, (0, 1), (0, 0.1), (0.85, 0.98))
    glaze = Material(print_, color, tile=0)
    shape = lathe([(0, 0), (r * 0.9, 0), (r, h * 0.12), (r, h), (r * 0.9, h)], glaze, segments=18)
    shape += lathe([(r * 0.9, h), (r * 0.88, h * 0.75), (0, h * 0.75)], Material("plain", (0.24, 0.14, 0.09), tile=0.1))
    handle = Material("plain", color, tile=0.1)
    for k in range(5):
        a, b = (math.pi * (-0.5 + j / 5) for j in (k, k + 1))
        p = np.array([0, r + 0.024 * math.cos(a), h * 0.5 + h * 0.3 * math.sin(a)])
        q = np.array([0, r + 0.024 * math.cos(b), h * 0.5 + h * 0.3 * math.sin(b)])
        T = np.eye(4)
        z = (q - p) / np.linalg.norm(q - p)
        T[:3, :3] = np.column_stack([[1, 0, 0], np.cross(z, [1, 0, 0]), z])
        T[:3, 3] = p
        shape += moved(bone(float(np.linalg.norm(q - p)), 0.007, 0.007, handle, segments=6), T)
    return shape


def bottle(rng: Rng) -> Shape:
    """A bottle with a label and a cap."""
    r, h = rng.uniform(0.03, 0.043), rng.uniform(0.2, 0.3)
    glass = Material(
        "plain", tone(rng, (0.25, 0.65), (0.2, 0.9), (0.3, 0.85)) if rng.uniform() < 0.7 else any_tone(rng), tile=0.2
    )
    label = Material(f"label:{rng.integers(4)}", tile=0)
    body = h * rng.uniform(0.52, 0.64)
    shape = lathe([(0, 0), (r, 0), (r, body * 0.25)], glass, segments=16)
    shape += lathe([(r * 1.01, body * 0.25), (r * 1.01, body * 0.85)], label, segments=16)
    shape += lathe(
        [
            (r, body * 0.85),
            (r, body),
            (r * 0.72, body + (h - body) * 0.35),
            (r * 0.36, body + (h - body) * 0.6),
            (r * 0.36, h * 0.93),
        ],
        glass,
        segments=16,
    )
    cap = Material("plain", any_tone(rng), tile=0.1)
    return shape + at(lathe([(r * 0.42, 0), (r * 0.42, h * 0.08), (0, h * 0.08)], cap, segments=12), z=h * 0.92)


def carton(rng: Rng, low: float = 0.18, high: float = 0.5) -> tuple[Shape, float]:
    """A cardboard or coloured box, and its height."""
    x, y, z = rng.uniform(low, high, 3) * [1, 1, 0.8]
    if rng.uniform() < 0.65:
        tint = tone(rng, (0.07, 0.1), (0.3, 0.5), (0.55, 0.8))
        material = Material(f"cardboard:{rng.integers(3)}", tint, tile=0)
    else:
        material = Material(f"cover:{rng.integers(6)}", tile=0)
    return box((x, y, z), material, cell=0.2), float(z)


def book(rng: Rng, *, upright: bool) -> tuple[Shape, tuple[float, float, float]]:
    """A book and its size: lying, or standing with its spine to the front."""
    width, height, thick = rng.uniform(0.13, 0.19), rng.uniform(0.19, 0.27), rng.uniform(0.018, 0.05)
    color = any_tone(rng)
    cover = Material(f"cover:{rng.integers(6)}", tile=0)
    paper = Material("plain", (0.93, 0.91, 0.84), tile=0.1)
    spine = Material(f"label:{rng.integers(4)}", color, tile=0)
    if upright:
        size = (float(width), float(thick), float(height))
        shape = box(size, Material("plain", color, tile=0.2), front=spine, top=paper, cell=0.3)
        return shape, size
    size = (float(width), float(height), float(thick))
    return box(size, paper, front=spine, top=cover, cell=0.3), size


def ball(rng: Rng, radius: float) -> Shape:
    """A ball about its middle."""
    striped = rng.uniform() < 0.6
    color = any_tone(rng) if not striped else tone(rng, (0, 1), (0, 0.5), (0.8, 1.0))
    return ellipsoid(
        radius,
        radius,
        radius,
        Material(f"ball:{rng.integers(4)}" if striped else "fabric", color, tile=0 if striped else 0.3),
    )


def monitor(rng: Rng) -> Shape:
    """A computer monitor that faces +x."""
    w = rng.uniform(0.48, 0.68)
    h = w * rng.uniform(0.56, 0.66)
    case = Material("plain", dark(rng) if rng.uniform() < 0.75 else (0.8, 0.8, 0.82), tile=0.3)
    metal = Material("metal", tone(rng, (0, 1), (0, 0.15), (0.2, 0.8)), tile=0.3)
    z = rng.uniform(0.1, 0.16) + h / 2
    shape = box((0.03, w, h), case, center=(0, 0, z), cell=0.4)
    screen = Material(f"screen:{rng.integers(4)}", tile=0, glow=rng.uniform(0.85, 1.1))
    shape += (sheet((0.016, -w / 2 + 0.012, z - h / 2 + 0.012), (0, w - 0.024, 0), (0, 0, h - 0.024), screen, 1.0),)
    shape += box((0.03, 0.06, z), metal, center=(-0.03, 0, z / 2))
    return shape + box((0.2, 0.26, 0.015), metal)


def keyboard(rng: Rng) -> Shape:
    """A keyboard in front of a person who looks along +x; it counts as part of the table it lies on."""
    return box((0.14, 0.44, 0.018), Material("plain", dark(rng), tile=0.2), top=Material("keys", tile=0), cell=0.5)
