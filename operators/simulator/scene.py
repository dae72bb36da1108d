"""Parts of a world: things with shape and pose, lights, landmarks, the robot's path, who rests on what, and lanes.

Lanes are strips of floor that movers keep to. Lanes apart keep movers apart at all times, whatever their phases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dataflow.messages.geometry import invert, transform_points
from operators.simulator.settings import Mount
from operators.simulator.shapes import Array, Shape, bounds
from operators.simulator.trajectory import Trajectory

WALKER, ROVER = 0.38, 0.31
"""Metres from its way within which a person walks, turns and swings the arms, and a robot drives."""

_SPACING = 0.02  # metres between the points that stand for a line


class Mover(Protocol):
    """Motion of a thing; times in seconds since the start."""

    def frame(self, t: float) -> Array:
        """`T_world_thing` (4, 4): upright, on what the thing stands on."""
        ...

    def parts(self, t: float) -> Array:
        """`T_world_part` (P, 4, 4) of every part."""
        ...


@dataclass(frozen=True, eq=False)
class Stationary:
    """Stays where it is."""

    T_world_thing: Array

    def frame(self, t: float) -> Array:
        return self.T_world_thing

    def parts(self, t: float) -> Array:
        return self.T_world_thing[None]


@dataclass(frozen=True, eq=False)
class Thing:
    """An object or a piece of the building. `id` is unique and ≥ 1 for objects, 0 for surfaces."""

    id: int
    label: str
    parts: tuple[Shape, ...]
    mover: Mover

    @property
    def still(self) -> bool:
        return isinstance(self.mover, Stationary)

    def vertices(self, t: float) -> Array:
        """(V, 3) in the world, part after part."""
        poses = self.mover.parts(t)
        return np.concatenate(
            [transform_points(T, patch.vertices) for T, part in zip(poses, self.parts, strict=True) for patch in part]
        )

    def box(self, t: float) -> tuple[Array, Array]:
        """`T_world_box` (4, 4), centred, and the full size (3,) of the tightest box along the thing's own axes."""
        return self._still_box if self.still else self._box(t)

    @cached_property
    def _still_box(self) -> tuple[Array, Array]:
        return self._box(0.0)

    def _box(self, t: float) -> tuple[Array, Array]:
        T = self.mover.frame(t)
        if self.still:
            low, high = bounds(self.parts[0])
        else:
            own = transform_points(invert(T), self.vertices(t))
            low, high = own.min(axis=0), own.max(axis=0)
        T_box = T.copy()
        T_box[:3, 3] = transform_points(T, (low + high) / 2)
        return T_box, high - low


@dataclass(frozen=True)
class Light:
    """A lamp that shines in all directions; `strength` is its irradiance at 1 m, `radius` softens its shadows.

    Movers throw and take no shadows: a lamp with an `area` (lowest and highest x and y) shines on those in it alone.
    One that is not `switched`, the sun, shines whatever the lighting.
    """

    position: tuple[float, float, float]
    strength: float
    radius: float = 0.25
    area: tuple[tuple[float, float], tuple[float, float]] | None = None
    switched: bool = True


@dataclass(frozen=True)
class Relation:
    """`subject` and `object` are ids of things."""

    subject: int
    predicate: str
    object: int


@dataclass(frozen=True)
class CurrentActivity:
    """Occupation of a mover: an activity, on which object (-1 for none), since when (s), and the goal it was given."""

    thing: int
    activity: str
    since: float
    goal: str
    object: int = -1


@dataclass(frozen=True)
class Placement:
    """A relation that holds at all times, or at those where `holds(t)`: who was put on what, who touches what."""

    relation: Relation
    holds: Callable[[float], bool] | None = None


@dataclass(frozen=True, eq=False)
class Lane:
    """All within `radius` metres of a line (N, 2), for the thing with id `mover`."""

    mover: int
    line: Array
    radius: float

    def gap(self, points: Array) -> float:
        """Metres between the lane and the nearest of points (M, 2); negative if that is inside."""
        return float(np.min(self._off_line(points))) - self.radius

    def holds(self, points: Array) -> bool:
        """Returns whether all of the points (M, 2) lie in the lane, to within a centimetre."""
        return bool(np.max(self._off_line(points)) <= self.radius + _SPACING / 2)

    def apart(self, other: Lane) -> float:
        """Metres between two lanes; negative if they overlap."""
        return self.gap(_dense(other.line)) - other.radius

    def _off_line(self, points: Array) -> Array:
        """Metres (M,) to the line."""
        distance, _ = self._tree.query(points)
        return np.asarray(distance)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(_dense(self.line))


def _dense(line: Array) -> Array:
    """Points at most `_SPACING` apart along straight pieces."""
    pieces = [
        np.linspace(a, b, max(1, int(np.linalg.norm(b - a) / _SPACING)), endpoint=False) for a, b in pairwise(line)
    ]
    return np.concatenate([*pieces, line[-1:]])


