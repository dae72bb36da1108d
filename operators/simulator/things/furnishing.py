"""Puts things into a room: walls with pictures, desks with what lies on them, filled shelves, and heaps of boxes.

A wall has a frame: origin on the floor at the wall's middle, x into the room, y along the wall. All
functions add to a `Builder` and state what was put on what.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from operators.simulator.scene import Builder
from operators.simulator.shapes import Array, Material, Shape, at, bounds, box, moved, pose, sheet
from operators.simulator.things import furniture, objects
from operators.simulator.things.furniture import Surface, tone

Rng = np.random.Generator
Point = tuple[float, float]
Item = tuple[str, Shape]

FLOOR = 0
"""The id of the floor in relations."""


@dataclass(frozen=True)
class Style:
    """Looks of a building."""

    wall: Material
    accent: Material
    floor: Material
    ceiling: Material
    skirting: Material

    @classmethod
    def drawn(cls, rng: Rng) -> Style:
        kind = ("parquet", "carpet", "tiles")[int(rng.integers(3))]
        floor = {
            "parquet": tone(rng, (0.06, 0.1), (0.3, 0.55), (0.55, 0.85)),
            "carpet": tone(rng, (0, 1), (0.05, 0.4), (0.35, 0.7)),
            "tiles": tone(rng, (0, 1), (0.0, 0.15), (0.6, 0.95)),
        }[kind]
        return cls(
            Material("plaster", tone(rng, (0, 1), (0.02, 0.16), (0.72, 0.95)), tile=1.6),
            Material("plaster", tone(rng, (0, 1), (0.15, 0.5), (0.5, 0.85)), tile=1.6),
            Material(kind, floor, tile={"tiles": 1.6, "carpet": 1.0}.get(kind, 1.4)),
            Material("ceiling", tone(rng, (0, 1), (0.0, 0.06), (0.88, 0.98)), tile=0.6),
            Material("wood", tone(rng, (0.05, 0.1), (0, 0.5), (0.25, 0.9)), tile=0.8),
        )


@dataclass(frozen=True, eq=False)
class Wall:
    """A wall from one corner to the next, the room on its left; `T_world_wall` (4, 4)."""

    T_world_wall: Array
    length: float
    height: float

    @classmethod
    def between(cls, a: Point, b: Point, height: float) -> Wall:
        along = math.atan2(b[1] - a[1], b[0] - a[0])
        T = pose((a[0] + b[0]) / 2, (a[1] + b[1]) / 2, 0.0, along + math.pi / 2)
        return cls(T, math.hypot(b[0] - a[0], b[1] - a[1]), height)

    def place(self, out: float, along: float, up: float = 0.0, yaw: float = 0.0) -> Array:
        """`T_world_thing` of a thing `out` metres from the wall; yaw 0 faces the room."""
        return np.asarray(self.T_world_wall @ pose(out, along, up, yaw))


def ring(x: float, y: float, height: float, *, inside: bool = True) -> list[Wall]:
    """The four walls of a rectangle of half extents `x` and `y`, seen from inside or from outside."""
    corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
    if not inside:
        corners.reverse()
    return [Wall.between(corners[k], corners[(k + 1) % 4], height) for k in range(4)]


def marks_on(rng: Rng, walls: Sequence[Wall], shares: Sequence[float], low: float, astray: float = 0.0) -> list[Array]:
    """Landmarks (3,) on walls at shares of their lengths, drawn up to `astray` more or less, from `low` to 2.2 m up."""
    return [
        wall.place(0.03, wall.length * (share + off), rng.uniform(low, 2.2))[:3, 3]
        for wall in walls
        for share in shares
        for off in [rng.uniform(-astray, astray) if astray else 0.0]
    ]


def raise_wall(builder: Builder, wall: Wall, style: Style, *, accent: bool = False) -> None:
    """The wall's surface and its skirting board."""
    half = wall.length / 2
    face = sheet(
        (0, -half, 0), (0, wall.length, 0), (0, 0, wall.height), style.accent if accent else style.wall, cell=0.2
    )
    board = box((0.015, wall.length, 0.08), style.skirting, center=(0.0075, 0, 0.04), cell=0.5)
    builder.surface("wall", moved((face, *board), wall.T_world_wall))


def lay_floor(builder: Builder, low: Point, high: Point, height: float, style: Style) -> None:
    """A rectangle of floor and the ceiling above it."""
    x, y = high[0] - low[0], high[1] - low[1]
    builder.surface("floor", (sheet((low[0], low[1], 0), (x, 0, 0), (0, y, 0), style.floor, cell=0.12),))
    builder.surface("ceiling", (sheet((low[0], low[1], height), (0, y, 0), (x, 0, 0), style.ceiling, cell=0.4),))


def hang(builder: Builder, wall: Wall, pattern: str, along: float, up: float, width: float, height: float) -> None:
    """A picture, window or whiteboard with its middle at (along, up)."""
    glow = 1.15 if pattern.startswith("window") else 0.0
    shape = furniture.picture(pattern, width, height, glow=glow)
    builder.surface("wall", moved(shape, wall.place(0.0, along, up)))


