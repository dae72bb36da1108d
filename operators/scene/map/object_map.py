"""The map of objects: what was seen where, joined over time by place, class and appearance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.scene.map.carrying import carried
from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.heading import RoomHeading
from operators.scene.map.map_object import MOST_EVIDENCE, WHOLE, MapObject
from operators.scene.map.matching import (
    MapSettings,
    Observation,
    alike,
    alike_mover,
    color_likeness,
    in_image,
    in_places_of_their_own,
    in_reach,
    outside,
)
from operators.scene.map.merging import are_one, may_be_one, merge, smaller_in_place
from operators.scene.map.moving import RecentPlaces
from operators.scene.map.presence import has_left, look_at
from operators.scene.map.range_view import RangeView
from operators.scene.map.trajectory import Correction
from operators.scene.map.voxels import VoxelSet
from operators.tracking.assignment import assign, log_odds

Array = NDArray[np.float64]
_GONE = 1.0  # times its size away from its place, and a thing is moved
_AGAIN = 8  # views after which the heading of the room is looked for once more


class ObjectMap:
    """Joins observations to objects, and keeps, moves and forgets objects.

    An observation is of the object of its class whose box, seen from where it was seen, covers its own in the image,
    and to which its points are near; of a large one whose voxels it shares; of another class only where both cover each
    other. Colour decides near ties. Two objects that come to share their place, of one class or not, are one, unless
    they are seen beside each other. Places that a view looks through lose voxels; an object whose
    place is empty, or that is in plain view and not detected, loses evidence and at last goes. If one of its class and
    size appears elsewhere, that is the same object, moved.
    The place of what moves by itself is that of its last view; it is joined by predicted place. Small ones (a ball) are
    as other things are until a view looks through their place and one of their class is near.

    After Hughes et al., "Hydra", 2022, and Gu et al., "ConceptGraphs", 2024; existence as in occupancy grids.
    """

    def __init__(self, classes: int, priors: ClassPriors, settings: MapSettings) -> None:
        self._settings, self._classes, self._priors = settings, classes, priors
        self.objects: dict[int, MapObject] = {}
        self.gone: dict[int, tuple[int, MapObject]] = {}
        self.moved = 0
        self._next = 1
        self._stamp: int | None = None
        self._room, self._updates = RoomHeading(), 0
        self._recent = RecentPlaces(settings.margin)
        self._heading: float | None = None
        self.floor: float | None = None
        """Height of the floor, where it is known: what stands on it reaches down to it."""

    def update(self, stamp: int, seen: Sequence[Observation], view: RangeView) -> list[int]:
        """Takes the observations of one time and the view that they come from. Returns the object's id of each.

        An object that was found to be a double of another, or one that is known, keeps its id no longer.
        """
        s, before = self._settings, {*self.objects, *self.gone}
        seconds = 0.0 if self._stamp is None else (stamp - self._stamp) * 1e-9
        self._stamp = stamp
        if self._updates % _AGAIN == 0:
            self._room.add(view.points)
        self._updates += 1
        self._heading = self._room.angle
        seen = [self._alone(each, view) for each in seen]
        voxels = VoxelSet.of_each([each.points for each in seen], s.voxel, stamp)
        joined = self._joined(seen, voxels, stamp, view)
        ids: dict[int, int] = {}
        in_hands = carried(seen, voxels, joined, view, self.objects, self._priors, s.views)
        for k, each in enumerate(seen):
            if k in in_hands:
                self._see(self.objects[in_hands[k]], each, voxels[k], stamp, view.origin, moved=True)
                joined[k] = in_hands[k]
            elif k in joined:
                self._see(self.objects[joined[k]], each, voxels[k], stamp, view.origin)
            else:
                ids[k] = self._begin(each, voxels[k], stamp, view.origin)
            if each.track >= 0:
                self.objects[joined[k] if k in joined else ids[k]].follow([each.track])
        movers = [o for o in self.objects.values() if o.seen == stamp and self._priors.is_mover(o)]
        self._recent.judge(stamp, [o for o in movers if self._priors.is_large(o)], view)
        shown = {i: voxels[k] for k, i in joined.items()}
        self._note_beside(seen, [joined.get(k) for k in range(len(seen))])
        self._look_around(view, [o for o in self.objects.values() if o.born != stamp], shown, seconds)
        self._join_doubles([i for i in self.objects if self.objects[i].seen == stamp])
        self._drop(stamp)
        self._forget(before - self.objects.keys() - self.gone.keys())
        return [joined[k] if k in joined else ids[k] for k in range(len(seen))]

    def correct(self, correction: Correction) -> None:
        """Moves all objects with the places from which they were seen; those that come to share their place are one."""
        for object in (*self.objects.values(), *(old for _, old in self.gone.values())):
            object.correct(correction)
        self._recent.forget()
        before = set(self.objects)
        for object in self.objects.values():
            self._fit(object)
        self._join_doubles(sorted(self.objects))
        self._forget(before - self.objects.keys())

    @property
    def heading(self) -> float | None:
        """Heading of most things around, in [0, pi / 2); None where none stands out."""
        return self._heading

    def widen(self, classes: int, priors: ClassPriors) -> None:
        """Takes in classes that were added after those before."""
        self._classes, self._priors = classes, priors
        for object in (*self.objects.values(), *(old for _, old in self.gone.values())):
            object.votes = np.pad(object.votes, (0, classes - len(object.votes)))

    def confirmed(self) -> list[MapObject]:
        """Returns the objects that were seen often enough, whatever their size and class, by rising id."""
        return [o for _, o in sorted(self.objects.items()) if self._is_sure(o)]

    def doubt(self, object: MapObject) -> float:
        """Returns the share of an object's existence that its size or a weak label puts in doubt, in [0, 1)."""
        return self._priors.doubt(object, self._settings.label)

    def _alone(self, each: Observation, view: RangeView) -> Observation:
        """Returns an observation without what is behind the thing."""
        points = self._priors.near_side(each.points, each.class_id, view.origin, self._settings.range_noise)
        return replace(each, points=points)

    def _joined(
        self, seen: Sequence[Observation], voxels: Sequence[VoxelSet], stamp: int, view: RangeView
    ) -> dict[int, int]:
        """Returns the object's id of each observation that is of a known one."""
        s, ids = self._settings, sorted(self.objects)
        value = np.zeros((len(seen), len(ids)))
        if not ids or not seen:
            return {}
        known = [self.objects[i] for i in ids]
        centers, sizes = np.array([o.center for o in known]), np.array([o.size for o in known])
        moves = np.array([self._priors.is_mover(o) for o in known])
        still = np.array([self._priors.is_still(o) for o in known])
        classes = np.array([o.class_id for o in known])
        movers = np.array([each.class_id in self._priors.movers for each in seen])
        halves = np.array([[float(c.extent.max()) / 2] for c in voxels]) + np.linalg.norm(sizes, axis=1) / 2
        near = np.linalg.norm(centers[None] - np.array([c.middle for c in voxels])[:, None], axis=2) - halves
        here = ~moves & (near <= s.reach) & (still | ~movers[:, None])
        compared = np.flatnonzero(here.any(axis=0)).tolist()
        boxes = np.column_stack([centers, sizes, [o.yaw for o in known]])[compared]
        near_by = [known[j] for j in compared]
        images = in_image(seen, boxes, np.array([self._priors.is_round(o) for o in near_by], bool))
        for k, n in np.argwhere(here[:, compared] & in_reach(seen, voxels, boxes, s)).tolist():
            j, image = compared[n], None if images is None else (float(images[k, n, 0]), float(images[k, n, 1]))
            value[k, j] = alike(seen[k], voxels[k], known[j], image, s, large=self._priors.is_large(known[j]))
        left: dict[int, bool] = {}
        for k in np.flatnonzero(movers).tolist():
            each = seen[k]
            around = (near[k] <= s.mover_reach + 2 * s.mover_speed) & (classes == each.class_id) & (value[k] == 0)
            for j in np.flatnonzero(around).tolist():
                if not moves[j] and j not in left:
                    left[j] = has_left(known[j], view, s)
                if moves[j] or left[j]:
                    value[k, j] = alike_mover(each, voxels[k], known[j], stamp, s)
        return {k: ids[j] for k, j in assign(value, value > 0)}

    def _see(
        self, object: MapObject, each: Observation, voxels: VoxelSet, stamp: int, eye: Array, *, moved: bool = False
    ) -> None:
        mover = moved or self._priors.is_mover(object)
        gone = outside(voxels.middle, object.box) > _GONE * float(object.size.max())
        if moved or (each.class_id in self._priors.movers and gone):
            mover, object.images, object.form = True, [], -1  # what lay still is moved
        direction = _direction(eye, voxels)
        object.views += 1
        object.view = direction * object.views if mover else object.view + direction
        before, since = object.center.copy(), max((stamp - object.seen) * 1e-9, 1e-3)
        voted = object.class_id
        object.vote(each.class_id, each.score)
        told = min(stamp - object.seen, WHOLE)
        object.told += told
        gain = told / WHOLE * log_odds(each.score, self._settings.gain)
        object.evidence = min(max(object.evidence, 0.0) + gain, MOST_EVIDENCE)
        object.seen = stamp
        if each.color is not None:
            known = np.isfinite(object.color).all()
            object.color = 0.8 * object.color + 0.2 * each.color if known else each.color
        if mover:
            earlier = object.box
            object.voxels, object.most = voxels, len(voxels)
            self._fit(object)
            if each.image is not None and not each.image.edges.all() and not moved:
                object.keep(earlier)
            speed = (object.center - before) / since
            share = min(1.0, since / 0.5)
            object.velocity = (1 - share) * object.velocity + share * speed if since < 2 else np.zeros(3)
            return
        object.voxels.add(voxels)
        object.velocity = np.zeros(3)
        image = each.image
        new = image is not None and object.look(image, voxels.points) and len(object.images) not in (2, 4)
        if object.class_id != voted:
            object.form = -1
        if new or not object.images or object.class_id != voted:
            self._fit(object)

    def _fit(self, object: MapObject) -> None:
        s, others = self._settings, smaller_in_place(object, self.objects.values(), self._priors, self._settings)
        object.fit(self._priors.usual, self._heading, s.range_noise, self.floor, others)
        if self.floor is not None and (foot := self._priors.foot(object)) > 0:
            object.stand_on(self.floor, foot)

    def _is_sure(self, object: MapObject) -> bool:
        return object.evidence >= self._settings.confirm and object.sightings >= self._settings.views

    def _begin(self, each: Observation, voxels: VoxelSet, stamp: int, eye: Array) -> int:
        votes = np.zeros(self._classes)
        votes[each.class_id] = each.score
        made = MapObject(self._next, voxels, votes, log_odds(each.score, self._settings.gain), stamp, stamp)
        if each.color is not None:
            made.color = each.color
        made.view = _direction(eye, voxels)
        made.center = voxels.middle
        image = each.image
        self._fit(made)  # to its points: a single image is weaker evidence, and counts from the next fit on
        if image is not None and not self._priors.is_mover(made):
            made.look(image, voxels.points)
        self.objects[made.id] = made
        self._next += 1
        return made.id

    def _look_around(
        self, view: RangeView, objects: Sequence[MapObject], shown: Mapping[int, VoxelSet], seconds: float
    ) -> None:
        """Updates objects by what a view shows at their places; `shown` are the voxels of visible ones, by id."""
        s = self._settings
        if not objects:
            return
        centers, radii = np.array([o.center for o in objects]), np.array([o.longest for o in objects])
        near = [objects[k] for k in np.flatnonzero(view.may_show(centers, radii + s.margin)).tolist()]
        sights = dict(zip((o.id for o in near), view.of_each([o.voxels.points for o in near], s.margin), strict=True))
        for object in objects:
            sight, own = sights.get(object.id), shown.get(object.id)
            left = own is None and sight is not None and self._priors.may_leave(object) and has_left(object, view, s)
            look_at(object, sight, view.origin, own, seconds, self._priors, s, left=left)

    def _note_beside(self, seen: Sequence[Observation], ids: Sequence[int | None]) -> None:
        """Counts for neighbours the views in which both were seen, in separate places in the image."""
        rows = [(k, i, each.image) for k, (i, each) in enumerate(zip(ids, seen, strict=True)) if i is not None]
        images = [image for _, _, image in rows if image is not None]
        if len(rows) < 2 or len(images) < len(rows):
            return
        apart = in_places_of_their_own(images)
        centers = np.array([self.objects[i].center for _, i, _ in rows])
        radii = np.array([self.objects[i].longest for _, i, _ in rows]) / 2
        near = np.linalg.norm(centers[:, None] - centers[None], axis=2) <= radii[:, None] + radii[None]
        for a, b in np.argwhere(apart & near).tolist():
            self.objects[rows[a][1]].beside[rows[b][1]] += 1

    def _join_doubles(self, changed: list[int]) -> None:
        """Makes one of two objects that share their voxels."""
        if not changed:
            return
        ids = sorted(self.objects)
        known = [self.objects[i] for i in ids]
        centers, radii = np.array([o.center for o in known]), np.array([o.longest for o in known])
        rows = np.searchsorted(ids, changed)
        apart = np.linalg.norm(centers[None] - centers[rows, None], axis=2)
        close = apart <= (radii[None] + radii[rows, None]) / 2 + 0.1
        touch = may_be_one(known, rows, self._priors)
        joined = False  # then what touches has changed
        for (k, n), touches in zip(np.argwhere(close).tolist(), touch[close].tolist(), strict=True):
            if not (joined or touches):
                continue
            i, j = changed[k], ids[n]
            if i not in self.objects or j not in self.objects or i == j:
                continue
            a, b = self.objects[i], self.objects[j]
            if are_one(a, b, self._priors, self._settings.voxel):
                del self.objects[i], self.objects[j]
                one = merge(a, b, self._priors)
                self._fit(one)
                self.objects[one.id] = one
                joined = True

    def _drop(self, stamp: int) -> None:
        """Drops what is not there any more; what appeared elsewhere instead keeps its id."""
        s = self._settings
        limit = stamp - round(s.move_memory * 1e9)
        self.gone = {i: entry for i, entry in self.gone.items() if entry[0] >= limit}
        for i, object in list(self.objects.items()):
            if object.evidence < 0:
                del self.objects[i]
                if object.sightings >= s.views:
                    self.gone[i] = (stamp, object)
        there: dict[int, list[MapObject]] = {}  # by class
        for o in self.confirmed() if self.gone else ():
            there.setdefault(o.class_id, []).append(o)
        for i, (_, old) in list(self.gone.items()):
            alike = there.get(old.class_id, ())
            new = [o for o in alike if o.born > old.seen and o.id not in self.gone and _moved(old, o)]
            if new:
                chosen = min(new, key=lambda o: (o.born, o.id))
                del self.gone[i], self.objects[chosen.id]
                chosen.id, chosen.born, chosen.tracks = i, old.born, [*old.tracks, *chosen.tracks]
                self.objects[i] = chosen
                self.moved += 1

    def _forget(self, lost: set[int]) -> None:
        """Forgets what was seen beside objects that are no more: their ids do not come back."""
        for object in self.objects.values() if lost else ():
            for i in lost & object.beside.keys():
                del object.beside[i]

    # snapshot and restore are written out: saved maps hold what they give, and those of earlier versions are read

    def snapshot(self) -> Mapping[str, Any]:
        return {
            "next": self._next,
            "stamp": self._stamp,
            "moved": self.moved,
            "updates": self._updates,
            "room": [self._room.scores, self._room.views],
            "objects": [o.snapshot() for o in self.objects.values()],
            "gone": [[stamp, o.snapshot()] for stamp, o in self.gone.values()],
            "recent": self._recent.snapshot(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        side = self._settings.voxel
        self._updates, (scores, self._room.views) = int(state["updates"]), state["room"]
        self._room.scores = np.array(scores, np.float64)
        self._recent.restore(state.get("recent", ()))
        self._next, self._stamp, self.moved = int(state["next"]), state["stamp"], int(state["moved"])
        objects = [MapObject.restored(row, side) for row in state["objects"]]
        self.objects = {o.id: o for o in objects}
        self.gone = {}
        for stamp, row in state["gone"]:
            old = MapObject.restored(row, side)
            self.gone[old.id] = (int(stamp), old)


def _direction(eye: Array, voxels: VoxelSet) -> Array:
    """Returns the horizontal direction (2,) from the viewer to an object."""
    way = (voxels.middle - eye)[:2]
    return np.asarray(way / max(float(np.hypot(*way)), 1e-6))


def _moved(old: MapObject, new: MapObject) -> bool:
    """Returns whether a new object is an old one of its class in another place: of its size and colour."""
    sizes = np.sort(old.size[:2]), np.sort(new.size[:2])
    fits = np.abs(sizes[0] - sizes[1]).max() <= 0.1 + 0.4 * sizes[0].max()
    fits &= abs(old.size[2] - new.size[2]) <= 0.1 + 0.3 * old.size[2]
    return bool(fits) and color_likeness(new.color, old.color) >= 0.4
