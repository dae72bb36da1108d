"""The map of objects: what was seen where, joined over time by place, class and appearance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.scene.cells import Cells, completed, standing_box
from operators.scene.range_view import RangeView, Sight
from operators.tracking.assignment import assign

Array = NDArray[np.float64]
_MOST = 6.0
_PLAIN = ("id", "evidence", "born", "seen", "views", "yaw", "most")
_BRINK = 0.012  # metres that masks and clouds lose of each side of an object
_LEFT = 0.35  # what is left of an object that is seen through: the foot of its place, which the floor confirms
_ARRAYS = ("votes", "color", "center", "size", "velocity", "view")


@dataclass(frozen=True)
class MapSettings:
    """Lengths in metres, times in seconds, evidence in log odds."""

    voxel: float = 0.03
    margin: float = 0.1
    bin: float = 0.012
    overlap: float = 0.25
    confirm: float = 1.0
    views: int = 3
    vacated: float = 1.0
    missed: float = 0.12
    miss_angle: float = 0.1
    gain: float = 0.3
    reach: float = 0.15
    mover_reach: float = 0.5
    mover_speed: float = 1.5
    mover_memory: float = 8.0
    move_memory: float = 120.0


@dataclass(frozen=True, eq=False)
class Observation:
    """One object as seen once: points (N, 3) in the world, class, score, and mean colour (3,) in [0, 1] if known."""

    points: Array
    class_id: int
    score: float
    color: Array | None = None


@dataclass
class MapObject:
    """One object of the map, in an upright box. Times in nanoseconds.

    `votes` (C,) sums scores by class, `view` (2,) the horizontal directions of the views;
    `most` is the largest number of voxels that it had.
    """

    id: int
    cells: Cells
    votes: Array
    evidence: float
    born: int
    seen: int
    views: int = 1
    color: Array = field(default_factory=lambda: np.full(3, np.nan))
    center: Array = field(default_factory=lambda: np.zeros(3))
    size: Array = field(default_factory=lambda: np.zeros(3))
    yaw: float = 0.0
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    view: Array = field(default_factory=lambda: np.zeros(2))
    most: int = 0

    @property
    def class_id(self) -> int:
        return int(np.argmax(self.votes))

    @property
    def score(self) -> float:
        """Probability that the object is there."""
        return 1 / (1 + math.exp(-self.evidence))

    def fit(self, usual: Mapping[int, tuple[float, float]]) -> None:
        """Puts the box around what is surely the object's, as deep as usual for its class where one side was seen."""
        sure = self.cells.sure()
        if len(sure):
            center, size, yaw = standing_box(sure)
            box = (center, size + 2 * _BRINK, yaw)
            known = usual.get(self.class_id)
            if known is not None:
                box = completed(box, self.view / max(self.views, 1), known)
            self.center, self.size, self.yaw = box


