"""Rooms and doors of made floor plans whose truth is known, seen from a few places with gaps, specks and shadows.

    python benchmarks/rooms.py [--plans 60] [--first 100]

A building of 10 to 22 m is split into rooms of at least 2 m by walls of 0.1 to 0.25 m; doors of 0.7 to 1.1 m make all
of them reachable, and some more. Rays of a LiDAR are cast from three places in each room, up to 8 m: what they pass is
free, what they end on is taken with a stray of 2 cm, one in fifty is lost, and one cell in two thousand is taken though
it is free. Furniture stands along walls and freely. `above furniture` is the map of a slice over it, which the
perception graphs use; `with furniture` that of all heights. A room is found that has an IoU of 0.7 with what was seen
of a true one, a door that is within 0.3 m of a true one. Plans of other seeds were used while the method was written.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.mapping.rooms import RoomSettings, divided

SIDE = 0.05
FREE, TAKEN, UNKNOWN = 0, 100, -1
LEAST, ALIKE, NEAR = 2.0, 0.7, 0.3
Box = tuple[float, float, float, float]
"""Least x and y, greatest x and y, metres."""


@dataclass
class Building:
    """True rooms (H, W), from 1 on, solid cells of walls and of furniture (H, W), and doors: x, y, width, metres."""

    rooms: NDArray[np.int32]
    walls: NDArray[np.bool_]
    furniture: NDArray[np.bool_]
    doors: list[tuple[float, float, float]]


def split(rng: np.random.Generator, box: Box, wall: float) -> list[Box]:
    """Splits a rectangle into rooms."""
    x0, y0, x1, y1 = box
    along = int(y1 - y0 > x1 - x0)
    length = max(x1 - x0, y1 - y0)
    if length < 2 * LEAST + wall or (length < 6 and rng.random() < 0.4):
        return [box]
    cut = (box[along] + rng.uniform(LEAST, length - LEAST - wall)) // SIDE * SIDE
    first = (x0, y0, cut, y1) if along == 0 else (x0, y0, x1, cut)
    last = (cut + wall, y0, x1, y1) if along == 0 else (x0, cut + wall, x1, y1)
    return split(rng, first, wall) + split(rng, last, wall)


def cells_of(box: Box) -> tuple[slice, slice]:
    x0, y0, x1, y1 = (round(v / SIDE) for v in box)
    return slice(y0, y1), slice(x0, x1)


def passages(rng: np.random.Generator, rooms: list[Box], wall: float) -> Iterator[tuple[int, int, Box]]:
    """Gives a place for a door between each two neighbours with a common wall that is long enough."""
    for i, a in enumerate(rooms):
        for j, b in enumerate(rooms[:i]):
            for axis in (0, 1):
                side = 1 - axis
                low, high = max(a[side], b[side]) + 0.2, min(a[side + 2], b[side + 2]) - 0.2
                touch = [
                    (p[axis + 2], q[axis]) for p, q in ((a, b), (b, a)) if abs(q[axis] - p[axis + 2] - wall) < 0.01
                ]
                width = rng.uniform(0.7, 1.1)
                if touch and high - low > width:
                    at = rng.uniform(low, high - width)
                    (begin, end) = touch[0]
                    yield i, j, (begin, at, end, at + width) if axis == 0 else (at, begin, at + width, end)


def building(rng: np.random.Generator) -> Building:
    wall = round(rng.uniform(0.1, 0.25) / SIDE) * SIDE
    width, height = rng.uniform(10, 22), rng.uniform(8, 16)
    rooms = split(rng, (1.0, 1.0, 1.0 + width, 1.0 + height), wall)
    shape = round((height + 2) / SIDE), round((width + 2) / SIDE)
    made = Building(np.zeros(shape, np.int32), np.ones(shape, bool), np.zeros(shape, bool), [])
    for k, box in enumerate(rooms):
        made.rooms[cells_of(box)], made.walls[cells_of(box)] = k + 1, False
    reached = list(range(len(rooms)))
    ways = list(passages(rng, rooms, wall))
    for k in rng.permutation(len(ways)).tolist():
        i, j, box = ways[k]
        if reached[i] == reached[j] and rng.random() < 0.85:
            continue
        reached = [reached[i] if r == reached[j] else r for r in reached]
        made.walls[cells_of(box)] = False
        rows, columns = cells_of(box)
        clear = (columns.stop - columns.start, rows.stop - rows.start)
        across = clear[1] if abs(box[2] - box[0] - wall) < 0.01 and wall < box[3] - box[1] else clear[0]
        made.doors.append(((box[0] + box[2]) / 2, (box[1] + box[3]) / 2, across * SIDE))
    for x0, y0, x1, y1 in rooms:
        for _ in range(int(rng.integers(1, 5))):
            w, d = rng.uniform(0.4, 1.6), rng.uniform(0.3, 0.8)
            w, d = (w, d) if rng.random() < 0.5 else (d, w)
            x, y = rng.uniform(x0, max(x1 - w, x0)), rng.uniform(y0, max(y1 - d, y0))
            x, y = (x, rng.choice([y0, y1 - d])) if rng.random() < 0.7 else (x, y)
            away = [np.hypot(max(x - dx, 0, dx - x - w), max(y - dy, 0, dy - y - d)) for dx, dy, _ in made.doors]
            if min(away, default=9.0) > 0.9:  # doors are left free
                made.furniture[cells_of((x, y, x + w, y + d))] = True
    made.furniture &= ~made.walls
    return made


def seen(rng: np.random.Generator, made: Building, furnished: bool) -> NDArray[np.int8]:
    """Returns the map that rays from three places in each room give."""
    solid = made.walls | made.furniture if furnished else made.walls
    grid = np.full(solid.shape, UNKNOWN, np.int8)
    hits = np.zeros(solid.shape, bool)
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    way = np.stack([np.sin(angles), np.cos(angles)])
    steps = np.arange(0.1, 8.0, 0.6 * SIDE)
    for room in range(1, int(made.rooms.max()) + 1):
        rows, columns = np.nonzero((made.rooms == room) & ~solid)
        for k in rng.choice(len(rows), min(3, len(rows)), replace=False).tolist():
            at = np.array([rows[k], columns[k]])[:, None, None] + 0.5 + way[:, :, None] * steps / SIDE
            row, column = np.clip(at.astype(int), 0, np.array(solid.shape)[:, None, None] - 1)
            stopped = solid[row, column]
            first = np.where(stopped.any(axis=1), stopped.argmax(axis=1), len(steps))
            passed = np.arange(len(steps)) < first[:, None]
            grid[row[passed], column[passed]] = FREE
            ended = np.flatnonzero((first < len(steps)) & (rng.random(len(first)) > 0.02))
            stray = rng.normal(0, 0.02, len(ended)) / SIDE
            end = at[:, ended, first[ended]] + way[:, ended] * stray
            row, column = np.clip(end.astype(int), 0, np.array(solid.shape)[:, None] - 1)
            hits[row, column] = True
    grid[hits] = TAKEN
    grid[(grid == FREE) & (rng.random(grid.shape) < 0.0005)] = TAKEN
    return grid


def scored(made: Building, grid: NDArray[np.int8], settings: RoomSettings) -> dict[str, float]:
    """Returns counts of rooms and doors that are found, true and given, errors of widths, and the seconds it took."""
    begun = time.process_time()
    division = divided(grid, SIDE, settings)
    seconds = time.process_time() - begun
    there = grid == FREE
    truth, ours = np.where(there, made.rooms, 0), np.where(there, division.labels, 0)
    both = np.zeros((int(truth.max()) + 1, int(ours.max()) + 1))
    np.add.at(both, (truth.ravel(), ours.ravel()), 1)
    union = both.sum(axis=1, keepdims=True) + both.sum(axis=0, keepdims=True) - both
    alike = (both / np.maximum(union, 1))[1:, 1:]
    sizes = both.sum(axis=1)[1:] * SIDE * SIDE
    mine = np.array([[(d.column + 0.5) * SIDE, (d.row + 0.5) * SIDE, d.width] for d in division.doors]).reshape(-1, 3)
    doors = np.array(made.doors).reshape(-1, 3)
    apart = np.hypot(*(doors[:, None, :2] - mine[None, :, :2]).transpose(2, 0, 1))
    found = apart.min(axis=1, initial=np.inf) <= NEAR
    off = [abs(doors[k, 2] - mine[apart[k].argmin(), 2]) for k in np.flatnonzero(found)]
    return {
        "rooms": float((sizes >= settings.area).sum()),
        "rooms given": float((both.sum(axis=0)[1:] > 0).sum()),
        "rooms found": float((alike.max(axis=1, initial=0) >= ALIKE).sum()),
        "doors": float(len(doors)),
        "doors given": float(len(mine)),
        "doors found": float(found.sum()),
        "width off": float(np.sum(off)),
        "seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=int, default=60)
    parser.add_argument("--first", type=int, default=100, help="first seed")
    arguments = parser.parse_args()
    print(
        "| map | rooms | recall | precision | doors | recall | precision | width off | ms a map |\n"
        + "| --- " * 9
        + "|"
    )
    for furnished in (False, True):
        rows = []
        for seed in range(arguments.first, arguments.first + arguments.plans):
            made = building(np.random.default_rng(seed))
            grid = seen(np.random.default_rng([seed, furnished]), made, furnished)
            rows.append(scored(made, grid, RoomSettings()))
        total = {name: sum(row[name] for row in rows) for name in rows[0]}
        print(
            f"| {'with' if furnished else 'above'} furniture | {total['rooms']:.0f} "
            f"| {total['rooms found'] / total['rooms']:.3f} | {total['rooms found'] / total['rooms given']:.3f} "
            f"| {total['doors']:.0f} | {total['doors found'] / total['doors']:.3f} "
            f"| {total['doors found'] / max(total['doors given'], 1):.3f} "
            f"| {100 * total['width off'] / max(total['doors found'], 1):.1f} cm "
            f"| {1000 * total['seconds'] / len(rows):.0f} |"
        )


if __name__ == "__main__":
    main()
