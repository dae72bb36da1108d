"""Finds objects in the hands of people: seen at a person, and no longer where they lay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.map_object import MapObject
from operators.scene.map.matching import Observation
from operators.scene.map.range_view import RangeView
from operators.scene.map.voxels import VoxelSet

Array = NDArray[np.float64]

_ARM = 0.35  # metres beyond a body's box on the ground, up to which its hands are
_HAND = 0.55  # metres above the foot of a body from which its hands are
_REACH = 1.0  # metres on the ground that a hand takes a thing in a short while
_AWAY = 0.12  # metres from its place, from which a thing is carried


def carried(
    seen: Sequence[Observation],
    voxels: Sequence[VoxelSet],
    joined: Mapping[int, int],
    view: RangeView,
    objects: Mapping[int, MapObject],
    priors: ClassPriors,
    views: int,
) -> dict[int, int]:
    """Returns the id of the carried object for each observation of an object in a person's hand.

    `joined` holds the object's ids of the other observations, `views` in how many views a thing must
    have been seen. Notes with the things whether they are held now.
    """
    free = [k for k, each in enumerate(seen) if k not in joined and each.class_id in priors.portable]
    hands = [objects[i] for k, i in joined.items() if seen[k].class_id in priors.carriers]
    if not free or not (hands or any(o.held for o in objects.values())):
        return {}
    there = set(joined.values())
    rest = [o for i, o in sorted(objects.items()) if i not in there]
    things = [o for o in rest if o.class_id in priors.portable and o.sightings >= views]
    shown = view.may_show(np.array([o.center for o in things]).reshape(-1, 3), np.zeros(len(things)))
    usable = [o.id for o, plain in zip(things, shown.tolist(), strict=True) if plain]
    found: dict[int, int] = {}
    for k in free:
        id = taken(voxels[k].middle, seen[k].class_id, objects, usable)
        held = in_hand(voxels[k].middle, hands)
        if id is not None and (held or objects[id].held):  # what was in a hand may be put anywhere in reach
            found[k] = id
            objects[id].held = held
            usable.remove(id)
    return found


def in_hand(place: Array, bodies: Sequence[MapObject]) -> bool:
    """Returns whether a place (3,) is where one of these bodies has its hands."""
    for body in bodies:
        c, s = np.cos(body.yaw), np.sin(body.yaw)
        x, y, z = (place - body.center).tolist()
        beside = max(abs(c * x + s * y) - body.size[0] / 2, abs(c * y - s * x) - body.size[1] / 2)
        if beside <= _ARM and _HAND - body.size[2] / 2 <= z <= body.size[2] / 2 + 0.1:
            return True
    return False


def taken(place: Array, class_id: int, known: Mapping[int, MapObject], usable: Sequence[int]) -> int | None:
    """Returns the id of the thing of a class that is now in a hand at `place` (3,): the nearest one in reach.

    `usable` are the ids of things that the view should show and that are not seen where they lay.
    """
    ways = []
    for i in usable:
        object = known[i]
        way = object.center - place
        flat = float(np.hypot(way[0], way[1]))
        if object.class_id == class_id and flat <= _REACH and float(np.linalg.norm(way)) >= _AWAY:
            ways.append((flat, i))
    return min(ways)[1] if ways else None