class ObjectMap:
    """Joins observations to objects, and keeps, moves and forgets objects.

    An observation is of the object of its class whose voxels it shares most, colour deciding near ties; of another
    class where the two cover each other. Two objects that come to share their voxels are one. Places that a view looks
    through lose voxels; an object whose place is empty, or that is in plain view and not detected, loses evidence and
    at last goes. If one of its class and size appears elsewhere, that is the same object, moved.
    `movers` are classes whose place is that of their last view; they are joined by predicted place.

    After Hughes et al., "Hydra", 2022, and Gu et al., "ConceptGraphs", 2024; existence as in occupancy grids.
    """

    def __init__(
        self,
        classes: int,
        movers: Iterable[int],
        settings: MapSettings,
        usual: Mapping[int, tuple[float, float]] | None = None,
    ) -> None:
        """`usual` are the shorter and longer side on the ground of classes whose size is known, metres."""
        self._settings, self._classes, self._movers = settings, classes, frozenset(movers)
        self._usual = dict(usual or {})
        self.objects: dict[int, MapObject] = {}
        self.gone: dict[int, tuple[int, MapObject]] = {}
        self.moved = 0
        self._next = 1
        self._stamp: int | None = None

    def update(self, stamp: int, seen: Sequence[Observation], view: RangeView) -> None:
        """Takes the observations of one time and the view that they come from."""
        s = self._settings
        seconds = 0.0 if self._stamp is None else (stamp - self._stamp) * 1e-9
        self._stamp = stamp
        cells = [Cells.of(each.points, s.voxel) for each in seen]
        joined = self._joined(seen, cells, stamp)
        for k, each in enumerate(seen):
            if k in joined:
                self._see(self.objects[joined[k]], each, cells[k], stamp, view.origin)
            else:
                self._begin(each, cells[k], stamp, view.origin)
        shown = {i: cells[k] for k, i in joined.items()}
        self._look_around(view, [o for o in self.objects.values() if o.born != stamp], shown, seconds)
        self._join_doubles([i for i in self.objects if self.objects[i].seen == stamp])
        self._drop(stamp)

    def confirmed(self) -> list[MapObject]:
        """Returns the objects that are surely there, by rising id."""
        s = self._settings
        return [o for _, o in sorted(self.objects.items()) if o.evidence >= s.confirm and o.views >= s.views]

    def is_mover(self, object: MapObject) -> bool:
        return object.class_id in self._movers

    def _joined(self, seen: Sequence[Observation], cells: Sequence[Cells], stamp: int) -> dict[int, int]:
        """Returns the object's id of each observation that is of a known one."""
        s, ids = self._settings, sorted(self.objects)
        value = np.zeros((len(seen), len(ids)))
        if not ids:
            return {}
        known = [self.objects[i] for i in ids]
        centers, radii = np.array([o.center for o in known]), np.array([float(o.size.max()) for o in known])
        moves = np.array([self.is_mover(o) for o in known])
        for k, each in enumerate(seen):
            reach = (
                float(cells[k].extent.max()) / 2 + radii + np.where(moves, s.mover_reach + 2 * s.mover_speed, s.reach)
            )
            gaps = np.linalg.norm(centers - cells[k].middle, axis=1)
            for j in np.flatnonzero((gaps <= reach) & (moves == (each.class_id in self._movers))).tolist():
                value[k, j] = self._alike(each, cells[k], known[j], stamp)
        return {k: ids[j] for k, j in assign(value, value > 0)}

    def _alike(self, each: Observation, cells: Cells, object: MapObject, stamp: int) -> float:
        """Returns how likely an observation is of an object, in [0, 1]; 0 where it is not."""
        s = self._settings
        same = each.class_id == object.class_id
        if same and self.is_mover(object):
            since = (stamp - object.seen) * 1e-9
            center, _, _ = standing_box(cells.points)
            away = center - object.center - object.velocity * min(since, 1.0)
            reach = s.mover_reach + s.mover_speed * min(since, 2.0)
            return max(0.0, 1 - float(np.hypot(away[0], away[1])) / reach)
        if self.is_mover(object) or each.class_id in self._movers:
            return 0.0
        if same:
            close = _closeness(cells, object.cells)
            if close <= 0:
                return 0.0
            share = object.cells.near(cells.points, _tolerance(cells.extent))
            alike = _color_likeness(each.color, object.color)
            return 0.5 * share + 0.4 * close + 0.1 * alike if share >= s.overlap else 0.0
        if float(np.abs(object.size - cells.extent).max()) > 0.5 * float(object.size.max()):
            return 0.0
        share = min(object.cells.near(cells.points, s.voxel), cells.near(object.cells.points, s.voxel))
        return 0.5 * share if share >= 0.5 else 0.0

    def _see(self, object: MapObject, each: Observation, cells: Cells, stamp: int, eye: Array) -> None:
        mover = self.is_mover(object)
        direction = _direction(eye, cells)
        object.views += 1
        object.view = direction * object.views if mover else object.view + direction
        if mover:
            before, since = object.center.copy(), max((stamp - object.seen) * 1e-9, 1e-3)
            object.cells = cells
            object.fit(self._usual)
            speed = (object.center - before) / since
            share = min(1.0, since / 0.5)
            object.velocity = (1 - share) * object.velocity + share * speed if since < 2 else np.zeros(3)
        else:
            object.cells.add(cells)
        object.votes[each.class_id] += each.score
        object.evidence = min(max(object.evidence, 0.0) + _log_odds(each.score, self._settings.gain), _MOST)
        object.seen = stamp
        if each.color is not None:
            known = np.isfinite(object.color).all()
            object.color = 0.8 * object.color + 0.2 * each.color if known else each.color
        if not mover:
            object.fit(self._usual)

    def _begin(self, each: Observation, cells: Cells, stamp: int, eye: Array) -> None:
        votes = np.zeros(self._classes)
        votes[each.class_id] = each.score
        made = MapObject(self._next, cells, votes, _log_odds(each.score, self._settings.gain), stamp, stamp)
        if each.color is not None:
            made.color = each.color
        made.view = _direction(eye, cells)
        made.fit(self._usual)
        self.objects[made.id] = made
        self._next += 1

    def _look_around(
        self, view: RangeView, objects: Sequence[MapObject], shown: Mapping[int, Cells], seconds: float
    ) -> None:
        """Takes what a view says of the places of objects; `shown` are the voxels of those that it shows, by id."""
        s = self._settings
        reach = view.reach + s.margin
        near = [o for o in objects if np.linalg.norm(o.center - view.origin) <= reach + float(o.size.max())]
        sights = dict(zip((o.id for o in near), view.of_each([o.cells.points for o in near], s.margin), strict=True))
        for object in objects:
            self._look(object, sights.get(object.id), view.origin, shown.get(object.id), seconds)

    def _look(self, object: MapObject, sight: Sight | None, eye: Array, own: Cells | None, seconds: float) -> None:
        """Takes what a view says of an object's place, and what of it (`own`) the view shows, if any."""
        s, mover = self._settings, self.is_mover(object)
        if not len(object.cells):
            object.evidence = -1.0
            return
        if not mover and sight is not None:
            if own is not None:
                object.cells.doubt(sight.confirmed, own)
            object.cells.carve(sight.free)
            object.most = max(object.most, len(object.cells))
        if own is not None:
            return
        if len(object.cells) < _LEFT * object.most:
            object.evidence = -1.0
        if mover:
            object.evidence -= seconds * _MOST / s.mover_memory
        if sight is None:
            return
        looked = np.count_nonzero(sight.looked)
        if looked < max(5, 0.2 * len(sight.looked)):
            return
        distance = float(np.linalg.norm(object.center - eye))
        if np.count_nonzero(sight.free) >= 0.6 * looked:
            object.evidence -= s.vacated * (3 if mover else 1)
        elif (
            np.count_nonzero(sight.confirmed) >= 0.6 * len(sight.looked)
            and object.size.max() >= s.miss_angle * distance
        ):
            object.evidence -= s.missed

    def _join_doubles(self, changed: list[int]) -> None:
        """Makes one of two objects that share their voxels."""
        if not changed:
            return
        ids = sorted(self.objects)
        centers = np.array([self.objects[i].center for i in ids])
        radii = np.array([float(self.objects[i].size.max()) for i in ids])
        for i in changed:
            if i not in self.objects:
                continue
            k = ids.index(i)
            close = np.linalg.norm(centers - centers[k], axis=1) <= (radii + radii[k]) / 2 + 0.1
            for j in (ids[n] for n in np.flatnonzero(close).tolist()):
                if i in self.objects and j in self.objects and i != j:
                    self._join_two(self.objects[i], self.objects[j])

    def _join_two(self, a: MapObject, b: MapObject) -> None:
        if not self._one(a, b):
            return
        kept, other = (a, b) if (a.born, a.id) < (b.born, b.id) else (b, a)
        if not self.is_mover(kept):
            kept.cells.add(other.cells)
        kept.votes = kept.votes + other.votes
        kept.evidence = min(max(kept.evidence, other.evidence), _MOST)
        kept.seen, kept.views = max(kept.seen, other.seen), kept.views + other.views
        kept.view = kept.view + other.view
        kept.fit(self._usual)
        del self.objects[other.id]

    def _one(self, a: MapObject, b: MapObject) -> bool:
        s = self._settings
        movers = self.is_mover(a), self.is_mover(b)
        if any(movers) and a.class_id != b.class_id:
            return False
        if not a.cells.touches(b.cells, 0.3):
            return False
        small, large = (a, b) if len(a.cells) <= len(b.cells) else (b, a)
        if a.class_id == b.class_id:
            if all(movers):
                return float(np.hypot(*(a.center - b.center)[:2])) < 0.3
            if _closeness(small.cells, large.cells) <= 0.3:
                return False
            return large.cells.near(small.cells.points, 0.5 * _tolerance(small.size) + 0.5 * s.voxel) >= 0.5
        return a.cells.near(b.cells.points, s.voxel) >= 0.5 and b.cells.near(a.cells.points, s.voxel) >= 0.5

    def _drop(self, stamp: int) -> None:
        """Drops what is not there any more; what appeared elsewhere instead keeps its id."""
        s = self._settings
        limit = stamp - round(s.move_memory * 1e9)
        self.gone = {i: entry for i, entry in self.gone.items() if entry[0] >= limit}
        for i, object in list(self.objects.items()):
            if object.evidence < 0:
                del self.objects[i]
                if object.views >= s.views:
                    self.gone[i] = (stamp, object)
        for i, (_, old) in list(self.gone.items()):
            new = [o for o in self.confirmed() if o.born > old.seen and o.id not in self.gone and _moved(old, o)]
            if new:
                chosen = min(new, key=lambda o: (o.born, o.id))
                del self.gone[i], self.objects[chosen.id]
                chosen.id, chosen.born = i, old.born
                self.objects[i] = chosen
                self.moved += 1

    def snapshot(self) -> Mapping[str, Any]:
        return {
            "next": self._next,
            "stamp": self._stamp,
            "moved": self.moved,
            "objects": [_packed(o) for o in self.objects.values()],
            "gone": [[stamp, _packed(o)] for stamp, o in self.gone.values()],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        side = self._settings.voxel
        self._next, self._stamp, self.moved = int(state["next"]), state["stamp"], int(state["moved"])
        objects = [_unpacked(row, side) for row in state["objects"]]
        self.objects = {o.id: o for o in objects}
        self.gone = {}
        for stamp, row in state["gone"]:
            old = _unpacked(row, side)
            self.gone[old.id] = (int(stamp), old)


def _tolerance(extent: Array) -> float:
    """Returns how near points of one object are: a third of its middle extent, so that rows of books stay apart."""
    return float(np.clip(0.35 * np.sort(extent)[1], 0.015, 0.12))


def _closeness(cells: Cells, known: Cells) -> float:
    """Returns 1 for small things whose middles agree, 0 for ones a middle extent apart; 0.5 for what may be a part."""
    extent = np.sort(cells.extent)
    if extent[2] > 0.4:
        return 0.5
    away = float(np.linalg.norm(cells.middle - known.middle))
    return max(0.0, 1 - away / (max(float(extent[1]), 0.03) + 0.02))


def _direction(eye: Array, cells: Cells) -> Array:
    """Returns the horizontal direction (2,) from the viewer to an object."""
    way = (cells.middle - eye)[:2]
    return np.asarray(way / max(float(np.hypot(*way)), 1e-6))


def _log_odds(score: float, least: float) -> float:
    bounded = min(max(score, 0.02), 0.95)
    return max(math.log(bounded / (1 - bounded)), least)


def _color_likeness(first: Array | None, second: Array) -> float:
    """Returns 1 for equal mean colours, 0 for ones half the scale apart; a half where one is not known."""
    if first is None or not np.isfinite(second).all():
        return 0.5
    return max(0.0, 1 - 2 * float(np.abs(first - second).max()))


def _moved(old: MapObject, new: MapObject) -> bool:
    """Tells whether a new object is an old one in another place: of its class, size and colour."""
    if old.class_id != new.class_id:
        return False
    sizes = np.sort(old.size[:2]), np.sort(new.size[:2])
    fits = np.abs(sizes[0] - sizes[1]).max() <= 0.1 + 0.4 * sizes[0].max()
    fits &= abs(old.size[2] - new.size[2]) <= 0.1 + 0.3 * old.size[2]
    return bool(fits) and _color_likeness(new.color, old.color) >= 0.4


def _packed(object: MapObject) -> dict[str, Any]:
    return {name: getattr(object, name) for name in (*_PLAIN, *_ARRAYS)} | {"cells": object.cells.snapshot()}


def _unpacked(state: Mapping[str, Any], side: float) -> MapObject:
    cells = Cells(side)
    cells.restore(state["cells"])
    fields: dict[str, Any] = {name: np.array(state[name], np.float64) for name in _ARRAYS}
    return MapObject(cells=cells, **{name: state[name] for name in _PLAIN}, **fields)