@dataclass(frozen=True)
class WorldOptions:
    """Holds what is asked of a world.

    `speed` (m/s) of the robot, `hold` (s) that it stands at first, whether there are `movers`, how many `people` are
    among them, whether the robot makes a `tour` that crosses itself and sees places from several sides instead of a
    round, and `jumps`: times (s) and shares of the round by which it is carried ahead.
    """

    speed: float
    hold: float
    movers: bool
    people: int = 2
    tour: bool = False
    jumps: tuple[tuple[float, float], ...] = ()

    def cast(self, roles: Sequence[str]) -> list[str]:
        """Roles of movers: after the first two, as many give way to those who choose as there are more people."""
        more = self.people - 2
        return [*roles[:2], *["chooser"] * more, *roles[2 + more :]]

    def drive(self, waypoints: Array, *, at_most: float = 1.0) -> Trajectory:
        """The robot's path through waypoints (N, 2), nowhere faster than `at_most` (m/s)."""
        return Trajectory(waypoints, speed=min(self.speed, at_most), hold=self.hold, jumps=self.jumps)


@dataclass(frozen=True, eq=False)
class World:
    """A world and all that will happen in it.

    `landmarks` (L, 3) are points that the robot can recognise; `camera_mount` is (x, y, z, roll, pitch, yaw) of the
    camera's housing (x forward, y left) on the robot; pitch > 0 looks down.
    """

    name: str
    things: tuple[Thing, ...]
    lights: tuple[Light, ...]
    ambient: float
    path: Trajectory
    landmarks: NDArray[np.float64]
    camera_mount: Mount
    placements: tuple[Placement, ...]
    scripts: tuple[Callable[[float], CurrentActivity], ...] = ()
    floor_id: int = 0
    lanes: tuple[Lane, ...] = ()
    daylight: float = 0.3
    """Share of the ambient light that does not come from lamps."""
    sky: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour where nothing is hit, RGB, 0 to 255."""

    def relations(self, t: float) -> list[Relation]:
        """The relations of placement and contact that hold at a time."""
        return [p.relation for p in self.placements if p.holds is None or p.holds(t)]

    def doings(self, t: float) -> list[CurrentActivity]:
        """Returns what every mover does at a time."""
        return [script(t) for script in self.scripts]

    def thing(self, id: int) -> Thing:
        """Raises KeyError for an id that is not in the world."""
        found = next((thing for thing in self.things if thing.id == id and id), None)
        if found is None:
            raise KeyError(f"no thing {id} in world {self.name!r}")
        return found

    def objects(self) -> Sequence[Thing]:
        """The things that have an identity."""
        return [thing for thing in self.things if thing.id]


@dataclass(eq=False)
class Builder:
    """Collects a world piece by piece and hands out the ids."""

    things: list[Thing] = field(default_factory=list)
    placements: list[Placement] = field(default_factory=list)
    scripts: list[Callable[[float], CurrentActivity]] = field(default_factory=list)
    lanes: list[Lane] = field(default_factory=list)
    _next: int = 1

    def surface(self, label: str, shape: Shape) -> None:
        """A piece of the building, given in world coordinates."""
        self.things.append(Thing(0, label, (shape,), Stationary(np.eye(4))))

    def world(
        self, name: str, lights: Sequence[Light], ambient: float, path: Trajectory, landmarks: Array, mount: Mount,
        **looks: Any,
    ) -> World:  # fmt: skip
        """All that was collected, as a world."""
        return World(
            name, tuple(self.things), tuple(lights), ambient, path, landmarks, mount, tuple(self.placements),
            tuple(self.scripts), lanes=tuple(self.lanes), **looks,
        )  # fmt: skip

    def new_id(self) -> int:
        self._next += 1
        return self._next - 1

    def put(self, label: str, shape: Shape, T: Array, *, on: int | None = None, inside: int | None = None) -> int:
        """Places a still thing, on or in another one; returns its id."""
        id = self.new_id()
        self.things.append(Thing(id, label, (shape,), Stationary(T)))
        if on is not None:
            self.relate(id, "on", on)
        if inside is not None:
            self.relate(id, "in", inside)
        return id

    def move(self, label: str, parts: tuple[Shape, ...], mover: Mover, *, id: int | None = None) -> int:
        """Adds a thing that moves; returns its id."""
        id = self.new_id() if id is None else id
        self.things.append(Thing(id, label, parts, mover))
        return id

    def reserve(self, mover: int, line: Array, radius: float) -> None:
        """Gives a mover the floor within `radius` metres of a line (N, 2). Raises ValueError if another has it."""
        lane = Lane(mover, line, radius)
        for other in self.lanes:
            if lane.apart(other) < 0:
                raise ValueError(f"the lanes of things {other.mover} and {mover} overlap by {-lane.apart(other):.2f} m")
        self.lanes.append(lane)

    def draft(self) -> Builder:
        """An empty builder that goes on with the ids, for what is not sure to be kept."""
        return Builder(_next=self._next)

    def keep(self, draft: Builder) -> bool:
        """Adds a draft's still things, unless one stands in a lane; returns whether it did."""
        if any(lane.gap(thing.vertices(0.0)[:, :2]) < 0 for thing in draft.things for lane in self.lanes):
            return False
        self.things += draft.things
        self.placements += draft.placements
        self._next = draft._next
        return True

    def relate(self, subject: int, predicate: str, object: int, holds: Callable[[float], bool] | None = None) -> None:
        self.placements.append(Placement(Relation(subject, predicate, object), holds))