def decorate(
    builder: Builder, rng: Rng, wall: Wall, *, windows: bool, taken: Sequence[tuple[float, float]] = ()
) -> None:
    """Covers a wall with pictures and perhaps windows, except the spans `taken` (from, to) along it."""
    cursor = -wall.length / 2 + 0.3
    while True:
        kind = "window" if windows and rng.uniform() < 0.5 else ("whiteboard" if rng.uniform() < 0.2 else "poster")
        width = rng.uniform(*{"window": (1.0, 1.5), "whiteboard": (1.0, 1.6), "poster": (0.4, 0.95)}[kind])
        height = {"window": 1.25, "whiteboard": 0.95}.get(kind, width * rng.uniform(0.75, 1.35))
        if cursor + width > wall.length / 2 - 0.3:
            return
        span = (cursor, cursor + width)
        if all(span[1] < a or b < span[0] for a, b in taken):
            count = {"window": 2, "whiteboard": 2, "poster": 8}[kind]
            hang(
                builder,
                wall,
                f"{kind}:{rng.integers(count)}",
                cursor + width / 2,
                rng.uniform(1.5, 1.72),
                width,
                height,
            )
        cursor += width + rng.uniform(0.15, 0.7)


def footprint(shape: Shape) -> float:
    """Radius of the circle about the origin that the shape stands in."""
    return max(float(np.linalg.norm(patch.vertices[:, :2], axis=1).max()) for patch in shape)


def scatter(
    builder: Builder,
    rng: Rng,
    carrier: int,
    T_world_carrier: Array,
    surface: Surface,
    items: Sequence[Item],
    *,
    taken: Sequence[tuple[float, float, float]] = (),
    inside: bool = False,
    any_yaw: bool = True,
) -> list[tuple[int, Array]]:
    """Puts items where there is room on a surface; circles `taken` (x, y, radius) stay free.

    Returns id and `T_world_item` of those that found a place.
    """
    circles = list(taken)
    placed = []
    for label, shape in items:
        radius = footprint(shape)
        low, high = bounds(shape)
        if high[2] - low[2] > surface.room:
            continue
        for _ in range(25):
            x = rng.uniform(-1, 1) * max(0.0, surface.half_x - radius)
            y = rng.uniform(-1, 1) * max(0.0, surface.half_y - radius)
            if all(math.hypot(x - a, y - b) > radius + c + 0.01 for a, b, c in circles):
                yaw = rng.uniform(-math.pi, math.pi) if any_yaw else rng.uniform(-0.3, 0.3)
                T = T_world_carrier @ pose(surface.x + x, surface.y + y, surface.z - low[2], yaw)
                relation = {"inside": carrier} if inside else {"on": carrier}
                placed.append((builder.put(label, shape, T, **relation), T))
                circles.append((x, y, radius))
                break
    return placed


def small_items(rng: Rng, count: int) -> list[Item]:
    """Returns what lies about on tables."""
    makers: list[Callable[[], Item]] = [
        lambda: ("mug", objects.mug(rng)),
        lambda: ("bottle", objects.bottle(rng)),
        lambda: ("book", objects.book(rng, upright=False)[0]),
        lambda: ("box", objects.carton(rng, 0.09, 0.2)[0]),
        lambda: ("ball", at_rest(objects.ball(rng, rng.uniform(0.035, 0.07)))),
        lambda: ("plant", furniture.plant(rng, rng.uniform(0.18, 0.32))),
    ]
    weights = np.array([0.28, 0.2, 0.2, 0.12, 0.1, 0.1])
    return [makers[int(k)]() for k in rng.choice(len(makers), count, p=weights)]


def at_rest(shape: Shape) -> Shape:
    """The shape lifted so that it stands on z = 0."""
    low, _ = bounds(shape)
    return at(shape, z=-float(low[2]))


@dataclass(frozen=True, eq=False)
class Desk:
    """A desk that was placed: its id, pose, surface, and the mug nearest to the edge if any."""

    id: int
    T_world_desk: Array
    surface: Surface


def put_desk(
    builder: Builder,
    rng: Rng,
    T: Array,
    length: float,
    *,
    items: int,
    chair: bool = True,
    keep_free: Sequence[tuple[float, float, float]] = (),
) -> Desk:
    """A desk whose worker sits on its +x side, with a monitor, a keyboard, a lamp perhaps, and small things."""
    depth, height = rng.uniform(0.68, 0.78), rng.uniform(0.71, 0.76)
    shape, surface = furniture.table(rng, length, depth, height)
    offset = rng.uniform(-0.2, 0.2) * length
    shape += at(objects.keyboard(rng), depth * 0.22, offset, height)
    id = builder.put("table", shape, T, on=FLOOR)
    taken = [(depth * 0.22, offset + dy, 0.14) for dy in (-0.14, 0.14)] + list(keep_free)
    screen = objects.monitor(rng)
    T_screen = T @ pose(-depth * 0.22, offset, height, rng.uniform(-0.25, 0.25))
    builder.put("monitor", screen, T_screen, on=id)
    taken += [(-depth * 0.22, offset + dy, 0.17) for dy in (-0.17, 0.17)]
    wanted = small_items(rng, items)
    if rng.uniform() < 0.5:
        wanted.insert(0, ("lamp", furniture.table_lamp(rng)))
    scatter(builder, rng, id, T, surface, wanted, taken=taken)
    if chair:
        seat, _ = furniture.chair(rng)
        T_chair = T @ pose(
            depth / 2 + rng.uniform(0.12, 0.26), offset + rng.uniform(-0.1, 0.1), 0, math.pi + rng.uniform(-0.5, 0.5)
        )
        builder.put("chair", seat, T_chair, on=FLOOR)
    return Desk(id, T, surface)


def put_shelf(builder: Builder, rng: Rng, wall: Wall, along: float, width: float) -> int:
    """A bookcase against the wall with books, boxes and other things in it and on it."""
    height, depth = rng.uniform(0.9, 2.0), rng.uniform(0.27, 0.36)
    shape, boards = furniture.shelf(rng, width, height, depth)
    T = wall.place(depth / 2 + 0.02, along)
    id = builder.put("shelf", shape, T, on=FLOOR)
    for board in boards[:-1]:
        if rng.uniform() < 0.45:
            _row_of_books(builder, rng, id, T, board)
        else:
            scatter(builder, rng, id, T, board, small_items(rng, 3), inside=True)
    if height < 1.5:
        scatter(builder, rng, id, T, boards[-1], [*small_items(rng, 2), ("box", objects.carton(rng, 0.15, 0.26)[0])])
    return id


def _row_of_books(builder: Builder, rng: Rng, id: int, T: Array, board: Surface) -> None:
    y = rng.uniform(-1, 0.5) * board.half_y
    end = board.half_y
    for _ in range(int(rng.integers(3, 7))):
        shape, (width, thick, height) = objects.book(rng, upright=True)
        if y + thick > end:
            return
        if height < board.room and width < 2 * board.half_x:
            x = board.half_x - width / 2 - rng.uniform(0.0, 0.03)
            builder.put("book", shape, T @ pose(board.x + x, y + thick / 2, board.z), inside=id)
        y += thick + 0.002


def put_boxes(builder: Builder, rng: Rng, T: Array) -> None:
    """One to three boxes on top of each other."""
    below, z = FLOOR, 0.0
    for k in range(int(rng.integers(1, 4))):
        shape, height = objects.carton(rng, 0.3 - 0.05 * k, 0.46 - 0.08 * k)
        below = builder.put("box", shape, T @ pose(0, 0, z, rng.uniform(-0.3, 0.3)), on=below)
        z += height


def line_wall(
    builder: Builder, rng: Rng, wall: Wall, free: Sequence[tuple[float, float]], *, depth: float = 1.55
) -> None:
    """Stands furniture along the free spans (from, to) of a wall, none farther from it than `depth` metres.

    What would stand in a lane is left out.
    """
    for start, end in free:
        cursor = start + rng.uniform(0.05, 0.3)
        while end - cursor > 0.5:
            room = end - cursor
            names = ["plant", "bin", "boxes", "lamp", "chair", "ball"]
            names += ["shelf"] * 3 if room > 1.0 else []
            names += ["desk"] * 4 if room > 1.6 and depth >= 1.55 else []
            name = names[int(rng.integers(len(names)))]
            width = {"shelf": min(room, rng.uniform(0.7, 1.4)), "desk": min(room, rng.uniform(1.2, 1.7))}.get(
                name, 0.55
            )
            piece = builder.draft()
            _stand(piece, rng, wall, name, cursor + width / 2, width, depth)
            gap = rng.uniform(0.08, 0.45)
            cursor += width + gap if builder.keep(piece) else gap


def _stand(builder: Builder, rng: Rng, wall: Wall, name: str, along: float, width: float, depth: float) -> None:
    if name == "shelf":
        put_shelf(builder, rng, wall, along, width)
    elif name == "desk":
        put_desk(builder, rng, wall.place(0.42, along), width, items=int(rng.integers(3, 7)))
    elif name == "boxes":
        put_boxes(builder, rng, wall.place(0.34, along, 0, rng.uniform(-0.3, 0.3)))
    else:
        shape = {
            "plant": lambda: furniture.plant(rng, rng.uniform(0.6, 1.3)),
            "bin": lambda: furniture.bin(rng),
            "lamp": lambda: furniture.floor_lamp(rng),
            "ball": lambda: at_rest(objects.ball(rng, rng.uniform(0.09, 0.16))),
            "chair": lambda: furniture.chair(rng)[0],
        }[name]()
        yaw = rng.uniform(-0.4, 0.4)
        low, high = bounds(at(shape, yaw=yaw))
        if high[0] - low[0] + 0.04 <= depth and high[1] - low[1] <= width + 0.3:
            builder.put(name, shape, wall.place(0.04 - float(low[0]), along, 0, yaw), on=FLOOR)
